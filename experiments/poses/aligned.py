"""What poses are worth: true ones, those in a scene's artifacts, and these aligned once more.

    python -m experiments.poses.aligned data/demo --photos clean
    python -m experiments.poses.aligned data/harbour-move --photos rainy --brief 600 --steps 1500

A scene is a folder that `synthesize` made, with its poses in `artifacts/<scene>/poses` (of a run with
`poses.align_rounds: 0`, to see what the features alone are worth); photos are halved. A field is fitted for
`--brief` steps and each camera aligned to its photo through it (`pipeline.field.align`); then a field is
fitted anew. Behind the words *held out*: PSNR of the held-out views against the clean references at their
estimated poses, and at poses aligned to the fitted field with their own photo's dry pixels. *tracks*: how
far, in pixels of the whole photo, exact tracks of points of the scene stay from any points that these
cameras could see: what in the poses no other world explains.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml

from benchmarks.quality import FIELD, ROOT, TRUE_COVERAGE, Scene, load
from pipeline.field.align import aligned
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.fit import fit
from pipeline.field.model import build_around
from pipeline.field.render import RenderedView, render_view
from pipeline.io.transforms import View

Poses = dict[str, np.ndarray]
ALIGNMENTS = 3


def projected(points: np.ndarray, view: View, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depths (N,) of points in one view of the whole size."""
    inside = points @ pose[:3, :3].T + pose[:3, 3]
    plane = inside[:, :2] / inside[:, 2:]
    plane = plane * (1.0 + view.k1 * (plane**2).sum(1, keepdims=True))
    return plane * (view.fx, view.fy) + (view.cx, view.cy), inside[:, 2]


def tracks(
    points: np.ndarray, true: dict[str, View], views: dict[str, View], poses: Poses
) -> float:
    """Root mean square in pixels that exact tracks of ``points`` keep from any points in ``poses``."""
    exact = {n: projected(points, true[n], true[n].cam_from_world) for n in poses}
    inside = {
        n: (z > 0) & (u > 0).all(1) & (u < (true[n].width, true[n].height)).all(1)
        for n, (u, z) in exact.items()
    }
    centres = [np.stack([-p[:3, :3].T @ p[:3, 3] for p in some.values()]) for some in (
        {n: true[n].cam_from_world for n in poses}, poses)]  # fmt: skip
    turn = sum(poses[n][:3, :3].T @ true[n].cam_from_world[:3, :3] for n in poses)
    u, _, vt = np.linalg.svd(turn)
    away = [one - one.mean(0) for one in centres]
    scale = np.linalg.norm(away[1]) / np.linalg.norm(away[0])
    found = scale * (points - centres[0].mean(0)) @ (u @ vt).T + centres[1].mean(0)
    for _ in range(15):
        normal, right = np.full((len(points), 3, 3), 1e-9) * np.eye(3), np.zeros((len(points), 3))
        for n in poses:
            here, _ = projected(found, views[n], poses[n])
            h = 1e-5 * np.linalg.norm(found, axis=1)[:, None]
            j = np.stack([(projected(found + h * axis, views[n], poses[n])[0] - here) / h
                          for axis in np.eye(3)], -1) * inside[n][:, None, None]  # fmt: skip
            normal += np.einsum("pij,pik->pjk", j, j)
            right += np.einsum("pij,pi->pj", j, exact[n][0] - here)
        found = found + np.linalg.solve(normal, right[..., None])[..., 0]
    often = sum(one.astype(int) for one in inside.values()) >= 5
    off = [
        (exact[n][0] - projected(found, views[n], poses[n])[0])[inside[n] & often] for n in poses
    ]
    return float(np.sqrt((np.concatenate(off) ** 2).sum(1).mean()))


