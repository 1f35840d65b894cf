"""How much of what a view shows no other view, or fewer than three, see without water.

`python -m experiments.scenes.seen DATA/SCENE...` reads truth/{depth,alpha,cameras.json}. Every
surface pixel of every third view is carried into all views by its true depth; a view sees it clean
where its own depth agrees within 2 % and water meets at most 2 % of the rays. Sky is left out. In brackets
the same for dry glass: what lies at the rim of the capture or behind things.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from pipeline.drops.storing import COVERED
from pipeline.io.maps import read_depth, read_map


def clean_counts(
    depth: np.ndarray, alpha: np.ndarray, poses: np.ndarray, k: np.ndarray
) -> np.ndarray:
    """How many views see each surface pixel of every third view clean, (N,) int.

    depth, alpha (V, H, W); poses (V, 4, 4) cam_from_world; k (3, 3).
    """
    counts = []
    height, width = depth.shape[1:]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(k).T
    for one in range(0, len(depth), 3):
        solid = depth[one] > 0
        points = rays[solid] * depth[one][solid][:, None]
        world = (points - poses[one][:3, 3]) @ poses[one][:3, :3]
        seen = np.zeros(len(world), int)
        for other in range(len(depth)):
            local = world @ poses[other][:3, :3].T + poses[other][:3, 3]
            pixel = local @ k.T
            at = np.floor(pixel[:, :2] / pixel[:, 2:]).astype(int)
            inside = ((at >= 0) & (at < [width, height])).all(1) & (local[:, 2] > 0)
            x, y = np.where(inside[:, None], at, 0).T
            agrees = np.abs(depth[other][y, x] - local[:, 2]) < 0.02 * local[:, 2]
            seen += inside & agrees & (alpha[other][y, x] <= COVERED)
        counts.append(seen)
    return np.concatenate(counts)


def _coverage(path: Path) -> np.ndarray:
    stored = cv2.imread(str(path), -1)
    assert stored is not None, path
    return stored / 255


def read(data: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Depth, coverage, poses and intrinsics of a scene."""
    truth = data / "truth"
    cameras = json.loads((truth / "cameras.json").read_text())
    stems = sorted(cameras["frames"])
    depth = np.stack([read_depth(truth / f"depth/{stem}.exr", "synthesize") for stem in stems])
    if (truth / "alpha").is_dir():
        alpha = [read_map(truth / f"alpha/{stem}.exr", "synthesize") for stem in stems]
    else:
        alpha = [_coverage(truth / f"coverage/{stem}.png") for stem in stems]
    poses = np.array([cameras["frames"][stem]["cam_from_world"] for stem in stems])
    k = np.array([[cameras["fx"], 0, cameras["cx"]], [0, cameras["fy"], cameras["cy"]], [0, 0, 1]])
    return depth, np.stack(alpha), poses, k


def main() -> None:
    """Prints one line per scene."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, nargs="+")
    scenes = parser.parse_args().data
    print(
        "| scene | views | water (> 0.5) | never clean | in fewer than 3 views |\n|---|---|---|---|---|"
    )
    for data in scenes:
        depth, alpha, poses, k = read(data)
        seen = clean_counts(depth, alpha, poses, k)
        dry = clean_counts(depth, np.zeros_like(alpha), poses, k)
        print(
            f"| {data.name} | {len(depth)} | {(alpha > 0.5).mean():.1%} "
            f"| {(seen == 0).mean():.2%} ({(dry == 0).mean():.2%}) "
            f"| {(seen < 3).mean():.2%} ({(dry < 3).mean():.2%}) |",
            flush=True,
        )


if __name__ == "__main__":
    main()
