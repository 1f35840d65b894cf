"""The numbers of one image: its views, its photo and its mask against what is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.evaluation import flip
from pipeline.evaluation.image import WINDOW_RADIUS, psnr, ssim
from pipeline.evaluation.lpips import SMALLEST_SIDE, Lpips, load_lpips, lpips
from pipeline.evaluation.masks import mask_counts
from pipeline.evaluation.references import read_reference
from pipeline.io.images import read_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.scene import ImageRecord


@dataclass(frozen=True)
class Files:
    """Where everything about one image lies; None where there is no such file.

    `test` is the render of a held-out view, `fitted` the field's render at the photo's pose,
    `composite` the photo with the render in the drops' place.
    """

    record: ImageRecord
    source: Path
    photo: Path
    keep_mask: Path
    test: Path | None
    fitted: Path | None
    composite: Path | None
    clean: Path | None
    coverage: Path | None


def score_image(files: Files, threshold: float, backbone: Path | None) -> dict[str, float]:
    """The numbers of one image by dotted name, such as `test.psnr`; what cannot be had is left out.

    threshold: a pixel is truly covered when its coverage is above it. backbone: AlexNet weights for
    LPIPS, or None. Infinite PSNR means identical images.
    UserError when a file is missing, damaged or of another size than the image.
    """
    record = files.record
    keep = read_keep_mask(files.keep_mask, record.size)
    numbers = {"masks.coverage": float(1 - keep.mean())}
    if files.coverage is not None:
        coverage = read_reference(files.coverage, record, files.source)[..., 0]
        counts = mask_counts(~keep, coverage, threshold)
        numbers |= {f"masks.{name}": float(count) for name, count in counts._asdict().items()}
        numbers["masks.true_coverage"] = float((coverage > threshold).mean())
    photo = _read_view(files.photo, record, "ingest")
    clean = read_reference(files.clean, record, files.source) if files.clean is not None else None
    if files.test is not None:
        view = _read_view(files.test, record)
        numbers |= _selected("selfcheck.kept_psnr", view, photo, keep)
        if clean is not None:
            numbers |= _whole("test", view, clean)
            numbers |= _selected("covered.psnr", view, clean, ~keep)
            numbers |= _selected("kept.psnr", view, clean, keep)
            if backbone is not None and min(view.shape[:2]) >= SMALLEST_SIDE:
                numbers["test.lpips"] = lpips(_model(backbone), view, clean)
    if clean is None:
        return numbers
    for name, path in (("fitted", files.fitted), ("composite", files.composite)):
        if path is not None:
            numbers |= _against(name, _read_view(path, record), clean, keep)
    if files.composite is not None:
        numbers |= _against("input", photo, clean, keep)
    return numbers


def _against(name: str, view: np.ndarray, clean: np.ndarray, keep: np.ndarray) -> dict[str, float]:
    return _whole(name, view, clean) | _selected(f"{name}.covered_psnr", view, clean, ~keep)


def _whole(name: str, view: np.ndarray, clean: np.ndarray) -> dict[str, float]:
    numbers = {f"{name}.psnr": psnr(view, clean)}
    if min(view.shape[:2]) > 2 * WINDOW_RADIUS:
        numbers[f"{name}.ssim"] = ssim(view, clean)
    if flip.AVAILABLE:
        numbers[f"{name}.flip"] = flip.flip(view, clean)
    return numbers


def _selected(
    name: str, view: np.ndarray, reference: np.ndarray, chosen: np.ndarray
) -> dict[str, float]:
    return {name: psnr(view, reference, chosen)} if chosen.any() else {}


def _read_view(path: Path, record: ImageRecord, made_by: str = "render") -> np.ndarray:
    return read_image(path, made_by, record.size)


@lru_cache(maxsize=1)
def _model(backbone: Path) -> Lpips:
    return load_lpips(backbone)
