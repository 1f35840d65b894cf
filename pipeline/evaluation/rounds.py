"""How the masks fared, round after round of the loop that repairs them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from pipeline.evaluation.image import psnr
from pipeline.evaluation.masks import mask_counts, mask_scores
from pipeline.evaluation.references import read_reference
from pipeline.evaluation.score import Files
from pipeline.io.images import read_image
from pipeline.io.masks import read_keep_mask


def score_rounds(
    refine: Path, files: Mapping[str, Files], threshold: float
) -> dict[str, dict[str, float]]:
    """The numbers of each round in the folder `refine` by its number, "0" the masks before the first fit.

    Always `coverage`; `iou`, `precision`, `recall` where the true coverage is known; `test_psnr` where
    clean references are: held-out views of the brief fit on the round's masks. Empty without rounds.
    """
    numbers = {}
    folder = refine / "rounds"
    rounds = [path for path in folder.iterdir() if path.name.isdigit()] if folder.is_dir() else []
    for path in sorted(rounds, key=lambda path: int(path.name)):
        numbers[path.name] = _round(path, files.values(), threshold)
    return numbers


def _round(folder: Path, files: Iterable[Files], threshold: float) -> dict[str, float]:
    shares, counts, psnrs = [], [], []
    for one in files:
        keep_file, view = folder / "masks" / one.record.name, folder / "test" / one.record.name
        if keep_file.is_file():
            drop_mask = ~read_keep_mask(keep_file, one.record.size)
            shares.append(float(drop_mask.mean()))
            if one.coverage is not None:
                coverage = read_reference(one.coverage, one.record, one.source)[..., 0]
                counts.append(mask_counts(drop_mask, coverage, threshold))
        if view.is_file() and one.clean is not None:
            clean = read_reference(one.clean, one.record, one.source)
            psnrs.append(psnr(read_image(view, "refine", one.record.size), clean))
    found = {"coverage": float(np.mean(shares))} if shares else {}
    scores = mask_scores(counts)._asdict() if counts else {}
    found |= {name: value for name, value in scores.items() if math.isfinite(value)}
    if psnrs and math.isfinite(mean := float(np.mean(psnrs))):
        found["test_psnr"] = mean
    return {name: round(value, 6) for name, value in found.items()}
