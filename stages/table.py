"""The comparison's tables and crops, out of the metrics of every scene, row and seed that there are."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.errors import UserError
from pipeline.io.accounts import read_metrics
from pipeline.io.atomic import publish_dir, write_text
from pipeline.io.images import read_image, write_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import read_images_json
from pipeline.stage import Job, Section, run
from pipeline.tables import compose, reading
from pipeline.tables.crops import busiest_window, side_by_side
from pipeline.tables.rows import ROWS
from pipeline.tables.settings import noted
from pipeline.tables.writers import as_csv, latex, markdown

PICTURES = {
    "NeRF": "nerf-{}", "AttGAN": "attgan", "Quan": "quan", "Wen": "wen", "no mean map": "unaveraged-{}",
    "DerainNeRF": "derain-{}", "with the loop": "loop-{}", "true masks": "true-{}",
}  # fmt: skip


class Params(Section):
    """The section `table` of params.yaml."""

    title: str
    scenes: list[str]
    lens: list[str]
    seeds: Annotated[list[int], Field(min_length=1)]
    notes: list[str]


def main(job: Job, params: Params) -> str:
    """Makes `tables/`: each table as Markdown, CSV and LaTeX, and one strip of crops per scene."""
    found: dict[tuple[str, str, str], dict[int, float]] = defaultdict(dict)
    missing: dict[tuple[str, str], str] = {}
    unscored: dict[tuple[str, str], str] = {}
    poses, conventions, made = {}, {}, {}
    for scene in params.scenes:
        for row in ROWS:
            lacking = []
            for seed in params.seeds if row.seeded else params.seeds[:1]:
                paths = ScenePaths(job.root, scene, f"{row.key}-{seed}" if row.seeded else row.key)
                if not paths.metrics.is_file():
                    lacking.append(seed)
                    some = lacking if row.seeded and lacking != params.seeds else []
                    missing[scene, row.id] = reading.why_missing(row, some, scene in params.lens)
                    continue
                metrics = read_metrics(paths.metrics)
                made[scene, row.key, seed] = paths.metrics
                poses[scene], conventions = metrics["poses"], metrics["conventions"]
                scores = reading.read_view_scores(paths.metrics_csv, row)
                if "psnr" not in scores:
                    unscored[scene, row.id] = reading.why_unscored(metrics, row)
                for name, value in (scores | reading.mask_scores(metrics, row)).items():
                    found[scene, row.id, name][seed] = value
                for name, value in reading.gathered_scores(metrics, row).items():
                    found[scene, "gathered", name][seed] = value
    if not poses:
        raise UserError("No row of the comparison has metrics yet.", "Run `make tables` first.")
    told = [*params.notes, *(f"{name}: {conventions[name]}." for name in ("psnr", "ssim", "flip"))]
    told.append(compose.lpips_note(found, str(conventions["lpips_net"])))
    gaps = missing | unscored
    tables = [
        compose.comparison(found, params.scenes, gaps, told),
        compose.paper_comparison(),
        compose.gains(found, params.scenes, gaps),
        compose.ablation(found, params.lens, gaps),
        compose.mask_quality(found, params.scenes, missing, float(conventions["mask_threshold"])),
        compose.pose_quality(poses, params.scenes),
    ]
    tables = noted(tables, job.root, made)
    with publish_dir(job.paths.tables) as fresh:
        for table in tables:
            write_text(fresh / f"{table.name}.csv", as_csv(table))
            write_text(fresh / f"{table.name}.tex", latex(table))
        pages = [f"# {params.title}\n", *(markdown(table) for table in tables)]
        write_text(fresh / "tables.md", "\n".join(pages))
        for scene in params.scenes:
            _strip(ScenePaths(job.root, scene), params.seeds[0], fresh / f"{scene}.png")
    runs = sum(len(values) for (_, _, name), values in found.items() if name == "psnr")
    return f"{runs} scores, {len(gaps)} cells without all of their runs, in {job.paths.tables}"


def _strip(paths: ScenePaths, seed: int, out: Path) -> None:
    """The held-out view with the most water, there where it is; nothing where there is no such view."""
    small = paths.small
    records = read_images_json(small / "images") if small.is_dir() else []
    held_out = [record for record in records if record.split == "test"]
    water = {r.name: ~read_keep_mask(small / "true" / r.name, r.size) for r in held_out}
    if not water:
        return
    name = max(water, key=lambda one: float(water[one].mean()))
    size = (water[name].shape[1] // 2, water[name].shape[0] // 2)
    corner = busiest_window(water[name].astype(np.float32), size)
    files = {"wet photo": small / "images" / name}
    for label, variant in PICTURES.items():
        fit = ScenePaths(paths.root, paths.scene, variant.format(seed))
        files[label] = fit.views / "test" / name
    files["clean photo"] = small / "clean" / name
    pictures = {label: read_image(path) for label, path in files.items() if path.is_file()}
    write_image(out, side_by_side(pictures, corner, size, scale=2 if size[0] <= 100 else 1))


if __name__ == "__main__":
    run("table", Params, main)
