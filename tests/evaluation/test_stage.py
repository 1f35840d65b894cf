from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.images import read_image, write_image
from pipeline.stage import Job
from stages.evaluate import Params, main
from tests.evaluation.fabricated import fabricate

KEYS = {
    "test": ["psnr", "ssim", "lpips"],
    "covered": ["psnr"],
    "kept": ["psnr"],
    "composite": ["psnr", "ssim"],
    "input": ["psnr", "ssim"],
    "fitted": ["psnr", "ssim"],
    "masks": ["iou", "precision", "recall", "coverage"],
    "poses": ["registered", "total", "rotation_deg", "translation"],
    "selfcheck": ["kept_psnr"],
}
NAMES = [f"{group}.{leaf}" for group, leaves in KEYS.items() for leaf in leaves]
PARAMS = Params(lpips_backbone=None, coverage_threshold=0.05)


def evaluate(root, variant=None):
    job = Job(root, "made", variant, "cpu", None, False)
    closing = main(job, PARAMS)
    return json.loads(job.paths.metrics.read_text()), closing


def test_a_scene_with_truth(tmp_path):
    paths = fabricate(tmp_path)
    metrics, closing = evaluate(tmp_path)
    for key in NAMES:
        group, leaf = key.split(".")
        assert leaf in metrics[group]
    # Views are off by 5/255 everywhere: -20 log10(5/255) = 34.151 dB.
    for group in ("test", "covered", "kept", "fitted"):
        assert metrics[group]["psnr"] == pytest.approx(34.151, abs=1e-3)
    assert metrics["composite"]["psnr"] > metrics["input"]["psnr"] + 3
    assert metrics["test"]["lpips"] is None and metrics["test"]["lpips_reason"]
    assert (metrics["poses"]["registered"], metrics["poses"]["total"]) == (8, 9)
    assert metrics["poses"]["rotation_deg"] == pytest.approx(0, abs=1e-5)
    # The made mask is coverage > 0.3 and the truth coverage > 0.05: nothing is dropped in vain.
    assert metrics["masks"]["precision"] == 1.0
    assert 0.5 < metrics["masks"]["recall"] < 1.0
    assert metrics["judged"] == {
        "held_out": ["view_00.png", "view_08.png"], "views": ["view_00.png"]
    }  # fmt: skip
    assert f"held-out views (1 of 2) {metrics['test']['psnr']:.2f} dB" in closing
    lines = paths.metrics_csv.read_text().splitlines()
    assert len(lines) == 10 and lines[1].startswith("view_00.png,test,")


def test_the_same_bytes_again_and_none_of_the_machines_paths(tmp_path):
    paths = fabricate(tmp_path)
    evaluate(tmp_path)
    first = paths.metrics.read_bytes(), paths.metrics_csv.read_bytes()
    evaluate(tmp_path)
    assert first == (paths.metrics.read_bytes(), paths.metrics_csv.read_bytes())
    assert str(tmp_path) not in paths.metrics.read_text() + paths.metrics_csv.read_text()


def test_a_variant_has_numbers_of_its_own(tmp_path):
    fabricate(tmp_path)
    masked, _ = evaluate(tmp_path)
    unmasked, _ = evaluate(tmp_path, "unmasked")
    assert (tmp_path / "artifacts/made/unmasked/metrics.json").is_file()
    assert unmasked["test"]["psnr"] == pytest.approx(masked["test"]["psnr"] - 12.041, abs=1e-3)
    assert unmasked["masks"] == masked["masks"]


def test_without_truth_everything_but_the_self_check_is_null(tmp_path):
    fabricate(tmp_path, truth=False)
    metrics, closing = evaluate(tmp_path)
    for key in NAMES:
        group, leaf = key.split(".")
        known = key in ("masks.coverage", "poses.registered", "poses.total", "selfcheck.kept_psnr")
        assert (metrics[group][leaf] is not None) == known, key
        assert known or "does not exist" in metrics[group][f"{leaf}_reason"]
    # A little worse than against the clean views: the rims of drops below the mask's threshold.
    assert 31 < metrics["selfcheck"]["kept_psnr"] < 34.151
    assert "no PSNR of clean views" in closing


def test_covered_and_kept_pixels_are_judged_apart(tmp_path):
    paths = fabricate(tmp_path)
    before, _ = evaluate(tmp_path)
    name = "view_00.png"
    keep = read_image(paths.refine / name, "masks")[..., 0] > 0.5
    view = read_image(paths.views / "test" / name)
    write_image(paths.views / "test" / name, np.where(keep[..., None], view, 0))
    after, _ = evaluate(tmp_path)
    assert after["kept"] == before["kept"]
    assert after["covered"]["psnr"] < before["covered"]["psnr"] - 10


def test_only_held_out_views_are_test_views(tmp_path):
    """A remover's photos lie in test/ all together: those that are not held out have no say."""
    paths = fabricate(tmp_path)
    before, closing = evaluate(tmp_path)
    for path in (paths.views / "input").iterdir():
        write_image(paths.views / "test" / path.name, np.zeros_like(read_image(path)))
    after, again = evaluate(tmp_path)
    for group in ("test", "covered", "kept", "selfcheck"):
        assert after[group] == before[group]
    assert closing == again


def test_photos_turned_by_ingest_find_their_references(tmp_path):
    """The same scene with one photo stored on its side gives the same numbers."""
    paths = fabricate(tmp_path)
    before, _ = evaluate(tmp_path)
    records = json.loads((paths.images / "images.json").read_text())
    records["images"][2]["turned"] = 90
    (paths.images / "images.json").write_text(json.dumps(records))
    for kind in ("clean", "coverage"):
        path = paths.truth / kind / "view_02.png"
        write_image(path, np.rot90(read_image(path), -1))
    cameras = json.loads((paths.truth / "cameras.json").read_text())
    pose = np.array(cameras["frames"]["view_02"]["cam_from_world"])
    back = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    cameras["frames"]["view_02"]["cam_from_world"] = (back @ pose).tolist()
    (paths.truth / "cameras.json").write_text(json.dumps(cameras))
    after, _ = evaluate(tmp_path)
    assert after == before


def test_missing_and_damaged_input_is_told(tmp_path):
    paths = fabricate(tmp_path)
    write_image(paths.views / "composite" / "view_01.png", np.zeros((4, 4, 3)))
    with pytest.raises(UserError, match=r"view_01\.png is 4x4, not 64x48"):
        evaluate(tmp_path)
    (paths.truth / "clean" / "view_03.png").unlink()
    with pytest.raises(UserError, match=r"no reference for view_03\.png"):
        evaluate(tmp_path)
    (paths.refine / "view_04.png").unlink()
    (paths.truth / "clean").rename(paths.truth / "elsewhere")
    with pytest.raises(UserError, match=r"view_04\.png does not exist"):
        evaluate(tmp_path)
    assert not paths.metrics.exists()
