"""How far wet photos and their clean references differ where no water is: noise, or another scene?

`python -m experiments.scenes.dry DATA/SCENE...` prints the PSNR between the two, five pixels and more from any
water, and the same of both blurred by a Gaussian of 4 pixels. Noise of single pixels gains 23 dB by that or
more (23.0 when it is white); what gains less is not noise: the two show different things.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from pipeline.io.images import PHOTO_SUFFIXES, read_image

AWAY = 5  # pixels from any water
BLUR = 4.0  # pixels


def differences(
    wet: np.ndarray, clean: np.ndarray, coverage: np.ndarray, blur: float
) -> np.ndarray:
    """Differences (N, 3) of two photos (H, W, 3), blurred, away from all coverage (H, W) above 0."""
    near = cv2.dilate((coverage > 0).astype(np.uint8), np.ones((2 * AWAY + 1,) * 2, np.uint8)) > 0
    apart = np.where(near[..., None], 0.0, wet - clean).astype(np.float64)
    if blur:
        known = cv2.GaussianBlur((~near).astype(np.float64), (0, 0), blur)
        apart = cv2.GaussianBlur(apart, (0, 0), blur) / np.maximum(known, 1e-6)[..., None]
    return apart[~near]


def psnr(data: Path, blur: float) -> float:
    """The PSNR in dB of all photos of a scene in `data` against its references, where dry."""
    truth, parts = data / "truth", []
    for photo in sorted(p for p in data.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES):
        clean = next((truth / "clean").glob(f"{photo.stem}.*"))
        coverage = cv2.imread(str(truth / "coverage" / f"{photo.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert coverage is not None, photo.stem
        parts.append(differences(read_image(photo), read_image(clean), coverage, blur))
    return float(-10 * np.log10(np.mean(np.concatenate(parts) ** 2)))


def main() -> None:
    """A line per scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="+", help="folders like data/demo")
    for data in parser.parse_args().scenes:
        whole, smooth = psnr(data, 0.0), psnr(data, BLUR)
        print(f"{data.name:14} {whole:6.2f} dB, blurred {smooth:6.2f} dB ({smooth - whole:+.2f})")


if __name__ == "__main__":
    main()
