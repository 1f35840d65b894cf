"""Numbers for a scene: held-out views, composites, masks and poses against what is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from pipeline.errors import UserError
from pipeline.evaluation import flip, lpips
from pipeline.evaluation.poses import pose_numbers, read_true_cameras
from pipeline.evaluation.references import find_references
from pipeline.evaluation.rounds import score_rounds
from pipeline.evaluation.score import Files, score_image
from pipeline.evaluation.summary import as_csv, conventions, headline, summarise
from pipeline.io.atomic import write_with_json
from pipeline.io.scene import ImageRecord, read_images_json
from pipeline.io.transforms import read_transforms
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run


class Params(Section):
    """The section `evaluate` of params.yaml."""

    lpips_backbone: str | None
    coverage_threshold: Annotated[float, Field(ge=0, lt=1)]


def main(job: Job, params: Params) -> str:
    """Writes metrics.json and metrics.csv; returns the headline."""
    paths = job.paths
    records = read_images_json(paths.images)
    views = read_transforms(paths.poses / "transforms.json")
    if not paths.views.is_dir():
        raise UserError(f"{paths.views} does not exist.", "Run `python -m stages.render` first.")
    backbone = job.resolve(params.lpips_backbone) if params.lpips_backbone else None
    if backbone is not None:
        lpips.load_lpips(backbone)  # once here, so that a wrong file is told before the work begins
    files = _files(job, records)
    rows = map_named(
        score_image,
        {name: (entry, params.coverage_threshold, backbone) for name, entry in files.items()},
        job_label="evaluate",
        scheduler=job.scheduler,
    )
    metrics = summarise(rows, _reasons(job, files, backbone))
    truth = paths.truth / "cameras.json"
    metrics["poses"] = pose_numbers(
        {name: view.cam_from_world for name, view in views.items()},
        read_true_cameras(truth, records),
        len(records),
        _without(job, "true cameras", truth),
    )
    held_out = [record.name for record in records if record.split == "test"]
    metrics["judged"] = {
        "held_out": held_out,
        "views": [name for name in held_out if files[name].test],
    }
    metrics["rounds"] = score_rounds(paths.refine, files, params.coverage_threshold)
    metrics["conventions"] = conventions(params.coverage_threshold)
    table = {record.name: {"split": record.split, **rows[record.name]} for record in records}
    write_with_json(paths.metrics_csv, as_csv(table), paths.metrics, metrics)
    return headline(metrics)


def _files(job: Job, records: Sequence[ImageRecord]) -> dict[str, Files]:
    paths = job.paths
    clean = find_references(paths.truth / "clean", records)
    coverage = find_references(paths.truth / "coverage", records)

    def view(kind: str, name: str) -> Path | None:
        path = paths.views / kind / name
        return path if path.is_file() else None

    return {
        record.name: Files(
            record=record,
            source=paths.data / record.source,
            photo=paths.images / record.name,
            keep_mask=paths.refine / record.name,
            # A variant may show all of its photos there, those to learn from too (experiments/tables/).
            test=view("test", record.name) if record.split == "test" else None,
            fitted=view("input", record.name) or view("test", record.name),
            composite=view("composite", record.name),
            clean=clean[record.name] if clean else None,
            coverage=coverage[record.name] if coverage else None,
        )
        for record in records
    }


def _reasons(job: Job, files: Mapping[str, Files], backbone: Path | None) -> dict[str, str]:
    reasons = {}
    for kind, what in (("clean", "clean references"), ("coverage", "true masks")):
        if not any(getattr(entry, kind) for entry in files.values()):
            reasons[kind] = _without(job, what, job.paths.truth / kind)
    if backbone is None:
        reasons["lpips"] = "evaluate.lpips_backbone names no AlexNet weights"
    if not flip.AVAILABLE:
        reasons["flip"] = flip.UNAVAILABLE
    absent = {
        "test": "no held-out view was rendered",
        "fitted": "no view was rendered at a photo's pose",
        "composite": "no composite was made",
    }
    for kind, text in absent.items():
        if not any(getattr(entry, kind) for entry in files.values()):
            reasons[kind] = text
    return reasons


def _without(job: Job, what: str, path: Path) -> str:
    return f"there are no {what}: {path.relative_to(job.root).as_posix()} does not exist"


if __name__ == "__main__":
    run("evaluate", Params, main)
