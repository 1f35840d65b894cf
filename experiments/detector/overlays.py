"""Draws what a detector finds on photo pairs, and tells what its wrong pixels are.

`python -m experiments.detector.overlays unet:weights/unet.safetensors OUT --pairs FOLDER_OF_PAIRS`

OUT/<name>.png: the photo and its dry partner; below, what is found (green), marked where the photos hardly
differ (red) and missed (blue), and the difference, three times as bright. One line per pair: the share of the
photo that is falsely marked and that is missed, and how much of the former differs by 10 to 30 of 255.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from experiments.detector.score import aligned, named_detector, pair_cases
from pipeline.attention.inference import attend
from pipeline.io.images import read_photo

FOUND, TOO_MUCH, MISSED = (0.0, 0.45, 0.0), (0.45, 0.0, 0.0), (0.0, 0.1, 0.45)


def sheet(photo: np.ndarray, dry: np.ndarray, marked: np.ndarray, wet: np.ndarray) -> np.ndarray:
    """(2H,2W,3) uint8 from photos (H,W,3) uint8, the marked and the wet pixels."""
    drawn = 0.55 * photo.astype(np.float32) / 255
    for where, colour in (
        (marked & wet, FOUND), (marked & ~wet, TOO_MUCH), (~marked & wet, MISSED),
    ):  # fmt: skip
        drawn[where] += np.array(colour, np.float32)
    difference = np.abs(photo.astype(np.int16) - dry).max(axis=2, keepdims=True)
    grey = np.repeat(np.clip(3 * difference, 0, 255), 3, axis=2).astype(np.uint8)
    below = [np.round(255 * np.clip(drawn, 0, 1)).astype(np.uint8), grey]
    return np.vstack([np.hstack([photo, dry]), np.hstack(below)])


def main() -> None:
    """Reads the command line, writes the pictures and prints the lines."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("detector", help="MODEL:FILE")
    parser.add_argument("out", type=Path)
    parser.add_argument("--pairs", type=Path, required=True)
    parser.add_argument("--threshold", type=float, default=0.25)
    flags = parser.parse_args()
    network = named_detector(flags.detector)
    flags.out.mkdir(parents=True, exist_ok=True)
    for name, photo, wet, sure in pair_cases(flags.pairs):
        marked = attend(network, photo) >= flags.threshold
        partner = flags.pairs / f"{name.replace('_rain', '_clean')}.png"
        pair = aligned(read_photo(flags.pairs / f"{name}.png")[0], read_photo(partner)[0])
        cv2.imwrite(str(flags.out / f"{name}.png"), sheet(*pair, marked, wet)[..., ::-1])
        false = marked & ~wet
        unsure = (false & ~sure).sum() / max(int(false.sum()), 1)
        print(
            f"{name}: {false.mean():.1%} falsely marked, of which {unsure:.0%} differ by 10 to 30; "
            f"{(~marked & wet).mean():.1%} missed"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
