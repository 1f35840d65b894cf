"""A small contact sheet of a scene: `python -m experiments.scenes.sheet DATA/SCENE OUT.jpg`.

Above three wet views, below the middle one's clean reference, coverage and depth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from experiments.command import picture, write_picture
from pipeline.io.maps import read_depth


def sheet(data: Path, width: int = 300) -> np.ndarray:
    """The sheet as (H, W, 3) uint8, BGR."""
    photos = sorted(data.glob("*.jpg"))
    chosen = [photos[0], photos[len(photos) // 2], photos[-1]]
    middle = chosen[1].stem
    depth = read_depth(data / f"truth/depth/{middle}.exr", "synthesize")
    near = np.where(depth > 0, depth[depth > 0].min() / np.maximum(depth, 1e-3), 0)
    parts = [cv2.imread(str(path)) for path in chosen]
    parts.append(cv2.imread(str(data / f"truth/clean/{middle}.jpg")))
    parts.append(cv2.imread(str(data / f"truth/coverage/{middle}.png")))
    parts.append(np.repeat(np.rint(near * 255).astype(np.uint8)[..., None], 3, 2))
    size = (width, round(width * depth.shape[0] / depth.shape[1]))
    small = [cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts]
    return np.vstack([np.hstack(small[:3]), np.hstack(small[3:])])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="a scene's folder, with its truth")
    parser.add_argument("out", type=picture)
    flags = parser.parse_args()
    write_picture(flags.out, sheet(flags.data), 85)
