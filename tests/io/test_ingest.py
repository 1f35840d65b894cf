"""The stage `ingest` over whole captures."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from pipeline.errors import UserError
from pipeline.io.given import GivenView
from pipeline.io.given_masks import pass_on_masks
from pipeline.io.images import image_size, read_image
from pipeline.io.intake import given_turns
from pipeline.io.masks import read_keep_mask
from pipeline.io.photos import Photo, plan_sizes
from pipeline.io.scene import read_images_json, read_origin
from pipeline.io.transforms import read_transforms
from pipeline.io.video import write_video
from pipeline.stage import Job
from stages import ingest

ROOT = Path(__file__).resolve().parents[2]
PARAMS = ingest.Params(max_size=0, min_images=3, holdout=2, frames=4, mixed_sizes="scale")
ORIENTATION = 0x0112


def _ingest(root: Path, **change: object) -> Path:
    job = Job(root, "made", None, "cpu", None, False)
    ingest.main(job, PARAMS.model_copy(update=change))
    return job.paths.images


def _photo(path: Path, size: tuple[int, int] = (40, 30), orientation: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif[0x010E] = path.stem  # a description: no two photos are the same file
    pixels = np.full((size[1], size[0], 3), 90, np.uint8)
    pixels[: size[1] // 2, : size[0] // 2] = 250  # the stored top left quarter is bright
    Image.fromarray(pixels).save(path, quality=95, exif=exif)


def test_plain_photos_have_no_given_poses_or_masks(tmp_path: Path) -> None:
    for name in "abc":
        _photo(tmp_path / f"data/made/{name}.jpg")
    _photo(tmp_path / "data/made/truth/clean/a.png")
    images = _ingest(tmp_path)
    records = read_images_json(images)
    assert [record.split for record in records] == ["test", "train", "test"]
    assert sorted(path.name for path in images.iterdir()) == [
        *("a.png", "b.png", "c.png", "images.json"),
    ]
    assert read_origin(images).posed == read_origin(images).masked == ""


def test_few_photos_are_told_and_many_are_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(11):
        _photo(tmp_path / f"data/made/{number:02d}.jpg")
    _ingest(tmp_path, holdout=8)
    assert "11 images are few, and 2 of them held out" in caplog.text
    caplog.clear()
    _ingest(tmp_path, holdout=0)
    assert "11 images are few: twenty or more" in caplog.text
    caplog.clear()
    _photo(tmp_path / "data/made/11.jpg")
    _ingest(tmp_path)
    assert "few" not in caplog.text


def test_mixed_sizes_come_out_as_one_and_it_is_kept_on_record(tmp_path: Path) -> None:
    for number, size in enumerate([(80, 60), (40, 30), (80, 60), (50, 30)]):
        _photo(tmp_path / f"data/made/{number}.jpg", size)
    images = _ingest(tmp_path)
    assert {image_size(path) for path in images.glob("*.png")} == {(40, 30)}
    assert read_origin(images).left_out == ["3.png"]
    with pytest.raises(UserError, match="mixed sizes"):
        _ingest(tmp_path, mixed_sizes="refuse")


@pytest.mark.parametrize("upright", [False, True])
def test_given_poses_decide_whether_the_metadata_turns_a_photo(
    tmp_path: Path, upright: bool
) -> None:
    """COLMAP sees the stored pixels, other programs the upright ones: the cameras' size tells."""
    data = tmp_path / "data/made"
    frames = []
    for x, name in enumerate(("a.jpg", "b.jpg", "c.jpg")):
        _photo(data / "images" / name, orientation=6)  # a quarter clockwise makes it upright
        pose = np.eye(4)
        pose[0, 3] = x
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    width, height = (30, 40) if upright else (40, 30)
    content = {"w": 2 * width, "h": 2 * height, "fl_x": 100.0, "frames": frames}
    (data / "transforms.json").write_text(json.dumps(content))
    images = _ingest(tmp_path)
    assert image_size(images / "a.png") == (width, height)
    view = read_transforms(images / "transforms.json")["a.png"]
    assert (view.fx, view.cx, view.cy) == (50.0, width / 2, height / 2)
    # Turned a quarter clockwise, the bright top left quarter is at the top right.
    bright = read_image(images / "a.png")[5, -5 if upright else 5]
    assert bright.min() > 0.9
    record = read_images_json(images)[0]
    assert record.turned == (0 if upright else 90)
    turned = ["3 of 3 photos stay turned, as the cameras that came along see them"]
    assert read_origin(images).said == ([] if upright else turned), "no photo is a landscape"
    assert record.source == "images/a.jpg"


