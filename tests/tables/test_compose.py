from __future__ import annotations

import pytest

from pipeline.tables import compose
from pipeline.tables.layout import Column, Line, Table, best
from pipeline.tables.rows import PAPER, PAPER_ABLATION, PAPER_SCENES, ROWS
from pipeline.tables.statistics import mean
from pipeline.tables.writers import as_csv, latex, markdown


def seeds(*values: float) -> dict[int, float]:
    """The values of seed 0, 1, ..."""
    return dict(enumerate(values))


SCORES = {
    ("street", "nerf", "psnr"): seeds(20.0, 21.0, 22.0),
    ("street", "derain", "psnr"): seeds(26.0, 27.0, 28.0),
    ("street", "loop", "psnr"): seeds(27.0, 28.0, 29.0),
    ("street", "unaveraged", "psnr"): seeds(25.0, 25.0, 25.0),
    ("street", "true", "psnr"): seeds(30.0, 30.0, 30.0),
    ("pier", "nerf", "psnr"): seeds(18.0, 18.0, 18.0),
    ("pier", "unaveraged", "psnr"): seeds(21.0, 22.0, 23.0),
    ("pier", "derain", "psnr"): seeds(22.0, 23.0, 24.0),
}
PARTLY = "not computed for seed 1, 2"


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
    assert headings(SCORES | {("street", "nerf", "lpips"): {0: 0.1}}) == [
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
    table = compose.ablation(SCORES, ["street", "pier"], {})
    assert table.cells["derain", "here psnr"] == (24.0, 25.0, 26.0)
    assert table.cells["unaveraged", "here psnr"] == (23.0, 23.5, 24.0)
    assert ("loop", "here psnr") not in table.cells  # one scene lacks it
    assert table.cells["derain", "paper psnr"] == (28.3549,)


def test_the_ablation_pairs_seeds_by_their_number() -> None:
    """Seed 1 of street failed: seeds 0 and 2 are averaged with pier's 0 and 2, and it is said."""
    scores = SCORES | {("street", "derain", "psnr"): {0: 26.0, 2: 28.0}}
    missing = {("street", "derain"): "not computed for seed 1"}
    table = compose.ablation(scores, ["street", "pier"], missing)
    assert table.cells["derain", "here psnr"] == (24.0, 26.0)
    assert "not for every scene and seed" in table.missing["derain", "here psnr"]
    assert ("unaveraged", "here psnr") not in table.missing
    apart = scores | {("pier", "derain", "psnr"): {1: 23.0}}
    table = compose.ablation(apart, ["street", "pier"], missing)
    assert ("derain", "here psnr") not in table.cells  # no seed that both have
    assert not compose.ablation(SCORES, [], {}).values(table.lines[1], table.columns[0])


def test_one_seed_of_several_has_no_spread_and_claims_nothing() -> None:
    """Whether all rows have the first seed alone or one has them all: numbers, no stars, no nan."""
    first = {key: {0: values[0]} for key, values in SCORES.items()}
    missing = {key[:2]: PARTLY for key in SCORES}
    ahead = first | {("street", "loop", "psnr"): seeds(27.0, 27.1, 27.2)}
    claims = {key: why for key, why in missing.items() if key != ("street", "loop")}
    for scores, lacking in ((first, missing), (ahead, claims)):
        tables = (
            compose.comparison(scores, ["street", "pier"], lacking, []),
            compose.gains(scores, ["street", "pier"], lacking),
            compose.ablation(scores, ["street", "pier"], lacking),
        )
        assert tables[0].cells["derain", "street psnr"] == (26.0,)
        assert tables[1].cells["DerainNeRF as in the paper over NeRF", "here street"] == (6.0,)
        assert tables[2].cells["derain", "here psnr"] == (24.0,)
        for table in tables:
            page, rows = markdown(table), as_csv(table)
            body = [line for line in page.splitlines() if line.startswith("| ")]
            assert not any(r"\*" in line for line in body)
            assert not any("±" in line for line in body if "(ours)" not in line)
            assert "nan" not in page + rows + latex(table)
            assert PARTLY in page or "not for every scene and seed" in page
    # With all seeds the same gap is claimed.
    assert compose.gains(SCORES, ["street"], {}).marked
    removers = ahead | {("street", "attgan", "psnr"): {0: 20.0}}  # one training: nothing lacks
    table = compose.gains(removers, ["street"], claims)
    assert table.marked == {("with the loop over AttGAN", "here street")}


def test_rows_without_any_seed_are_told_with_their_reason() -> None:
    missing = {("street", "loop"): "not computed", ("street", "derain"): PARTLY}
    scores = {("street", "derain", "psnr"): {0: 26.0}, ("street", "derain", "iou"): {0: 0.8}}
    masks = compose.mask_quality(scores, ["street"], missing, 0.05)
    assert "after the loop, street: not computed." in markdown(masks)
    assert f"as drawn (equation 5 on the lens), street: {PARTLY}." in markdown(masks)
    wider = compose.mask_quality(scores, ["street", "pier"], missing, 0.05)
    assert "after the loop: not computed." in markdown(wider)  # in either scene
    assert f"as drawn (equation 5 on the lens), street: {PARTLY}." in markdown(wider)
    assert masks.missing["gathered", "street iou"] == "not computed"
    gains = compose.gains(scores, ["street"], missing)
    label = "the loop over DerainNeRF as in the paper"
    assert not gains.cells.get((label, "here street"))
    assert gains.missing[label, "here street"] == "not computed"


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
    scores = {("street", "gathered", "iou"): {0: 0.8}, ("street", "loop", "iou"): seeds(0.9, 0.92)}
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
