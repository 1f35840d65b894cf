"""Photos in, poses out: a first attempt, then others as long as photos are missing."""

from __future__ import annotations

import itertools
import logging
import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from pipeline.errors import UserError
from pipeline.io.images import image_size, read_image
from pipeline.io.masks import read_keep_mask
from pipeline.sfm.database import Progress, build_database, pair_count
from pipeline.sfm.mapping import map_images
from pipeline.sfm.model import (
    SMALLEST_MODEL,
    implausible,
    largest,
    points_of,
    registered_names,
    usable,
    views_of,
)  # fmt: skip
from pipeline.sfm.result import (
    LONG_VIDEO,
    Attempt,
    LostImage,
    Matching,
    Reconstructed,
    Settings,
)
from pipeline.sfm.turning import turns_alone

log = logging.getLogger(__name__)

FEWEST_MATCHES = 15  # pycolmap verifies no pair with fewer
FEWEST_FEATURES = 50
# A later attempt that places more images wins, unless its error says that it placed them wrongly.
WORSE_ERROR = 1.5
FINE_ERROR_PX = 1.0
# A pair takes 0.36 s of a slow core with twice the features: 2,000 are 12 minutes, all of 500 photos 12 hours.
MANY_PAIRS, FEW_LOST = 2000, 0.05


@dataclass(frozen=True)
class _Try:
    label: str
    settings: Settings
    models: list[pycolmap.Reconstruction]
    matching: Matching
    turned: bool = False  # whether a model was left out because turning on the spot explains it

    @property
    def best(self) -> pycolmap.Reconstruction | None:
        return largest(self.models) if self.models else None

    @property
    def registered(self) -> int:
        return 0 if self.best is None else self.best.num_reg_images()

    @property
    def error(self) -> float:
        return float("inf") if self.best is None else self.best.compute_mean_reprojection_error()

    def beats(self, other: _Try) -> bool:
        if self.registered <= other.registered:
            return False
        return other.registered == 0 or self.error <= max(WORSE_ERROR * other.error, FINE_ERROR_PX)


