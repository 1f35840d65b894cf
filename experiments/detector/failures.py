"""Writes a picture of the renders that a detector does worst on: photo, truth, map, cut map.

`python -m experiments.detector.failures unet:weights/unet.safetensors OUT.jpg --rendered FOLDER`
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from experiments.command import picture, sentences, write_picture
from experiments.detector.score import named_detector
from pipeline.attention.inference import attend
from pipeline.attention.pools import read_rendered
from pipeline.attention.samples import VISIBLE_COVERAGE


@sentences()
def main() -> None:
    """Reads the command line and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("detector", help="MODEL:FILE")
    parser.add_argument("out", type=picture)
    parser.add_argument("--rendered", type=Path, required=True)
    parser.add_argument("--threshold", type=float, default=0.25)
    flags = parser.parse_args()
    network = named_detector(flags.detector)
    rows = []
    rainy, _, coverage = read_rendered(flags.rendered)
    for one, cover in zip(rainy, coverage, strict=True):
        photo, wet = one.astype(np.float32) / 255, cover / 255 > VISIBLE_COVERAGE
        found = attend(network, photo)
        marked = found > flags.threshold
        f1 = 2 * (marked & wet).sum() / max(marked.sum() + wet.sum(), 1)
        parts = [photo[..., ::-1], *(np.dstack([a] * 3) for a in (wet, found, marked))]
        rows.append((f1 if wet.any() else 1 - marked.mean(), np.hstack(parts)))
    rows.sort(key=lambda row: row[0])
    shown = [*rows[:3], rows[len(rows) // 2]]
    sheet = (np.vstack([row for _, row in shown]) * 255).astype(np.uint8)
    print("F1 of the rows:", *(f"{f1:.2f}" for f1, _ in shown))
    small = cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    write_picture(flags.out, small, 80)


if __name__ == "__main__":
    main()
