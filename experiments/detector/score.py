"""Scores detectors per test set: precision, recall, F1 and IoU at a threshold, the best, and AP.

`python -m experiments.detector.score unet:weights/unet.safetensors --threshold 0.3 \\
    --scenes data/demo --painted artifacts/pools/photos/unseen --pairs FOLDER_OF_PAIRS \\
    --rendered artifacts/pools/rendered_unseen --dry artifacts/pools/photos/unseen`

A scene is a folder with photos and truth/coverage/, as the stage synthesize makes it; it is scored
per view, by equation 5 (view or mean map) and by the mean map alone. A pixel is wet where the true
coverage is above 0.05, and for paintings and renders a second time where the water changes a
channel by more than 30 of 255; in a photo pair (N_rain.png, N_clean.png), where any channel differs
by more than that once the photos are shifted to match. All pixels of a set are counted together.
Pairs are scored a second time without the pixels that differ by 10 to 30: water that lies before its
own colour, or edges that no shift brings together. There the difference cannot tell.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from experiments.command import sentences
from pipeline.attention.inference import attend
from pipeline.attention.pools import (
    CHUNK,
    aimed,
    list_pictures,
    paint_chunk,
    painted_name,
    read_chunk,
    read_rendered,
)  # fmt: skip
from pipeline.attention.samples import VISIBLE_COVERAGE, coverage_of_pair
from pipeline.attention.weights import Detector, load_network
from pipeline.errors import UserError
from pipeline.io.images import PHOTO_SUFFIXES, read_photo, shrink

BINS = 1000
SHIFT = 8
SURELY_DRY = 10 / 255
DRY_SIZE = 800
Case = tuple[str, np.ndarray, np.ndarray]  # name, photo (H,W,3) in [0,1], wet (H,W)


class Tally:
    """Wet and dry pixels by the value that the map gives them."""

    def __init__(self) -> None:
        self.counts = np.zeros((2, BINS))

    def add(self, found: np.ndarray, wet: np.ndarray) -> None:
        bins = np.clip((found * BINS).astype(int), 0, BINS - 1)
        for row, pixels in enumerate((bins[wet], bins[~wet])):
            self.counts[row] += np.bincount(pixels, minlength=BINS)

    def row(self, threshold: float) -> dict[str, float]:
        """The figures; hits and marks at a threshold are those of the bins from it on."""
        hits, false = self.counts[:, ::-1].cumsum(1)[:, ::-1]
        wet = max(hits[0], 1)
        precision = np.where(hits + false > 0, hits / np.maximum(hits + false, 1), 1)
        f1 = 2 * hits / np.maximum(hits + false + wet, 1)
        at, best = round(threshold * BINS), int(np.argmax(f1))
        steps = -np.diff(np.append(hits, 0)) / wet
        return {
            "P": precision[at], "R": hits[at] / wet, "F1": f1[at],
            "IoU": hits[at] / (false[at] + wet), "best F1": f1[best], "at": best / BINS,
            "AP": float((precision * steps).sum()),
        }  # fmt: skip


def scene_cases(folder: Path) -> list[Case]:
    """Photos of a scene with the truth of each."""
    cases: list[Case] = []
    for path in sorted(folder.iterdir()):
        truth = folder / "truth" / "coverage" / f"{path.stem}.png"
        if path.suffix.lower() in PHOTO_SUFFIXES and truth.is_file():
            cover = cv2.imread(str(truth), cv2.IMREAD_GRAYSCALE)
            assert cover is not None, truth
            cases.append((path.stem, _unit(read_photo(path)[0]), cover / 255 > VISIBLE_COVERAGE))
    return cases


def painted_cases(folder: Path, scratch: Path, count: int, difference: bool) -> Iterator[Case]:
    """Pictures painted on the photos of a folder; wet by coverage, or by visible difference."""
    photos = list_pictures(folder)
    chunk = scratch / painted_name(1, photos) / "0000.npy"
    paint_chunk(chunk, 1, 0, photos)
    pictures = list(zip(*read_chunk(chunk), strict=True))
    for k, (rainy, clean, cover) in enumerate(pictures[CHUNK - count :]):
        wet = coverage_of_pair(rainy, clean) > 0 if difference else cover / 255 > VISIBLE_COVERAGE
        yield f"{k:02d}", _unit(rainy), wet


def rendered_cases(folder: Path, difference: bool) -> Iterator[Case]:
    """Pictures of a folder with rainy/, clean/ and coverage/; wet as for painted ones."""
    pictures = read_rendered(folder)
    aims = aimed(pictures, "difference" if difference else "coverage")[2]
    for k, (rainy, cover) in enumerate(zip(pictures[0], aims, strict=True)):
        yield f"{k:02d}", _unit(rainy), cover / 255 > VISIBLE_COVERAGE


def pair_cases(folder: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Photo pairs, the clean photo shifted to match: as a Case, and where the truth is sure."""
    for path in sorted(folder.glob("*_rain.png")):
        rainy = read_photo(path)[0]
        clean = read_photo(path.with_name(path.name.replace("_rain", "_clean")))[0]
        rainy, clean = aligned(rainy, clean)
        wet = coverage_of_pair(rainy, clean) > 0
        sure = wet | (coverage_of_pair(rainy, clean, SURELY_DRY) == 0)
        yield path.stem, _unit(rainy), wet, sure


