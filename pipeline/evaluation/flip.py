"""FLIP, how different two images look to someone who flips between them; from NVIDIA's evaluator."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

AVAILABLE = find_spec("flip_evaluator") is not None
UNAVAILABLE = "the package flip-evaluator is not installed (it has no wheel for some platforms)"
PIXELS_PER_DEGREE = (
    67.02  # a 0.7 m wide screen of 3840 pixels seen from 0.7 m, the authors' default
)


def flip_map(view: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The visible difference at each pixel, (H, W) float32 in [0, 1]; 0 for equal images.

    view, reference: (H, W, 3) sRGB in [0, 1]. LDR-FLIP at 67.02 pixels per degree (Andersson et al.
    2020, doi:10.1145/3406183). ValueError when shapes differ or the package is absent.
    """
    if view.shape != reference.shape:
        raise ValueError(f"images of different shapes: {view.shape} and {reference.shape}")
    if not AVAILABLE:
        raise ValueError(UNAVAILABLE)
    # Late: where there is no wheel, everything but this number still works.
    import flip_evaluator

    images = (np.ascontiguousarray(image, np.float32) for image in (reference, view))
    settings = {"ppd": PIXELS_PER_DEGREE}
    found, _, _ = flip_evaluator.evaluate(
        *images, "LDR", applyMagma=False, computeMeanError=False, parameters=settings
    )
    return found[..., 0]


def flip(view: np.ndarray, reference: np.ndarray) -> float:
    """The mean of `flip_map`: 0 for equal images, 1 for black against white."""
    return float(flip_map(view, reference).mean(dtype=np.float64))