class Half:
    """A scene at half its size: photos, keep masks and references by stem, and fits of them."""

    def __init__(self, scene: Scene, photos: str, settings: dict[str, Any]) -> None:
        self.settings, self.estimated = settings, scene.views["sfm"]
        self.stems = [stem for stem in scene.rainy if stem in self.estimated]
        self.held_out = [stem for stem in list(scene.rainy)[::8] if stem in self.estimated]
        wet = {s: halved(scene.coverage[s]) > TRUE_COVERAGE for s in self.stems}
        chosen = scene.clean if photos == "clean" else scene.rainy
        self.photos = {s: halved(chosen[s]) for s in self.stems}
        self.clean = {s: halved(scene.clean[s]) for s in self.stems}
        self.keep_masks = {s: ~wet[s] | (photos == "clean") for s in self.stems}

    def fitted(self, views: dict[str, View], poses: Poses, steps: int) -> Any:
        """A field and what renders it: a function of a stem and a pose."""
        near = min(view.near for view in views.values())
        far = max(view.far for view in views.values()) * self.settings["far_factor"]
        small = {s: _halved_view(views[s], poses[s]) for s in self.stems}
        config = {key: self.settings[key] for key in FIELD}
        field = build_around("fast", list(small.values()), near, far, **config)
        photos = [
            PosedPhoto(
                s, self.photos[s], self.keep_masks[s], poses[s], small[s].intrinsics, near, far
            )
            for s in self.stems
            if s not in self.held_out
        ]
        fit(field, RayBuffer(photos, 0), steps=steps, batch_rays=1024, seed=0, threads=1)

        def seen(stem: str, pose: np.ndarray) -> RenderedView:
            view = small[stem]
            size = (view.width, view.height)
            return render_view(field, pose, view.intrinsics, size, near, far)

        return seen

    def aligned(self, seen: Any, poses: Poses, stems: list[str]) -> Poses:
        """``poses``, those of ``stems`` aligned to the rendering ``seen``."""
        out = dict(poses)
        for s in stems:
            camera = _halved_view(self.estimated[s], out[s]).intrinsics
            out[s] = aligned(
                self.photos[s], self.keep_masks[s], out[s], camera, partial(seen, s), ALIGNMENTS
            )
        return out

    def psnr(self, seen: Any, poses: Poses) -> float:
        """Mean over the held-out views in dB."""
        errors = [((seen(s, poses[s]).rgb - self.clean[s]) ** 2).mean() for s in self.held_out]
        return float(np.mean(-10.0 * np.log10(errors)))


def halved(picture: np.ndarray) -> np.ndarray:
    """The picture with half the pixels a side, each the mean of four."""
    return cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _halved_view(view: View, pose: np.ndarray) -> View:
    fx, fy, cx, cy, k1 = view.intrinsics
    size = (view.width // 2, view.height // 2)
    return View(view.name, pose, fx / 2, fy / 2, cx / 2, cy / 2, k1, *size, view.near, view.far)


def _points(seen: Any, half: Half, true: dict[str, View], count: int = 200) -> np.ndarray:
    """Points of the scene (N, 3), at random pixels of the held-out views."""
    random, found = np.random.default_rng(0), []
    for s in half.held_out:
        view = _halved_view(true[s], true[s].cam_from_world)
        depth = seen(s, view.cam_from_world).depth
        row, column = (random.integers(3, side - 3, count) for side in depth.shape)
        z, (fx, fy, cx, cy, _) = depth[row, column], view.intrinsics
        inside = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(count)], -1)
        pose = view.cam_from_world
        found.append((inside * z[:, None] - pose[:3, 3]) @ pose[:3, :3])
    return np.concatenate(found)


def main() -> None:
    """Print the three rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a folder like data/demo")
    parser.add_argument("--artifacts", type=Path, default=ROOT / "artifacts")
    parser.add_argument("--photos", choices=("clean", "rainy"), default="rainy")
    parser.add_argument("--brief", type=int, default=600, help="steps of the field aligned to")
    parser.add_argument("--steps", type=int, default=1500)
    flags = parser.parse_args()
    torch.set_num_threads(1)
    settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    settings |= {"resolution": settings["resolution"] // 2, "table_log2": 18}
    scene = load(flags.scene, flags.artifacts / flags.scene.name)
    half, true = Half(scene, flags.photos, settings), scene.views["true"]
    exact = {s: true[s].cam_from_world for s in half.stems}
    seen = half.fitted(true, exact, flags.steps)
    points = _points(seen, half, true)
    print(f"{flags.scene.name}, {flags.photos} photos\n{'poses':10} {'tracks':>7} {'held out':>9} "
          f"{'aligned':>8}\n{'true':10} {0.0:7.3f} {half.psnr(seen, exact):9.2f}", flush=True)  # fmt: skip
    poses = {s: half.estimated[s].cam_from_world for s in half.stems}
    for name in ("estimated", "aligned"):
        if name == "aligned":
            brief = half.fitted(half.estimated, poses, flags.brief)
            poses = half.aligned(brief, poses, half.stems)
        seen = half.fitted(half.estimated, poses, flags.steps)
        there = half.aligned(seen, poses, half.held_out)
        print(f"{name:10} {tracks(points, true, half.estimated, poses):7.3f} "
              f"{half.psnr(seen, poses):9.2f} {half.psnr(seen, there):8.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
