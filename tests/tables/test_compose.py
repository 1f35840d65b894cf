from __future__ import annotations

import pytest

from pipeline.tables import compose
from pipeline.tables.layout import Column, Line, Table, best
from pipeline.tables.rows import PAPER, PAPER_ABLATION, PAPER_SCENES, ROWS
from pipeline.tables.statistics import mean

SCORES = {
    ("street", "nerf", "psnr"): (20.0, 21.0, 22.0),
    ("street", "derain", "psnr"): (26.0, 27.0, 28.0),
    ("street", "loop", "psnr"): (27.0, 28.0, 29.0),
    ("street", "unaveraged", "psnr"): (25.0, 25.0, 25.0),
    ("street", "true", "psnr"): (30.0, 30.0, 30.0),
    ("pier", "nerf", "psnr"): (18.0, 18.0, 18.0),
    ("pier", "unaveraged", "psnr"): (21.0, 22.0, 23.0),
    ("pier", "derain", "psnr"): (22.0, 23.0, 24.0),
}


def test_limits_and_other_views_are_never_the_best() -> None:
    table = compose.comparison(SCORES, ["street"], {}, ["A note."])
    assert best(table, table.columns[0]) == ("loop", False)  # 1 ahead of derain, spreads 1 + 1
    assert {line.key for line in table.lines if not line.competes} == {
        "photo", "true", "clean", "composite", "composite-inputs",
    }  # fmt: skip


def test_lpips_has_a_column_only_where_it_is_known() -> None:
    def headings(scores: compose.Scores) -> list[str]:
        return [c.heading for c in compose.comparison(scores, ["street"], {}, []).columns]

    assert headings(SCORES) == ["PSNR", "SSIM", "FLIP"]
    assert headings(SCORES | {("street", "nerf", "lpips"): (0.1,)}) == [
        "PSNR",
        "SSIM",
        "FLIP",
        "LPIPS",
    ]


def test_gains_are_differences_marked_beyond_the_spreads() -> None:
    table = compose.gains(SCORES, ["street"], {("street", "attgan"): "no weights"})
    label = "DerainNeRF as in the paper over NeRF"
    assert table.cells[label, "here street"] == (6.0,)
    assert (label, "here street") in table.marked
    loop = "the loop over DerainNeRF as in the paper"
    assert table.cells[loop, "here street"] == (1.0,)
    assert (loop, "here street") not in table.marked
    assert table.missing["with the loop over AttGAN", "here street"] == "no weights"
    assert table.cells[label, "paper Tanabata"][0] == pytest.approx(6.4222)
    assert (loop, "paper Tanabata") not in table.cells


def test_the_ablation_averages_over_scenes_seed_by_seed() -> None:
    """Seed by seed over both scenes: 24, 25, 26 and 23, 23.5, 24."""
    table = compose.ablation(SCORES, ["street", "pier"])
    assert table.cells["derain", "here psnr"] == (24.0, 25.0, 26.0)
    assert table.cells["unaveraged", "here psnr"] == (23.0, 23.5, 24.0)
    assert ("loop", "here psnr") not in table.cells  # one scene lacks it
    assert table.cells["derain", "paper psnr"] == (28.3549,)


def test_the_papers_table_bolds_what_the_paper_bolds() -> None:
    """DerainNeRF in every cell but the SSIM of Tanabata-move and Factory, which are AttGAN's."""
    table = compose.paper_comparison()
    first = {column.key: best(table, column) for column in table.columns}
    others = {key for key, top in first.items() if top[0] != "DerainNeRF"}
    assert others == {"Tanabata-move ssim", "Factory ssim"}
    assert {first[key][0] for key in others} == {"AttGAN"}
    assert not any(ahead for _, ahead in first.values())  # single runs claim nothing


def test_the_papers_numbers_are_those_of_its_own_sums() -> None:
    """Means worked out beside the numbers, so that a slip of a digit shows."""
    psnr = {name: mean([scene[0] for scene in scenes]) for name, scenes in PAPER.items()}
    assert psnr["NeRF"] == pytest.approx(24.9188, abs=5e-5)
    assert psnr["Wen et al."] == pytest.approx(25.4339, abs=5e-5)
    assert psnr["NeRF+Quan et al."] == pytest.approx(25.1022, abs=5e-5)
    assert psnr["DerainNeRF"] == pytest.approx(27.9472, abs=5e-5)
    ssim = {name: mean([scene[1] for scene in scenes]) for name, scenes in PAPER.items()}
    lpips = {name: mean([scene[2] for scene in scenes]) for name, scenes in PAPER.items()}
    assert ssim["AttGAN"] == pytest.approx(0.9213, abs=6e-5)
    assert lpips["NeRF+Wen et al."] == pytest.approx(0.1217, abs=6e-5)
    assert PAPER_ABLATION["derain"][0] - PAPER_ABLATION["unaveraged"][0] == pytest.approx(1.0938)
    assert all(len(scenes) == len(PAPER_SCENES) for scenes in PAPER.values())
    assert {row.paper for row in ROWS} - {""} == set(PAPER)


def test_masks_and_poses() -> None:
    scores = {("street", "gathered", "iou"): (0.8,), ("street", "loop", "iou"): (0.9, 0.92)}
    table = compose.mask_quality(scores, ["street"], {}, 0.05)
    assert table.cells["gathered", "street iou"] == (0.8,)
    assert "0.05" in table.notes[0]
    poses = {"street": {"registered": 24, "total": 24, "rotation_deg": 0.1, "translation": None}}
    placed = compose.pose_quality(poses, ["street"])
    assert placed.cells["street", "registered"] == (24.0,)
    assert ("street", "translation") not in placed.cells


def test_rows_that_print_alike_claim_nothing_of_each_other() -> None:
    """29.564 and 29.556 are both 29.56, however small their spreads."""
    column = Column("psnr", "", "PSNR", 2)
    cells = {("one", "psnr"): (29.564, 29.5641), ("other", "psnr"): (29.556, 29.5561)}
    lines = (Line("one", "One"), Line("other", "Other"))
    assert best(Table("t", "T", lines, (column,), cells), column) == ("one", False)
    finer = Column("psnr", "", "PSNR", 3)
    assert best(Table("t", "T", lines, (finer,), cells), finer) == ("one", True)
