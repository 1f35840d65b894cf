"""The tables of the comparison out of the scores of every scene, row and seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.tables.layout import Column, Line, Table, Values
from pipeline.tables.rows import PAPER, PAPER_ABLATION, PAPER_METRICS, PAPER_SCENES, ROWS
from pipeline.tables.statistics import better_beyond_spread, mean

# scene, row, number -> the values by seed
Scores = Mapping[tuple[str, str, str], Mapping[int, float]]
# scene, row -> why it has no numbers, or not for every seed
Missing = Mapping[tuple[str, str], str]

NUMBERS = {
    "psnr": ("PSNR", 2, True),
    "ssim": ("SSIM", 3, True),
    "flip": ("FLIP", 3, False),
    "lpips": ("LPIPS", 3, False),
}
GAINS = (
    ("derain", "nerf", "DerainNeRF as in the paper over NeRF"),
    ("loop", "nerf", "DerainNeRF with the loop over NeRF"),
    ("loop", "derain", "the loop over DerainNeRF as in the paper"),
    ("derain", "unaveraged", "the mean map over none"),
    ("loop", "attgan", "with the loop over AttGAN"),
    ("loop", "quan", "with the loop over Quan et al."),
    ("loop", "wen", "with the loop over Wen et al."),
    ("loop", "on-attgan", "with the loop over NeRF+AttGAN"),
    ("loop", "on-quan", "with the loop over NeRF+Quan et al."),
    ("loop", "on-wen", "with the loop over NeRF+Wen et al."),
    ("true", "loop", "the true masks over the loop"),
    ("clean", "true", "clean photos over the true masks"),
)


def comparison(
    scores: Scores, scenes: Sequence[str], missing: Missing, notes: Sequence[str]
) -> Table:
    """Table I: every row on every scene. LPIPS has a column where any row has it."""
    names = [n for n in NUMBERS if n != "lpips" or any(key[2] == n for key in scores)]
    lines = tuple(Line(row.id, row.label, row.competes) for row in ROWS)
    columns = tuple(Column(f"{scene} {n}", scene, *NUMBERS[n]) for scene in scenes for n in names)
    cells = {(row, f"{scene} {n}"): _values(scores, scene, row, n) for scene, row, n in scores}
    gaps = {(row, f"{scene} {n}"): why for (scene, row), why in missing.items() for n in NUMBERS}
    return Table("comparison", "Every method on every scene, held-out views", lines, columns, cells,
                 gaps, notes=tuple(notes))  # fmt: skip


def lpips_note(scores: Scores, net: str) -> str:
    """What the comparison says of LPIPS, by the network `net`."""
    if any(name == "lpips" for _, _, name in scores):
        return f"LPIPS: {net}."
    return f"LPIPS ({net}) is left out: its weights cannot be shipped; see evaluate.lpips_backbone."


def paper_comparison() -> Table:
    """The paper's Table I, on its scenes and with its numbers."""
    lines = tuple(Line(name, name) for name in PAPER)
    columns = tuple(
        Column(f"{scene} {n}", scene, NUMBERS[n][0], 4, NUMBERS[n][2])
        for scene in PAPER_SCENES
        for n in PAPER_METRICS
    )
    cells = {
        (name, f"{scene} {n}"): (value,)
        for name, scenes in PAPER.items()
        for scene, values in zip(PAPER_SCENES, scenes, strict=True)
        for n, value in zip(PAPER_METRICS, values, strict=True)
    }
    note = "Other scenes than ours, 200,000 steps on a GPU, LPIPS with a net that the paper does not name."
    return Table("paper", "The paper's own Table I", lines, columns, cells, notes=(note,))


def gains(scores: Scores, scenes: Sequence[str], missing: Missing) -> Table:
    """How many dB of PSNR one row is ahead of another, here and in the paper.

    A cell here is marked when the gain (or the loss) is larger than the spreads of both rows together,
    but never when a row has the value of a single seed where more are wanted: its spread is not known.
    """
    labels = {"derain": "DerainNeRF"} | {row.key: row.paper for row in ROWS if row.key != "derain"}
    cells: dict[tuple[str, str], Values] = {}
    gaps, marked = {}, set()
    for one, other, label in GAINS:
        for scene in scenes:
            place = (label, f"here {scene}")
            a, b = (_values(scores, scene, key, "psnr") for key in (one, other))
            partly = [
                (values, missing.get((scene, key), "not computed"))
                for key, values in ((one, a), (other, b))
                if not values or (scene, key) in missing
            ]
            if partly:  # of a row without values rather than of one that lacks some
                gaps[place] = min(partly, key=lambda row: bool(row[0]))[1]
            if a and b:
                cells[place] = (mean(a) - mean(b),)
                sure = all(len(values) > 1 for values, _ in partly)
                if sure and (better_beyond_spread(a, b) or better_beyond_spread(b, a)):
                    marked.add(place)
        for i, scene in enumerate(PAPER_SCENES):
            ours = "DerainNeRF" if one in ("loop", "derain") else ""
            theirs = labels[other]
            if ours and theirs in PAPER and theirs != ours:
                gain = PAPER[ours][i][0] - PAPER[theirs][i][0]
                cells[label, f"paper {scene}"] = (gain,)
            else:
                gaps[label, f"paper {scene}"] = "the paper has no such figures by scene"
    lines = tuple(Line(label, label, False) for _, _, label in GAINS)
    columns = tuple(Column(f"here {s}", "here", s, 2, None) for s in scenes)
    columns += tuple(Column(f"paper {s}", "paper", s, 2, None) for s in PAPER_SCENES)
    notes = (
        "*: larger than both spreads together. Between two rows without seeds nothing is claimed.",
        "Paper: its DerainNeRF, which has no loop, over the same row.",
    )
    return Table(
        "gains", "Gains in PSNR, dB", lines, columns, cells, gaps, frozenset(marked), notes
    )