def test_a_photo_without_a_pose_may_have_another_shape() -> None:
    """A COLMAP model places the landscapes alone: the portrait beside them is left out, not refused."""
    names = ("a.png", "b.png", "c.png", "d.png")
    photos = {name: Photo(40, 30, 0, None, name) for name in names[:3]}
    photos["d.png"] = Photo(30, 40, 0, None, "d.png")
    where = dict(cam_from_world=np.eye(4), width=40, height=30, fx=30.0, fy=30.0, cx=20.0, cy=15.0)
    views = {name: GivenView(Path(name).with_suffix(".jpg"), **where) for name in names[:2]}
    turns = given_turns(photos, views)
    assert turns == dict.fromkeys(names, 0)
    plan = plan_sizes(photos, fixed_turns=turns)
    assert plan.size == (40, 30) and plan.left_out == ["d.png"]
    photos["b.png"] = photos["d.png"]
    with pytest.raises(UserError, match=r"b\.jpg has 30x40 pixels, its camera 40x30"):
        given_turns(photos, views)


def test_rain_masks_are_scaled_and_passed_on_with_the_right_polarity(tmp_path: Path) -> None:
    data = tmp_path / "data/made"
    for name in ("b.jpg", "a.jpg", "c.jpg"):
        _photo(data / name, (80, 60))
    drops = np.zeros((30, 40, 3), np.float32)
    drops[:10, :20, 1] = 1.0  # of b, the second in name order
    np.save(data / "rainMask.npy", drops)
    images = _ingest(tmp_path)
    assert read_origin(images).masked == "rainMask.npy"
    coverage = pass_on_masks(images, read_images_json(images), tmp_path / "masks")
    assert coverage == pytest.approx({"a.png": 0, "b.png": 20 * 10 / (40 * 30), "c.png": 0})
    keep_mask = read_keep_mask(tmp_path / "masks/b.png", (80, 60))
    assert not keep_mask[:20, :40].any() and keep_mask[20:].all() and keep_mask[:, 40:].all()
    assert read_keep_mask(tmp_path / "masks/a.png").all()


def test_masks_of_another_shape_are_refused(tmp_path: Path) -> None:
    data = tmp_path / "data/made"
    for name in "abc":
        _photo(data / f"{name}.jpg")
    np.save(data / "rainMask.npy", np.zeros((30, 30, 3)))
    with pytest.raises(UserError, match="the mask of a has 30x30 pixels"):
        _ingest(tmp_path)
    assert not (tmp_path / "artifacts/made/images").exists()


def test_masks_that_drop_most_raise_a_doubt(tmp_path: Path) -> None:
    data = tmp_path / "data/made"
    for name in "abc":
        _photo(data / f"{name}.jpg")
        (data / "masks").mkdir(exist_ok=True)
        drop_mask = np.zeros((30, 40), np.uint8)
        drop_mask[:5] = 255  # white drops: the wrong way round
        cv2.imwrite(str(data / "masks" / f"{name}.png"), drop_mask)
    assert any("upside down" in said for said in read_origin(_ingest(tmp_path)).said)


@pytest.mark.parametrize(
    ("orientation", "upright"),  # of 2 to 4 both have one shape, and are taken for the file's
    [*((code, False) for code in range(1, 9)), *((code, True) for code in range(5, 9))],
)
def test_masks_lie_where_their_photos_pixels_do(
    tmp_path: Path, orientation: int, upright: bool
) -> None:
    """Drawn over the file's pixels, as those who heed no orientation see them, or over the upright photo."""
    for name in "abc":
        photo, mask = (tmp_path / f"data/made/{folder}{name}.png" for folder in ("", "masks/"))
        _photo(photo, orientation=orientation)
        drawn = Image.new("L", (40, 30), 255)
        drawn.paste(0, (0, 0, 20, 15))  # the quarter that is bright in the photo
        if upright:
            drawn.getexif()[ORIENTATION] = orientation
            drawn = ImageOps.exif_transpose(drawn)
        mask.parent.mkdir(exist_ok=True)
        drawn.save(mask, exif=Image.Exif())
    images = _ingest(tmp_path)
    bright = read_image(images / "a.png").min(axis=2) > 0.6
    assert np.array_equal(~read_keep_mask(images / "masks/a.png"), bright)


@pytest.mark.parametrize(
    ("orientation", "told"),
    [(1, False), (2, True), (3, True), (4, True), (5, False), (6, False)],
)
def test_masks_of_photos_taken_upside_down_or_mirrored_are_told_to_be_unsure(
    tmp_path: Path, orientation: int, told: bool
) -> None:
    """Stored or shown, a mask turned by half or mirrored has its photo's shape; a quarter would be seen."""
    for name in "abc":
        _photo(tmp_path / f"data/made/{name}.jpg", orientation=orientation)
        (tmp_path / "data/made/masks").mkdir(exist_ok=True)
        Image.new("L", (40, 30), 255).save(tmp_path / f"data/made/masks/{name}.png")
    said = read_origin(_ingest(tmp_path)).said
    assert any("the metadata turns or mirrors 3 photos" in sentence for sentence in said) == told


