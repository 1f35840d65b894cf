"""Scores a remover per test set: PSNR, SSIM and FLIP of restored photos against dry ones.

`python -m experiments.removers.score attgan --scenes data/demo --photos artifacts/pools/photos/unseen \\
    --pairs FOLDER_OF_PAIRS --scratch artifacts/.work/demo/train_remover --out /tmp/attgan`

Beside each figure stands that of the photo as it is. Sets: painted pictures and clips on unseen photos
(those after the ones that training's curve is drawn by), every SIXTH view of scenes with truth/clean, and
photo pairs (N_rain.png, N_clean.png), the dry one shifted to match. PSNR within and outside of drops,
where a pixel's coverage is above 0.05, tells mending from damage. `wen` sees a clip or the neighbouring
views, and of single pictures that picture alone. `--out` keeps rainy | restored | dry as PNG, and a CSV.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor, nn

from experiments.command import sentences
from experiments.detector.score import aligned
from pipeline.attention import pools
from pipeline.attention.samples import VISIBLE_COVERAGE, coverage_of_pair
from pipeline.errors import UserError
from pipeline.evaluation.flip import flip
from pipeline.evaluation.image import psnr, ssim
from pipeline.io.images import read_photo, write_image
from pipeline.removal import clips
from pipeline.removal.clean import clean_attgan, clean_quan, clean_wen, window_around
from pipeline.removal.record import edges_of
from stages.restore import networks_of

SIXTH = 6
MOST = 60.0  # dB: what equal pixels are given, so that they do not outweigh all others
FIGURES = ("psnr", "ssim", "flip", "psnr_drops", "psnr_dry")


class Case(NamedTuple):
    """The frames to look at and which of them is scored, its dry partner, and where it is wet."""

    group: str
    name: str
    window: list[np.ndarray]
    scored: int
    clean: np.ndarray
    wet: np.ndarray


def painted_cases(scratch: Path, folder: Path, first: int, count: int) -> Iterator[Case]:
    photos = pools.list_pictures(folder)
    path = scratch / pools.painted_name(1, photos) / "0000.npy"
    pools.paint_chunk(path, 1, 0, photos)
    for k, (wet, dry, cover) in enumerate(zip(*pools.read_chunk(path), strict=True)):
        if first <= k < first + count and cover.any():
            where = cover / 255 > VISIBLE_COVERAGE
            yield Case("painted", f"{k:02d}", [_unit(wet)], 0, _unit(dry), where)
    path = scratch / clips.painted_name(1, photos) / "0000.npy"
    clips.paint_chunk(path, 1, 0, photos)
    for k, (wet, dry, cover) in enumerate(zip(*clips.read_chunk(path), strict=True)):
        if k >= first and cover.any():
            middle = len(dry) // 2
            where = cover / 255 > VISIBLE_COVERAGE
            yield Case("clips", f"{k:02d}", list(_unit(wet)), middle, _unit(dry[middle]), where)


def scene_cases(folder: Path) -> Iterator[Case]:
    paths = pools.list_pictures(folder)
    for index in range(0, len(paths), SIXTH):
        near, place = window_around(index, len(paths))
        window = [_unit(read_photo(paths[k])[0]) for k in near]
        clean = next((folder / "truth/clean").glob(f"{paths[index].stem}.*"))
        cover = next((folder / "truth/coverage").glob(f"{paths[index].stem}.*"))
        wet = read_photo(cover)[0][..., 0] / 255 > VISIBLE_COVERAGE
        yield Case(folder.name, paths[index].stem, window, place, _unit(read_photo(clean)[0]), wet)


def pair_cases(folder: Path) -> Iterator[Case]:
    for path in sorted(folder.glob("*_rain.png")):
        rainy = read_photo(path)[0]
        clean = read_photo(path.with_name(path.name.replace("_rain", "_clean")))[0]
        rainy, clean = aligned(rainy, clean)
        yield Case("pair " + path.name[0], path.stem, [_unit(rainy)], 0, _unit(clean),
                   coverage_of_pair(rainy, clean) > 0)  # fmt: skip


def restored(method: str, weights: Path, case: Case, keep_clear: bool) -> np.ndarray:
    """The photo as the stage `restore` makes it; quan with the edges that its weights say, or the published."""
    networks = networks_of(method, weights, "", "cpu")
    if method == "wen":
        return clean_wen(networks[0], case.window, case.scored, keep_clear=keep_clear)  # type: ignore[arg-type]
    if method == "quan":
        published = edges_of(weights) is not False
        return clean_quan(networks[0], case.window[case.scored], published=published)  # type: ignore[arg-type]
    attend = partial(_last_map, networks[0])
    return clean_attgan(networks[1], case.window[case.scored], attend)  # type: ignore[arg-type]


def figures(found: np.ndarray, case: Case) -> list[float]:
    """FIGURES of a picture against the dry one."""
    where = case.wet.astype(np.float32)
    parts = [psnr(found, case.clean, weights) for weights in (None, where, 1 - where)]
    whole, wet, dry = (min(value, MOST) for value in parts)
    return [whole, ssim(found, case.clean), flip(found, case.clean), wet, dry]


@sentences()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("method", choices=("attgan", "quan", "wen"))
    parser.add_argument("--weights", type=Path, help="default: weights/removers/METHOD.safetensors")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--first", type=int, default=8, help="painted pictures passed over")
    parser.add_argument("--count", type=int, default=24, help="painted pictures scored")
    parser.add_argument("--scratch", type=Path, default=Path("artifacts/.work/demo/train_remover"))
    parser.add_argument("--plain", action="store_true", help="wen: all pixels from the network")
    parser.add_argument("--out", type=Path, required=True)
    flags = parser.parse_args()
    if not (flags.scenes or flags.photos or flags.pairs):
        parser.error("there is nothing to score: name --scenes, --photos or --pairs")
    weights = flags.weights or Path(f"weights/removers/{flags.method}.safetensors")
    cases = [scene_cases(folder) for folder in flags.scenes]
    if flags.photos:
        cases.append(painted_cases(flags.scratch, flags.photos, flags.first, flags.count))
    if flags.pairs:
        cases.append(pair_cases(flags.pairs))
    rows: dict[str, list[list[float]]] = {}
    lines = []
    for case in (case for each in cases for case in each):
        rainy = case.window[case.scored]
        done = restored(flags.method, weights, case, not flags.plain)
        row = [*figures(rainy, case), *figures(done, case)]
        rows.setdefault(case.group, []).append(row)
        lines.append([case.group, case.name, *(round(value, 4) for value in row)])
        write_image(
            flags.out / f"{case.group}-{case.name}.png", np.hstack([rainy, done, case.clean])
        )
    if not lines:
        raise UserError(
            "No picture of these sets can be scored.", "See the names that --help tells."
        )
    heading = ["set", "picture", *(f"rainy_{name}" for name in FIGURES), *FIGURES]
    with (flags.out / "scores.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([heading, *lines])
    print("| set | pictures | PSNR | SSIM | FLIP | PSNR in drops | PSNR outside |\n|" + "---|" * 7)
    for group, values in rows.items():
        mean = np.nanmean(values, axis=0)
        told = [f"{a:.{d}f} → {b:.{d}f}" for a, b, d in
                zip(mean[:5], mean[5:], (2, 3, 3, 2, 2), strict=True)]  # fmt: skip
        print(f"| {group} | {len(values)} |", " | ".join(told), "|")


def _last_map(network: nn.Module, bgr: Tensor) -> Tensor:
    maps = network(bgr)
    last: Tensor = maps[-1]
    return last


def _unit(photo: np.ndarray) -> np.ndarray:
    return photo.astype(np.float32) / 255


if __name__ == "__main__":
    main()