def aligned(rainy: np.ndarray, clean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both photos cropped so that the clean one, shifted by up to 8 pixels, fits best (median)."""
    height, width = rainy.shape[:2]
    core = rainy[SHIFT : height - SHIFT, SHIFT : width - SHIFT].astype(np.int16)

    def moved(dy: int, dx: int) -> np.ndarray:
        return clean[SHIFT + dy : height - SHIFT + dy, SHIFT + dx : width - SHIFT + dx]

    shifts = [(dy, dx) for dy in range(-SHIFT, SHIFT + 1) for dx in range(-SHIFT, SHIFT + 1)]
    error = [np.median(np.abs(core[::2, ::2] - moved(*s)[::2, ::2]).astype(float).mean(2))
             + 1e-3 * np.abs(core[::2, ::2] - moved(*s)[::2, ::2]).mean() for s in shifts]  # fmt: skip
    return core.astype(np.uint8), moved(*shifts[int(np.argmin(error))])


def _unit(photo: np.ndarray) -> np.ndarray:
    return photo.astype(np.float32) / 255


def named_detector(name: str) -> Detector:
    """The detector that MODEL:FILE names, ready for inference."""
    model, colon, file = name.partition(":")
    if not colon:
        raise UserError(f"{name} names no detector.", "Write MODEL:FILE.")
    return load_network(Path(file), model).for_inference()


@sentences()
def main() -> None:
    """Reads the command line and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("detectors", nargs="+", help="MODEL:FILE")
    parser.add_argument("--threshold", type=float, default=0.3)
    parser.add_argument("--scenes", nargs="*", type=Path, default=[])
    parser.add_argument("--every", type=int, default=1, help="every n-th photo of a scene")
    parser.add_argument("--painted", type=Path, help="folder of photos never trained on")
    parser.add_argument("--pairs", type=Path, help="folder of photo pairs")
    parser.add_argument("--rendered", type=Path, help="folder of renders never trained on")
    parser.add_argument("--dry", nargs="*", type=Path, default=[], help="folders of dry photos")
    parser.add_argument("--scales", nargs="+", type=float, default=[1.0])
    parser.add_argument("--mirrored", action="store_true", help="averaged with the mirror image's")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--scratch", type=Path, default=Path("artifacts/.work/demo/train_detector"))
    flags = parser.parse_args()
    if not 0 <= flags.threshold < 1:
        parser.error(f"--threshold {flags.threshold:g} is not in [0, 1)")
    with_mirror = ", mirrored" * flags.mirrored
    print(f"threshold {flags.threshold:g}, scales {flags.scales}{with_mirror}")
    for detector in flags.detectors:
        print(f"\n{detector}\n{'set':40s}    P     R    F1   IoU | best    at    AP")
        network = named_detector(detector)
        for name, tally in tallies(network, flags):
            figures = tally.row(flags.threshold)
            print(f"{name:40s} " + " ".join(f"{v:5.3f}" for v in figures.values()), flush=True)
        for folder in flags.dry:
            shares = dry_shares(network, folder, flags)
            worst = ", ".join(
                f"{k} {shares[k]:.1%}" for k in sorted(shares, key=lambda k: -shares[k])[:3]
            )
            mean = np.mean(list(shares.values()))
            print(f"{folder}, dry ({len(shares)}): {mean:.2%} marked; {worst}", flush=True)


def _mapped(network: Detector, photo: np.ndarray, flags: argparse.Namespace) -> np.ndarray:
    return attend(network, photo, scales=flags.scales, steps=flags.steps, mirrored=flags.mirrored)


def tallied(mapped: Callable[[np.ndarray], np.ndarray], cases: Iterable[Case]) -> Tally:
    """The pixels of all cases, each mapped by itself."""
    tally = Tally()
    for _, photo, wet in cases:
        tally.add(mapped(photo), wet)
    return tally


def dry_shares(network: Detector, folder: Path, flags: argparse.Namespace) -> dict[str, float]:
    """The share of every dry photo that is marked, by the photo's name."""
    shares: dict[str, float] = {}
    for path in list_pictures(folder)[:: flags.every]:
        photo = _unit(shrink(read_photo(path)[0], DRY_SIZE))
        shares[path.stem] = float((_mapped(network, photo, flags) >= flags.threshold).mean())
    return shares


def tallies(network: Detector, flags: argparse.Namespace) -> Iterator[tuple[str, Tally]]:
    """The tally of every test set that was asked for."""

    mapped = partial(_mapped, network, flags=flags)
    for scene in flags.scenes:
        cases = scene_cases(scene)[:: flags.every]
        maps = [mapped(photo) for _, photo, _ in cases]
        mean = np.mean(maps, axis=0)
        kinds = {"per view": maps, "equation 5": [np.maximum(m, mean) for m in maps],
                 "mean alone": [mean] * len(maps)}  # fmt: skip
        for kind, values in kinds.items():
            tally = Tally()
            for (_, _, wet), found in zip(cases, values, strict=True):
                tally.add(found, wet)
            yield f"{scene.name}, {kind} ({len(cases)})", tally
    for difference in (False, True):
        truth = "difference > 30" if difference else "coverage > 0.05"
        if flags.painted:
            painted = painted_cases(flags.painted, flags.scratch, 40, difference)
            yield f"painted, {truth}", tallied(mapped, painted)
        if flags.rendered:
            found = tallied(mapped, rendered_cases(flags.rendered, difference))
            yield f"{flags.rendered.name}, {truth}", found
    if flags.pairs:
        together, surely = Tally(), Tally()
        for name, photo, wet, sure in pair_cases(flags.pairs):
            one, found = Tally(), mapped(photo)
            one.add(found, wet)
            together.counts += one.counts
            surely.add(found[sure], wet[sure])
            yield f"{flags.pairs.name} {name}, {wet.mean():.1%} wet", one
        yield f"{flags.pairs.name}, together", together
        yield f"{flags.pairs.name}, unsure pixels left out", surely


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
