"""Artifacts that were damaged or swapped between two stages are refused by name, with the stage to run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from pipeline.io.images import write_image
from pipeline.io.maps import write_map
from pipeline.io.masks import write_keep_mask
from tests.faults.workshop import Workshop


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _text(path: Path) -> None:
    path.write_text("rain, rain, go away")


@pytest.mark.parametrize("damage", [_cut, _empty, _text])
@pytest.mark.parametrize(
    ("stage", "name", "maker"),
    [
        ("attention", "images/images.json", "ingest"),
        ("attention", "images/view_2.png", "ingest"),
        ("masks", "attention/view_2.exr", "attention"),
        ("poses", "images/view_2.png", "ingest"),
        ("poses", "masks/view_2.png", "masks"),
        ("nerf", "poses/transforms.json", "poses"),
        ("refine", "masks/view_2.png", "masks"),
        ("refine", "attention/view_2.exr", "attention"),
        ("nerf", "refine/view_2.png", "refine"),
        ("nerf", "images/view_2.png", "ingest"),
        ("render", "nerf/field.json", "nerf"),
        ("render", "nerf/field.safetensors", "nerf"),
        ("evaluate", "views/test/view_0.png", "render"),
        ("evaluate", "views/composite/view_2.png", "render"),
        ("evaluate", "refine/view_2.png", "refine"),
        ("report", "metrics.json", "evaluate"),
        ("report", "attention/view_2.exr", "attention"),
    ],
)
def test_damaged_files(
    whole: Workshop, stage: str, name: str, maker: str, damage: Callable[[Path], None]
) -> None:
    damage(whole.artifacts / name)
    whole.refuses(stage, Path(name).name, f"python -m stages.{maker}` again")


def _frame(change: Callable[[dict[str, Any]], Any]) -> Callable[[Workshop], None]:
    def do(workshop: Workshop) -> None:
        path = workshop.artifacts / "poses/transforms.json"
        content = json.loads(path.read_text())
        change(content["frames"][2])
        path.write_text(json.dumps(content))

    return do


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: frame.pop("transform_matrix"),
        lambda frame: frame.pop("near"),
        lambda frame: frame.update(fl_x="wide"),
        lambda frame: frame.update(fl_x=float("nan")),
        lambda frame: frame.update(fl_y=0.0),
        lambda frame: frame.update(w=float("inf")),
        lambda frame: frame.update(transform_matrix=[[1, 0, 0, 0]] * 4),
        lambda frame: frame.update(transform_matrix=np.full((4, 4), np.nan).tolist()),
        lambda frame: frame.update(transform_matrix=np.diag([2, 2, 2, 1]).tolist()),
    ],
)
def test_poses_that_are_none(whole: Workshop, change: Callable[[dict[str, Any]], Any]) -> None:
    _frame(change)(whole)
    whole.refuses("nerf", "transforms.json")


def test_depths_that_hold_nothing(whole: Workshop) -> None:
    _frame(lambda frame: frame.update(near=-1.0))(whole)
    whole.refuses("nerf", "nothing lies between", "python -m stages.poses")


def test_no_pose_at_all(whole: Workshop) -> None:
    path = whole.artifacts / "poses/transforms.json"
    path.write_text(json.dumps({"frames": []}))
    whole.refuses("nerf", "pose")


@pytest.mark.parametrize("stage", ["refine", "nerf", "render", "export"])
def test_poses_of_other_photos(whole: Workshop, stage: str) -> None:
    path = whole.artifacts / "poses/transforms.json"
    path.write_text(path.read_text().replace("view_", "window_"))
    whole.refuses(stage, "no photo in", "has a pose", "python -m stages.poses` again")


def test_no_held_out_photo_to_render(whole: Workshop) -> None:
    def fit_all(content: Any) -> None:
        for entry in content["images"]:
            entry["split"] = "train"

    _changed(whole.artifacts / "images/images.json", fit_all)
    whole.set("render", views="test")
    whole.refuses("render", "is held out of the fit", "render.views: all")


def _changed(path: Path, change: Callable[[Any], Any]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda content: content.update(images=[]), "it names none"),
        (lambda content: content.update(images={}), "images should be a list"),
        (lambda content: content["images"][0].update(name=3), "images[0].name should be text"),
        (lambda content: content["images"][0].update(name="../view_0.png"), "no name of a file"),
        (lambda content: content["images"][0].update(width="240"), "should be a whole number"),
        (lambda content: content["images"][0].update(height=0), "a size that is not in pixels"),
        (lambda content: content["images"][0].pop("turned"), "images[0].turned is missing"),
        (lambda content: content["images"][0].update(focal_px="wide"), "images[0].focal_px"),
        (lambda content: content["images"][0].update(split="both"), "train or test"),
    ],
)
def test_a_list_of_images_that_is_none(
    whole: Workshop, change: Callable[[Any], Any], told: str
) -> None:
    _changed(whole.artifacts / "images/images.json", change)
    whole.refuses("attention", "images.json is", told, "stages.ingest` again")


@pytest.mark.parametrize(
    ("stage", "name", "change", "told"),
    [
        (
            "report",
            "images/images.json",
            lambda all: all["origin"].update(said="no"),
            "origin.said",
        ),
        ("report", "metrics.json", lambda all: all.update(test=None), "test should be"),
        ("report", "metrics.json", lambda all: all["test"].update(psnr="29"), "test.psnr"),
        ("report", "metrics.json", lambda all: all["test"].update(lpips_reason=[]), "lpips_reason"),
        ("report", "metrics.json", lambda all: all["poses"].pop("total"), "poses.total is missing"),
        ("report", "metrics.json", lambda all: all.update(rounds={"0": 1}), "rounds.0"),
        ("report", "metrics.json", lambda all: all.pop("conventions"), "conventions is missing"),
        ("report", "poses/poses.json", lambda all: all.update(registered=5), "registered"),
        (
            "report",
            "poses/poses.json",
            lambda all: all.update(lost=[{"name": "a"}]),
            "lost[0].reason",
        ),
        ("report", "poses/poses.json", lambda all: all.update(tried=["x", "y"]), "tried[0]"),
        (
            "report",
            "poses/poses.json",
            lambda all: all.update(reprojection_px="0"),
            "reprojection_px",
        ),
        ("report", "masks/masks.json", lambda all: all.update(threshold={}), "threshold"),
        ("report", "refine/refine.json", lambda all: all.update(rounds=["x"]), "rounds"),
        ("report", "refine/refine.json", lambda all: all.update(rounds={"x": {}}), "rounds.x"),
        ("report", "refine/refine.json", lambda all: all.update(rounds={"0": {}}), "0.coverage"),
        ("report", "views/seen.json", lambda all: all.update({"view_0.png": 1}), "view_0.png"),
        (
            "refine",
            "masks/masks.json",
            lambda all: all.update(mode=["given"]),
            "mode should be text",
        ),
    ],
)
def test_values_of_the_wrong_kind_inside(
    whole: Workshop, stage: str, name: str, change: Callable[[Any], Any], told: str
) -> None:
    path = whole.artifacts / name
    made_by = {"images": "ingest", "metrics": "evaluate", "seen": "render"}
    _changed(path, change)
    again = f"python -m stages.{made_by.get(path.stem, path.stem)}` again"
    whole.refuses(stage, f"{name} is damaged: ", told, again)


@pytest.mark.parametrize(
    ("stage", "name"),
    [
        ("refine", "masks/masks.json"),
        ("render", "nerf/field.json"),
        ("report", "metrics.json"),
        ("report", "masks/masks.json"),
        ("report", "poses/poses.json"),
        ("report", "views/seen.json"),
        ("evaluate", "poses/transforms.json"),
    ],
)
def test_a_list_where_names_are_expected(whole: Workshop, stage: str, name: str) -> None:
    (whole.artifacts / name).write_text("[1, 2]")
    whole.refuses(stage, f"{name} is damaged: it holds a list")


@pytest.mark.parametrize("bounds", [None, {"near": 1.0}, {"near": 1.0, "far": "away"}])
def test_a_field_without_depths(whole: Workshop, bounds: Any) -> None:
    path = whole.artifacts / "nerf/field.json"
    content = json.loads(path.read_text()) | {"bounds": bounds}
    path.write_text(json.dumps(content))
    (whole.artifacts / "nerf/field.safetensors").touch()  # not the field that is still in memory
    whole.refuses("render", "field.json tells no depths", "stages.nerf` again")


@pytest.mark.parametrize(
    "content", [b"rain\nrain\n", b"image\xff,rain\n1,2\n", b"image,step\n1,2,3\n"]
)
@pytest.mark.parametrize("name", ["metrics.csv", "nerf/fit.csv"])
def test_tables_of_the_page_that_are_none(whole: Workshop, name: str, content: bytes) -> None:
    (whole.artifacts / name).write_bytes(content)
    whole.refuses("report", f"{name} is not a table with a column")


@pytest.mark.parametrize("stage", ["masks", "refine"])
def test_attention_of_another_size(whole: Workshop, stage: str) -> None:
    write_map(whole.artifacts / "attention/view_2.exr", np.zeros((90, 120), np.float32))
    whole.refuses(stage, "120x90", "240x180", "python -m stages.attention")


def test_attention_that_is_no_number(whole: Workshop) -> None:
    path = str(whole.artifacts / "attention/view_2.exr")
    out = oiio.ImageOutput.create(path)
    spec = oiio.ImageSpec(240, 180, 1, "half")
    assert out.open(path, spec)
    assert out.write_image(np.full((180, 240, 1), np.nan, np.float32)) and out.close()
    whole.refuses("masks", "view_2.exr", "NaN")


@pytest.mark.parametrize("stage", ["poses", "refine", "nerf", "render", "evaluate"])
def test_a_mask_of_another_size(whole: Workshop, stage: str) -> None:
    for folder in ("masks", "refine"):
        write_keep_mask(whole.artifacts / folder / "view_2.png", np.ones((90, 120), bool))
    whole.refuses(stage, "view_2.png", "120x90", "240x180")


@pytest.mark.parametrize("stage", ["refine", "nerf", "render", "evaluate"])
@pytest.mark.parametrize("values", [np.full((180, 240), 7), np.full((180, 240, 3), 255)])
def test_a_mask_that_is_none(whole: Workshop, stage: str, values: np.ndarray) -> None:
    for folder in ("masks", "refine"):
        cv2.imwrite(str(whole.artifacts / folder / "view_2.png"), values.astype(np.uint8))
    whole.refuses(stage, "view_2.png")


@pytest.mark.parametrize("stage", ["attention", "poses", "refine", "nerf", "render"])
def test_an_image_of_another_size(whole: Workshop, stage: str) -> None:
    write_image(whole.artifacts / "images/view_2.png", np.zeros((90, 120, 3)))
    whole.refuses(stage, "view_2.png")


def test_masks_that_leave_nothing_to_fit(whole: Workshop) -> None:
    for path in (whole.artifacts / "refine").glob("*.png"):
        write_keep_mask(path, np.zeros((180, 240), bool))
    whole.refuses("nerf", "mask")


def test_a_field_of_other_sizes(whole: Workshop) -> None:
    path = whole.artifacts / "nerf/field.json"
    path.write_text(path.read_text().replace('"levels": 2', '"levels": 3'))
    whole.refuses("render", "field", "python -m stages.nerf")


def test_a_reference_of_another_size(whole: Workshop) -> None:
    write_image(whole.data / "truth/clean/view_2.png", np.zeros((90, 100, 3)))
    whole.refuses("evaluate", "truth/clean/view_2.png", "100x90")


def test_a_reference_that_is_missing(whole: Workshop) -> None:
    (whole.data / "truth/clean/view_2.png").unlink()
    whole.refuses("evaluate", "truth/clean", "view_2.png")


def test_true_cameras_that_are_none(whole: Workshop) -> None:
    _text(whole.data / "truth/cameras.json")
    whole.refuses("evaluate", "truth/cameras.json")


def test_a_backbone_that_is_none(whole: Workshop) -> None:
    whole.set("evaluate", lpips_backbone="weights/alexnet.pth")
    whole.refuses("evaluate", "alexnet.pth")
    _text(whole.root / "weights/alexnet.pth")
    whole.refuses("evaluate", "alexnet.pth")


def test_views_that_masks_were_repaired_after_are_not_exported(whole: Workshop) -> None:
    """What `render` wrote down of its inputs tells, and nothing of an export is begun."""
    whole.set("export", formats=["photos"])
    mask = min((whole.artifacts / "refine").glob("*.png"))
    as_it_was = mask.read_bytes()
    height, width = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED).shape
    write_keep_mask(mask, np.ones((height, width), bool))
    whole.refuses("export", "was rendered from other masks than", "stages.render` again")
    mask.write_bytes(as_it_was)
    done = whole.run("export")
    assert done.code == 0 and "views/" not in done.said, "the same bytes, however often written"
