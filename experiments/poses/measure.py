"""Poses under rain: how many photos are placed, and how far off, with and without masks.

    python -m experiments.poses.measure --demo data/demo --photos PATH [--scenes DIR ...] --out DIR
    python -m experiments.poses.measure --scenes DIR ... --artifacts DIR --ways plain --out DIR

Every capture is solved in several ways: `plain` (no masks, every match counts),
`filter` (no masks, matches that stay at their pixel are dropped), `detected` (masks of the shipped
detector, where the scene has been through `masks`), `true` (masks from the true coverage), each in
one attempt; and `retried`, true masks with the further attempts that the stage makes.
`--demo` and `--scenes` are folders that `synthesize` made, solved wet and dry; the demo's clean views
are also wetted with heavy drops, the same in all. `--ways` solves in these alone. `--artifacts` adds
what the stages made of the scenes, `stage`: DIR/<scene>/poses is compared with the truth. `--photos`
are dry photos without truth: poses of the dry ones stand for it. Results go to DIR/<case>-<way>.json,
one at a time; what is there is not done again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from experiments.command import sentences
from pipeline.drops.synthesis import painted
from pipeline.errors import UserError
from pipeline.geometry.poses import pose_errors
from pipeline.io.atomic import write_json
from pipeline.io.images import read_image, write_image
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.photos import convert, examine, final_size, list_photos, plan_sizes
from pipeline.io.transforms import read_transforms
from pipeline.sfm import Settings, reconstruct

LONGEST = 800
COVERED = 0.05
HEAVY = (0.2, 0.3)
PLAIN = Settings(
    camera="single", matcher="exhaustive", mapper="incremental", max_features=4096,
    max_image_size=0, masked=False, still=False, refine_focal=True, refine_distortion=True,
)  # fmt: skip
WAYS = {
    "plain": PLAIN,
    "filter": replace(PLAIN, still=True),
    "detected": replace(PLAIN, masked=True),
    "true": replace(PLAIN, masked=True),
    "retried": replace(PLAIN, masked=True),
}
REFERENCE = "plain"  # of dry photos, where there is no truth
Poses = dict[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A capture on disk: images of one size, masks by way, focal lengths, true poses if known."""

    name: str
    images: Path
    masks: dict[str, Path]
    focal_px: dict[str, float]
    truth: Poses | None


def _brought_in(photos: Path, target: Path) -> dict[str, float]:
    """The photos of a folder as `ingest` makes them; their focal lengths where known."""
    sources = list_photos(photos, 3)
    facts = {name: examine(path) for name, path in sources.items()}
    plan = plan_sizes(facts)
    size = final_size(plan.size, LONGEST)
    focal = {}
    for name, degrees in plan.turns.items():
        if not (target / name).is_file():
            convert(sources[name], target / name, degrees, size)
        record = facts[name].record(name, "", degrees, size)
        if record.focal_px:
            focal[name] = record.focal_px
    return focal


def _true_masks(coverage: Path, images: Path, target: Path) -> Path:
    for path in sorted(images.glob("*.png")):
        share = cv2.imread(str(coverage / path.name), cv2.IMREAD_GRAYSCALE)
        assert share is not None, coverage / path.name
        write_keep_mask(target / path.name, share <= COVERED * 255)
    return target


def _true_poses(file: Path) -> Poses:
    frames = json.loads(file.read_text())["frames"]
    return {f"{stem}.png": np.array(frame["cam_from_world"]) for stem, frame in frames.items()}


def _made_scene(folder: Path, out: Path) -> Case:
    """A scene with truth; the detector's masks are taken from its artifacts."""
    images = out / "cases" / folder.name / "images"
    _brought_in(folder, images)
    true = _true_masks(folder / "truth/coverage", images, images.parent / "true")
    detected = folder.parents[1] / "artifacts" / folder.name / "masks"
    masks = {"true": true} | ({"detected": detected} if detected.is_dir() else {})
    return Case(folder.name, images, masks, {}, _true_poses(folder / "truth/cameras.json"))


def _dried(folder: Path, case: Case, out: Path) -> Case:
    """The clean views of a scene."""
    images = out / "cases" / f"{folder.name}-dry" / "images"
    _brought_in(folder / "truth/clean", images)
    return Case(f"{folder.name}-dry", images, {}, {}, case.truth)


def _wetted(case: Case, coverage: float, seed: int = 5) -> Case:
    """The images of `case` seen through one wet pane at the lens."""
    name = f"{case.name}-{round(100 * coverage)}%"
    folder = case.images.parents[1] / name
    for path in sorted(case.images.glob("*.png")):
        if (folder / "true" / path.name).is_file():
            continue
        dry = np.rint(read_image(path) * 255).astype(np.uint8)
        wet, share = painted(
            dry, seed=seed, pane_m=0.12, coverage=coverage, radius_mm=(1.5, 5.0),
            aperture_mm=1.0, field_of_view_deg=62.0,
        )  # fmt: skip
        write_image(folder / "images" / path.name, wet)
        write_keep_mask(folder / "true" / path.name, share <= COVERED)
    return Case(name, folder / "images", {"true": folder / "true"}, case.focal_px, case.truth)


def masks_of(way: str) -> str:
    """The masks that a way uses."""
    return "true" if way == "retried" else way


