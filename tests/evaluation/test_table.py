from __future__ import annotations

from pathlib import Path

from pipeline.evaluation.table import gains, label_of, main, table
from pipeline.io.atomic import write_json

MASKED = {
    "test": {"psnr": 28.456, "ssim": 0.91, "lpips": None, "lpips_reason": "no weights"},
    "masks": {"iou": 0.85},
    "poses": {"registered": 24, "total": 24},
}
UNMASKED = {"test": {"psnr": 22.0, "ssim": 0.8}, "poses": {"registered": 24, "total": 24}}


def test_rows_align_and_gaps_are_explained():
    lines = table({"demo": MASKED, "demo unmasked": UNMASKED}).splitlines()
    assert len({len(line) for line in lines[:4]}) == 1
    assert lines[2].startswith("| demo          |     28.46 | 0.910 |    0.850 |")
    assert lines[4] == "Not measured, since no weights: LPIPS."


def test_what_cannot_be_measured_is_told_once_under_its_heading():
    none = {
        "psnr": None,
        "psnr_reason": "there is no truth",
        "ssim": None,
        "ssim_reason": "there is no truth",
    }
    lines = table({"garden": {"test": none, "composite": none}}).splitlines()
    assert lines[3:] == [
        "Not measured, since there is no truth: test PSNR, SSIM, composite PSNR, composite SSIM."
    ]


def test_numbers_of_other_pixels_or_photos_are_told_apart():
    """Covered are the pixels of a fit's own masks; composites are of all photos that were rendered."""
    own = {"masks": {"coverage": 0.2}, "covered": {"psnr": 20.0}, "kept": {"psnr": 30.0}}
    own |= {"input": {"psnr": 21.0}, "composite": {"psnr": 31.0, "ssim": None}}
    assert "differ" not in table({"a": own, "b": own})
    lines = table({"a": own, "b": own | {"masks": {"coverage": 0.25}}}).splitlines()
    assert lines[4:] == [
        "The fits' masks differ: each is judged on pixels of its own in covered PSNR, kept PSNR."
    ]
    lines = table({"a": own, "b": own | {"input": {"psnr": 22.0}}}).splitlines()
    assert lines[4:] == [
        "The fits' photos differ: each is judged on photos of its own in composite PSNR, photo PSNR."
    ]
    assert "differ" not in table({"a": own, "b": {"masks": {"coverage": 0.25}}})


def test_the_gain_is_told_when_both_are_known():
    assert (
        gains({"demo": MASKED, "raw": UNMASKED}) == "demo over raw: +6.46 dB on held-out views.\n"
    )
    assert gains({"demo": MASKED, "raw": {"test": {"psnr": None}}}) == ""


def test_labels_come_from_places():
    assert label_of(Path("artifacts/demo/metrics.json")) == "demo"
    assert label_of(Path("/x/artifacts/demo/unmasked/metrics.json")) == "demo unmasked"


def test_the_command(tmp_path, capsys):
    path = tmp_path / "artifacts" / "demo" / "metrics.json"
    write_json(path, MASKED | {"conventions": {"mask_threshold": 0.05}})
    assert main([str(path)]) == 0
    assert "28.46" in capsys.readouterr().out
    assert main([str(path.with_name("none.json"))]) == 2
    assert "none.json does not exist" in capsys.readouterr().err
    assert main([]) == 2
    other = tmp_path / "before" / "artifacts" / "demo" / "metrics.json"
    write_json(other, MASKED | {"conventions": {"mask_threshold": 0.05}})
    assert main([str(path), str(other)]) == 0
    told = capsys.readouterr().out
    assert str(path) in told and str(other) in told  # not one of the two as "demo"


def test_views_that_were_lost_do_not_make_a_fit_better() -> None:
    names = ["a.png", "b.png"]
    own = {"test": {"psnr": 34.0}, "judged": {"held_out": names, "views": names[:1]}}
    other = {"test": {"psnr": 22.0}, "judged": {"held_out": names, "views": names}}
    assert (
        "The fits' held-out views differ: each is judged on views of its own in test PSNR."
        in table({"a": own, "b": other})
    )
    assert gains({"a": own, "b": other}) == ""
    assert gains({"a": own, "b": {**other, "judged": own["judged"]}}).startswith(
        "a over b: +12.00 dB"
    )