def test_a_video_becomes_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wide = cv2.resize(rng.random((20, 60, 3)).astype(np.float32), (600, 200)).clip(0, 1)
    (tmp_path / "data/made").mkdir(parents=True)
    frames = [wide[:120, x : x + 160] for x in range(0, 400, 8)]
    write_video(tmp_path / "data/made/clip.mp4", frames, 24)
    images = _ingest(tmp_path)
    records = read_images_json(images)
    assert [record.name for record in records] == [f"frame_{i:04d}.png" for i in range(4)]
    assert records[0].source.startswith("clip.mp4 at ") and read_origin(images).kind == "video"


def _from(root: Path, scene: str, source: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [
            *(sys.executable, "-m", "stages.ingest", "--scene", scene, "--from", str(source)),
            *("--params", str(root / "params.yaml")),
        ],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip


def test_one_command_brings_a_folder_in(tmp_path: Path) -> None:
    root = tmp_path / "project"
    root.mkdir()
    shutil.copy(ROOT / "params.yaml", root)
    before = (root / "params.yaml").read_text()
    for name in "abc":
        _photo(tmp_path / f"holiday/{name}.jpg")
    done = _from(root, "garden", tmp_path / "holiday")
    assert done.returncode == 0, done.stderr
    assert (root / "data/garden/a.jpg").is_file()
    assert (root / "artifacts/garden/images/images.json").is_file()
    after = (root / "params.yaml").read_text()
    assert after.replace("  garden: {<<: *scene}\n", "") == before, "nothing else has changed"
    assert _from(root, "garden", tmp_path / "holiday").returncode == 0, "goes on where it was"
    _photo(tmp_path / "holiday/d.jpg")
    again = _from(root, "garden", tmp_path / "holiday")
    assert again.returncode == 2 and "exists already and holds something else" in again.stderr
    assert (root / "params.yaml").read_text() == after
    bad = _from(root, "shed", tmp_path / "nowhere")
    assert bad.returncode == 2 and "nowhere does not exist" in bad.stderr
    long = _from(root, "shed", tmp_path / ("x" * 300))
    assert long.returncode == 2 and "Traceback" not in long.stderr
    assert "xxx: cannot be read (File name too long)" in long.stderr
    assert (root / "params.yaml").read_text() == after and not (root / "data/shed").exists()


def test_as_many_photos_are_asked_for_as_the_scene_needs(tmp_path: Path) -> None:
    """`ingest.min_images`, on the way in too: of the section, or of a scene that is there already."""
    for name in "abc":
        _photo(tmp_path / f"three/{name}.jpg")
    file = tmp_path / "params.yaml"
    fewer = (ROOT / "params.yaml").read_text()
    text = fewer.replace("min_images: 3 ", "min_images: 4 ")
    file.write_text(text)
    with pytest.raises(UserError, match="at least 4"):
        ingest._before(file, argparse.Namespace(source=tmp_path / "three", scene="garden"))
    assert file.read_text() == text and not (tmp_path / "data/garden").exists()
    file.write_text(fewer)
    ingest._before(file, argparse.Namespace(source=tmp_path / "three", scene="garden"))
    assert (tmp_path / "data/garden/b.jpg").is_file()
    file.write_text(
        text.replace("scenes:\n", "scenes:\n  shed: {<<: *scene, ingest: {min_images: 3}}\n")
    )
    ingest._before(file, argparse.Namespace(source=tmp_path / "three", scene="shed"))
    assert (tmp_path / "data/shed/b.jpg").is_file()


def test_scenes_that_are_added_at_once_do_not_lose_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the photos of one are copied, another finishes and writes its line."""
    file = tmp_path / "params.yaml"
    section = "ingest: {max_size: 0, min_images: 3, holdout: 0, frames: 9, mixed_sizes: scale}\n"
    scenes = "scene_defaults: &scene {ingest: {}}\nscenes:\n  demo: {<<: *scene}\n"
    file.write_text(section + scenes)

    def adopt(*_: object) -> None:
        file.write_text(file.read_text() + "  pier: {<<: *scene}\n")

    monkeypatch.setattr(ingest, "adopt", adopt)
    ingest._before(file, argparse.Namespace(source=tmp_path, scene="garden"))
    added = file.read_text().splitlines()[-2:]
    assert added == ["  pier: {<<: *scene}", "  garden: {<<: *scene}"]