def ablation(scores: Scores, lens: Sequence[str], missing: Missing) -> Table:
    """Table II: the mean over the scenes with drops on the lens, by seed, beside the paper's.

    Of the seeds that every scene has: a mean over two seeds' runs would be no run's.
    """
    keys = ("unaveraged", "derain", "loop")
    rows = {row.key: row.label for row in ROWS if row.kind == "test"}
    columns = [Column(f"here {n}", "here", *NUMBERS[n]) for n in ("psnr", "ssim", "flip")]
    columns += [
        Column(f"paper {n}", "paper", NUMBERS[n][0], 4, NUMBERS[n][2]) for n in PAPER_METRICS
    ]
    cells: dict[tuple[str, str], Values] = {}
    gaps = {("loop", column.key): "the paper has no loop" for column in columns[3:]}
    for key in keys:
        for n in ("psnr", "ssim", "flip"):
            by_scene = [scores.get((scene, key, n), {}) for scene in lens]
            seeds = [s for s in next(iter(by_scene), ()) if all(s in some for some in by_scene)]
            if seeds:
                cells[key, f"here {n}"] = tuple(mean([some[s] for some in by_scene]) for s in seeds)
            if any((scene, key) in missing for scene in lens):
                gaps[key, f"here {n}"] = (
                    "not computed or not judged, or not for every scene and seed"
                )
        for n, value in zip(PAPER_METRICS, PAPER_ABLATION.get(key, ()), strict=False):
            cells[key, f"paper {n}"] = (value,)
    note = f"Here: mean over {', '.join(lens)}. Paper: as printed, mean over Tanabata, Factory and Church."
    lines = tuple(Line(key, rows[key]) for key in keys)
    return Table("ablation", "The mean map (equation 5), drops on the lens", lines, tuple(columns),
                 cells, gaps, notes=(note,))  # fmt: skip


def mask_quality(scores: Scores, scenes: Sequence[str], missing: Missing, covered: float) -> Table:
    """How well the masks agree with the true coverage, at the size of the fits.

    scores: numbers "precision", "recall" and "iou" of the rows unaveraged, derain, gathered, loop.
    """
    labels = {
        "unaveraged": "each view's own (equation 3)",
        "derain": "as drawn (equation 5 on the lens)",
        "gathered": "gathered on the glass",
        "loop": "after the loop",
    }
    names = {"precision": "precision", "recall": "recall", "iou": "IoU"}
    columns = tuple(Column(f"{s} {n}", s, h, 3) for s in scenes for n, h in names.items())
    cells = {
        (row, f"{s} {n}"): _values(scores, s, row, n)
        for s, row, n in scores
        if row in labels and n in names
    }
    gaps = {(row, f"{s} {n}"): why for (s, row), why in missing.items() for n in names}
    # Gathered by the loop's first round.
    gaps |= {("gathered", place): why for (row, place), why in gaps.items() if row == "loop"}
    lines = tuple(Line(key, label) for key, label in labels.items())
    note = f"A pixel is truly covered when its coverage is above {covered:g}; pixels of all views pooled."
    return Table(
        "masks", "Masks against the true coverage", lines, columns, cells, gaps, notes=(note,)
    )


def pose_quality(poses: Mapping[str, Mapping[str, float]], scenes: Sequence[str]) -> Table:
    """The poses that all rows of a scene share. poses: by scene, the group `poses` of its metrics."""
    columns = (
        Column("registered", "", "registered", 0, None),
        Column("total", "", "of", 0, None),
        Column("rotation_deg", "", "rotation, degrees", 3, None),
        Column("rotation_deg_max", "", "at most", 3, None),
        Column("translation", "", "centre, m", 4, None),
        Column("translation_max", "", "at most", 4, None),
        Column("extent", "", "extent of the path, m", 3, None),
    )
    cells = {
        (scene, column.key): (float(poses[scene][column.key]),)
        for scene in scenes
        for column in columns
        if poses.get(scene, {}).get(column.key) is not None
    }
    note = (
        "Estimated from the wet photos with their masks, and shared by all rows of a scene: rows differ in "
        "pixels and masks alone. Mean and largest error after alignment with the true cameras."
    )
    lines = tuple(Line(scene, scene, False) for scene in scenes)
    return Table("poses", "Poses", lines, columns, cells, notes=(note,))


def _values(scores: Scores, scene: str, row: str, number: str) -> Values:
    """The values of all seeds that there are."""
    return tuple(scores.get((scene, row, number), {}).values())