def _solve(case: Case, way: str, out: Path) -> tuple[dict[str, object], Poses]:
    names = sorted(path.name for path in case.images.glob("*.png"))
    masks, start = case.masks.get(masks_of(way)), time.monotonic()
    row: dict[str, object] = {"case": case.name, "way": way, "total": len(names)}
    if masks is not None:
        kept = [read_keep_mask(masks / name).mean() for name in names]
        row["masked"] = round(1 - float(np.mean(kept)), 4)
    try:
        found = reconstruct(
            case.images, masks, names, work_dir=out / "work", settings=WAYS[way],
            focal_px=case.focal_px, retry=way == "retried",
        )  # fmt: skip
    except UserError as error:
        return row | {"registered": 0, "failed": str(error)}, {}
    poses = {name: view.cam_from_world for name, view in found.views.items()}
    row |= {
        "registered": len(poses),
        "points": len(found.points_xyz),
        "reprojection_px": round(found.reprojection_px, 4),
        "focal_px": round(float(np.median([view.fx for view in found.views.values()])), 2),
        "k1": round(float(np.median([view.k1 for view in found.views.values()])), 5),
        "attempt": next(one.label for one in found.attempts if one.chosen),
        "models": found.model_sizes,
        "lost": [image.name for image in found.lost],
        "seconds": round(time.monotonic() - start, 1),
    }
    return row, poses


def _against(poses: Poses, truth: Poses | None) -> dict[str, float]:
    """Errors after alignment; the places in percent of the cameras' extent."""
    if truth is None or len(poses) < 3:
        return {}
    errors = pose_errors(poses, truth)
    turns, off = list(errors.rotation_deg.values()), list(errors.centre.values())
    return {
        "rotation_deg": round(float(np.mean(turns)), 4),
        "rotation_deg_max": round(float(np.max(turns)), 4),
        "centre_percent": round(100 * float(np.mean(off)) / errors.extent, 4),
        "centre_percent_max": round(100 * float(np.max(off)) / errors.extent, 4),
    }


def _by_the_stage(scene: Path, poses: Path) -> tuple[dict[str, object], Poses]:
    """The row of what the stage `poses` left for a scene."""
    told = json.loads((poses / "poses.json").read_text())
    found = {
        n: view.cam_from_world for n, view in read_transforms(poses / "transforms.json").items()
    }
    kept = [read_keep_mask(poses.parent / "masks" / name).mean() for name in sorted(found)]
    return {
        "case": scene.name, "way": "stage", "total": told["total"], "registered": len(found),
        "masked": round(1 - float(np.mean(kept)), 4), "points": told["points"],
        "reprojection_px": round(told["reprojection_px"], 4), "focal_px": told["focal_px"],
    }, found  # fmt: skip


def _cases(demo: Path | None, scenes: list[Path], photos: Path | None, out: Path) -> Iterator[Case]:
    if demo is not None:
        case = _made_scene(demo, out)
        yield case
        clean = _dried(demo, case, out)
        yield clean
        yield from (_wetted(clean, coverage) for coverage in HEAVY)
    for folder in scenes:
        case = _made_scene(folder, out)
        yield case
        yield _dried(folder, case, out)
    if photos is not None:
        dry = out / "cases" / photos.parent.name / "images"
        focal = _brought_in(photos, dry)
        clean = Case(photos.parent.name, dry, {}, focal, None)
        yield clean
        reference = json.loads((out / f"{clean.name}-{REFERENCE}.json").read_text())["poses"]
        truth = {name: np.array(pose) for name, pose in reference.items()}
        yield from (_wetted(replace(clean, truth=truth), coverage) for coverage in HEAVY)


def table(out: Path) -> str:
    """A Markdown table of all results in `out`."""
    rows = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    order = {way: index for index, way in enumerate([*WAYS, "stage"])}
    lines = [
        "| capture | way | masked | placed | points | error, px | turn, ° (largest) | place, % (largest) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: (row["case"], order[row["way"]])):
        cells = [row["case"], row["way"], f"{row['masked']:.0%}" if "masked" in row else ""]
        cells += [f"{row['registered']}/{row['total']}", str(row.get("points", ""))]
        cells.append(f"{row['reprojection_px']:.2f}" if "reprojection_px" in row else "")
        for name, form in (("rotation_deg", ".3f"), ("centre_percent", ".2f")):
            known = name in row
            cells.append(f"{row[name]:{form}} ({row[name + '_max']:{form}})" if known else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _keep(file: Path, row: dict[str, object], poses: Poses, truth: Poses | None) -> None:
    row |= _against(poses, truth)
    write_json(file, row | {"poses": {name: pose.tolist() for name, pose in poses.items()}})
    print(json.dumps(row), flush=True)


@sentences()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--demo", type=Path)
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--artifacts", type=Path)
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--table", action="store_true", help="only print what DIR holds")
    flags = parser.parse_args()
    if flags.table:
        print(table(flags.out))
        return
    if flags.photos and REFERENCE not in flags.ways:
        reference = flags.out / f"{flags.photos.parent.name}-{REFERENCE}.json"
        if not reference.is_file():
            parser.error(f"--photos: {reference} stands for the truth; add {REFERENCE} to --ways")
    for case in _cases(flags.demo, flags.scenes, flags.photos, flags.out):
        for way in flags.ways:
            file = flags.out / f"{case.name}-{way}.json"
            if file.is_file() or (WAYS[way].masked and masks_of(way) not in case.masks):
                continue
            _keep(file, *_solve(case, way, flags.out), case.truth)
    for folder in flags.scenes if flags.artifacts else []:
        truth = _true_poses(folder / "truth/cameras.json")
        row, poses = _by_the_stage(folder, flags.artifacts / folder.name / "poses")
        _keep(flags.out / f"{folder.name}-stage.json", row, poses, truth)


if __name__ == "__main__":
    main()