def reconstruct(
    image_dir: Path,
    mask_dir: Path | None,
    names: Sequence[str],
    *,
    work_dir: Path,
    settings: Settings,
    focal_px: Mapping[str, float] | None = None,
    min_registered: float = 0.0,
    depth_margin: float = 0.2,
    retry: bool = True,
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Reconstructed:
    """The poses of the images `names` in `image_dir`, from the largest model of the best attempt.

    `mask_dir` holds keep masks of the images' sizes (255 = use), named as PNG images are,
    `<name>.png` for images of other kinds; None, or `settings.masked` False, leaves masks out.
    `focal_px` has the focal lengths that are known. With `retry`, further attempts follow while
    images are missing (`ladder`). `work_dir` is scratch and need not exist. `threads` serve
    features and matches; the result does not depend on them. UserError, naming images: unreadable
    images, masks missing or of a wrong size, no features, no matches, no model, an impossible
    model, fewer than three photos or the share `min_registered` placed.
    """
    names = sorted(names)
    if len(names) < SMALLEST_MODEL:
        raise UserError(f"{len(names)} photos in {image_dir}: poses need three or more.")
    sizes = check_inputs(image_dir, mask_dir if settings.masked else None, names)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    work_dir.mkdir(parents=True, exist_ok=True)
    report = progress if progress is not None else silent
    tries: list[_Try] = []
    best: _Try | None = None
    database = work_dir / "database.db"
    rungs = ladder(settings, mask_dir is not None, len(names))
    for label, attempt in rungs if retry else itertools.islice(rungs, 1):
        if tries and attempt.features_key() == tries[-1].settings.features_key():
            matching = tries[-1].matching
        elif best is not None and not worth_matching(
            attempt, len(names) - best.registered, len(names)
        ):
            _tell_given_up(best, names)
            break
        else:
            matching = build_database(
                database, image_dir, mask_dir, sizes, focal_px or {}, attempt,
                seed=seed, threads=threads, progress=report,
            )  # fmt: skip
        models = map_images(
            database, image_dir, work_dir, len(names), attempt, seed=seed, progress=report
        )
        tries.append(_weighed(_Try(label, attempt, models, matching), database))
        log.info("attempt (%s): %d of %d photos placed", label, tries[-1].registered, len(names))
        if best is None or tries[-1].beats(best):
            best = tries[-1]
        if best.registered == len(names):
            break
    assert best is not None  # the ladder has a first rung
    return _result(best, tries, names, min_registered, depth_margin, image_dir)


def silent(phase: str, done: int, total: int) -> None:
    """Nothing: the progress of work that nobody watches."""


def _weighed(one: _Try, database: Path) -> _Try:
    """The attempt without the models that say nothing."""
    models = [model for model in one.models if usable(model)]
    moved = [model for model in models if not turns_alone(model, database)]
    return replace(one, models=moved, turned=len(moved) < len(models))


def worth_matching(attempt: Settings, lost: int, total: int) -> bool:
    """Whether photos are matched anew for `lost` ones of `total`: for few of many that takes too long."""
    return lost >= FEW_LOST * total or pair_count(attempt.matcher, total) <= MANY_PAIRS


def _tell_given_up(best: _Try, names: Sequence[str]) -> None:
    placed = registered_names(best.best) if best.best is not None else []
    log.warning(
        "no further attempt is made to place %s: matching all photos again would take long",
        ", ".join(name for name in names if name not in set(placed)),
    )


def ladder(settings: Settings, masks_exist: bool, total: int = 0) -> Iterator[tuple[str, Settings]]:
    """The attempts in order, from what was asked for to what is left to try, each with its name.

    Of `total` photos: of many every pair is matched only where that was asked for.
    """
    yield "first", settings
    loose = replace(settings, loose=True)
    yield "placing on fewer matches", loose
    more = replace(
        loose,
        max_features=2 * settings.max_features,
        peak_threshold=settings.peak_threshold / 2,
        max_ratio=0.85,
        matcher=settings.matcher if total > LONG_VIDEO else "exhaustive",
    )
    yield "more and fainter features", more
    other = "incremental" if settings.mapper == "global" else "global"
    yield f"{other} mapper", replace(more, mapper=other)  # type: ignore[arg-type]
    if settings.masked and masks_exist:
        yield "without masks", replace(more, masked=False, still=True)


def check_inputs(
    image_dir: Path, mask_dir: Path | None, names: Sequence[str]
) -> dict[str, tuple[int, int]]:
    """Sizes by name. Everything pycolmap would pass over in silence is refused here."""
    sizes, unreadable, unmasked = {}, [], []
    for name in names:
        try:
            sizes[name] = image_size(image_dir / name)
            read_image(
                image_dir / name
            )  # all of it: pycolmap sees no features in what is cut short
        except (OSError, UserError):
            unreadable.append(name)
            continue
        if mask_dir is not None:
            path = mask_dir / (name if name.endswith(".png") else f"{name}.png")
            if path.is_file():
                read_keep_mask(path, sizes[name])
            else:
                unmasked.append(name)
    if unreadable:
        raise UserError(
            f"{', '.join(unreadable)} in {image_dir} could not be read as an image.",
            "Run `python -m stages.ingest` again.",
        )
    if unmasked:
        raise UserError(
            f"{mask_dir} has no mask for {', '.join(unmasked)}.",
            "Run `python -m stages.masks` first, or set poses.use_masks: false.",
        )
    return sizes


def _result(
    best: _Try,
    tries: Sequence[_Try],
    names: Sequence[str],
    min_registered: float,
    depth_margin: float,
    image_dir: Path,
) -> Reconstructed:
    lost = _lost_images(best, names)
    tell_lost(lost)
    if best.best is None:
        raise UserError(*_no_model(best.matching, tries, image_dir))
    views = views_of(best.best, depth_margin)
    fault = implausible(views)
    if fault:
        raise UserError(
            f"the poses found for {image_dir} cannot be right: {fault}.",
            "Photos from different places are needed, with more overlap.",
        )
    refuse_few(
        len(views), lost, min_registered, image_dir,
        "Take photos with more overlap, or lower poses.min_registered.",
    )  # fmt: skip
    xyz, rgb, error = points_of(best.best)
    return Reconstructed(
        views=views,
        lost=lost,
        points_xyz=xyz,
        points_rgb=rgb,
        points_error=error,
        reprojection_px=best.error,
        model_sizes=_model_sizes(best),
        matching=best.matching,
        attempts=[
            Attempt(
                label=one.label,
                registered=one.registered,
                reprojection_px=one.error if one.models else None,
                model_sizes=_model_sizes(one),
                chosen=one is best,
            )
            for one in tries
        ],
        settings=best.settings,
        model=best.best,
    )


def tell_lost(lost: Sequence[LostImage]) -> None:
    """Warns of each lost image."""
    for image in lost:
        log.warning("no pose for %s", image)


def refuse_few(
    placed: int, lost: Sequence[LostImage], share: float, image_dir: Path, hint: str
) -> None:
    """UserError, with `hint`, when less than `share` of all images is placed."""
    total = placed + len(lost)
    if placed < share * total:
        raise UserError(
            f"only {placed} of {total} photos in {image_dir} could be placed "
            f"({placed / total:.0%}, poses.min_registered is {share:.0%}). "
            f"Lost: {', '.join(map(str, lost))}.",
            hint,
        )


def _model_sizes(one: _Try) -> list[int]:
    return sorted((model.num_reg_images() for model in one.models), reverse=True)


def _lost_images(best: _Try, names: Sequence[str]) -> list[LostImage]:
    placed = set(registered_names(best.best)) if best.best is not None else set()
    apart = {
        name: model.num_reg_images() for model in best.models for name in registered_names(model)
    }
    lost = []
    for name in names:
        if name in placed:
            continue
        keypoints = best.matching.keypoints[name]
        matches = best.matching.best_match[name]
        partner = best.matching.best_partner[name]
        if keypoints < FEWEST_FEATURES:
            reason = f"{keypoints} features: blank, blurred, or masked"
        elif matches < FEWEST_MATCHES:
            reason = f"{keypoints} features, but none of the other photos shows the same"
        elif name in apart:
            reason = f"placed only with {apart[name] - 1} others, apart from the rest"
        else:
            reason = f"{keypoints} features, best match {matches} with {partner}, not enough"
        lost.append(LostImage(name, keypoints, matches, partner, reason))
    return lost


def _no_model(matching: Matching, tries: Sequence[_Try], image_dir: Path) -> tuple[str, str]:
    """What to say when no attempt gave a model."""
    tried = f"Tried: {', '.join(one.label for one in tries)}."
    if any(one.turned for one in tries):
        return (
            f"the poses found for {image_dir} cannot be right: turning on the spot explains all matches. "
            f"{tried}",
            "Photos from different places are needed, with more overlap.",
        )
    if max(matching.keypoints.values()) < FEWEST_FEATURES:
        most = max(matching.keypoints, key=lambda name: matching.keypoints[name])
        return (
            f"the photos in {image_dir} show almost no features to match "
            f"(at most {matching.keypoints[most]}, in {most}). {tried}",
            "Blank, blurred or almost wholly masked photos cannot be placed; see poses.use_masks.",
        )
    best = max(matching.best_match, key=lambda name: matching.best_match[name])
    if matching.best_match[best] == 0:
        return (
            f"no two of the {len(matching.keypoints)} photos in {image_dir} match. {tried}",
            "Photos of one scene with more overlap are needed.",
        )
    return (
        f"no photo in {image_dir} could be placed: the best pair, {best} and "
        f"{matching.best_partner[best]}, has {matching.best_match[best]} matches. {tried}",
        "Photos from different places are needed, with more overlap; turning on the spot fails.",
    )
