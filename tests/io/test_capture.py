"""What lies in a user's folder, and how it comes in: poses and masks of other programs."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UserError
from pipeline.geometry.poses import centre, nearest_rotation
from pipeline.io.capture import Capture, adopt, find_capture, refuse_outside
from pipeline.io.given import (
    GivenView,
    Straightener,
    read_nerfstudio,
    straightened,
)
from pipeline.io.intake import given_masks
from pipeline.io.llff import read_poses_bounds
from pipeline.io.masks import fit_mask, rain_mask, read_foreign_mask, read_rain_mask

NAMES = ("a.jpg", "b.jpg", "c.jpg")


def _no_colmap(folder: Path, photos: Any) -> list[GivenView]:
    raise AssertionError("there is no COLMAP model here")


def _photos(folder: Path, size: tuple[int, int] = (40, 30)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        Image.new("RGB", size, "grey").save(folder / name)


def _find(folder: Path) -> Capture:
    return find_capture(folder, 3, _no_colmap)


def _llff_row(x: float, height: int, width: int, focal: float) -> np.ndarray:
    """A camera at (x, 0, 0) that looks along +z with x right and y down: LLFF's axes by hand.

    Columns: down (0, 1, 0), right (1, 0, 0), back (0, 0, -1), the place, (H, W, f).
    """
    matrix = np.array([[0, 1, 0, x, height], [1, 0, 0, 0, width], [0, 0, -1, 0, focal]], np.float64)
    return np.concatenate([matrix.ravel(), [2.0, 9.0]])


def test_llff_axes_size_and_depths_are_read(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    rows = np.stack([_llff_row(x, 300, 400, 350.0) for x in (0.0, 1.0, 2.0)])
    np.save(tmp_path / "poses_bounds.npy", rows)
    capture = _find(tmp_path)
    assert capture.posed_by == "LLFF"
    view = capture.views["b.png"].view("b.png", (40, 30))
    expected = np.eye(4)
    expected[0, 3] = -1.0
    assert np.allclose(view.cam_from_world, expected)
    # f = 350 at 400 x 300 is 35 at 40 x 30.
    assert (view.fx, view.fy, view.cx, view.cy, view.k1) == (35.0, 35.0, 20.0, 15.0, 0.0)
    assert (view.near, view.far) == (2.0, 9.0)


def test_llff_needs_a_row_per_photo(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    np.save(tmp_path / "poses_bounds.npy", np.stack([_llff_row(0, 30, 40, 35)] * 2))
    with pytest.raises(UserError, match="holds 2 poses, but there are 3 photos"):
        _find(tmp_path)
    with pytest.raises(UserError, match="expected"):
        np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 15)))
        _find(tmp_path)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (14, 0.0, "not positive"),
        (14, np.nan, "not finite"),
        (4, 0.0, "not positive"),
        (9, np.inf, "not finite"),
        (16, np.nan, "not finite"),
        (3, np.nan, "not a rotation"),
    ],
)
def test_llff_cameras_that_are_none(
    tmp_path: Path, column: int, value: float, message: str
) -> None:
    """Row by row: columns 4, 9 and 14 are H, W and f, 16 the far depth, 3 a place."""
    _photos(tmp_path / "images")
    rows = np.stack([_llff_row(x, 30, 40, 35.0) for x in (0.0, 1.0, 2.0)])
    rows[1, column] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(UserError, match=rf"poses_bounds\.npy: the \w+ of b\.jpg .*{message}"):
        _find(tmp_path)


def test_arrays_of_text_are_told(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    np.save(tmp_path / "poses_bounds.npy", np.full((3, 17), "rain"))
    with pytest.raises(UserError, match="17 numbers are expected"):
        _find(tmp_path)
    np.save(tmp_path / "r.npy", np.full((3, 4, 2), "rain"))
    with pytest.raises(UserError, match="not numbers"):
        read_rain_mask(tmp_path / "r.npy", 2)
    np.save(tmp_path / "r.npy", np.zeros((0, 0, 2)))
    with pytest.raises(UserError, match="is expected"):
        read_rain_mask(tmp_path / "r.npy", 2)


def test_an_array_of_objects_is_not_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(UserError, match="not a readable array"):
        read_poses_bounds(tmp_path / "p.npy", [])
    with pytest.raises(UserError, match="not a readable array"):
        read_rain_mask(tmp_path / "p.npy", 1)


def _transforms(folder: Path, **more: Any) -> dict[str, Any]:
    """A nerfstudio file of three cameras at x = 0, 1, 2, OpenGL axes (x right, y up, z back)."""
    frames = []
    for x, name in enumerate(NAMES):
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])  # looks along world +z, y down
        matrix[0, 3] = x
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    content = {"w": 80, "h": 60, "fl_x": 70.0, "fl_y": 72.0, "cx": 41.0, "cy": 29.0} | more
    return content | {"frames": frames}


def _write(folder: Path, content: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


@pytest.mark.parametrize("form", ["nerfstudio", "LLFF"])
def test_rotations_rounded_to_four_decimals_leave_the_places_where_they_are(
    tmp_path: Path, form: str
) -> None:
    """780 units from the origin, 1e-4 of the rotation are 0.08 of the place, if R^T stands for its inverse."""
    random = np.random.default_rng(1)
    _photos(tmp_path / "images")
    for _ in range(40):
        content, rows, places = _transforms(tmp_path), [], []
        for frame in content["frames"]:
            matrix = np.eye(4)
            matrix[:3, :3] = np.round(nearest_rotation(random.normal(size=(3, 3))), 4)
            matrix[:3, 3] = np.array([612.3, -488.1, 35.2]) + random.normal(0, 3, 3)
            frame["transform_matrix"] = matrix.tolist()
            right, up, back, place = matrix[:3].T
            shape = np.array([30.0, 40.0, 35.0])
            row = np.stack([-up, right, back, place, shape], axis=1)
            rows.append(np.concatenate([row.ravel(), [2.0, 9.0]]))
            places.append(place)
        if form == "nerfstudio":
            views = read_nerfstudio(_write(tmp_path, content))
        else:
            np.save(tmp_path / "p.npy", np.stack(rows))
            views = read_poses_bounds(
                tmp_path / "p.npy", [tmp_path / "images" / name for name in NAMES]
            )
        for view, place, frame in zip(views, places, content["frames"], strict=True):
            turn = view.cam_from_world[:3, :3]
            assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14)
            assert np.allclose(centre(view.cam_from_world), place, rtol=0, atol=1e-9)
            as_written = np.array(frame["transform_matrix"])[:3, :3] @ np.diag([1.0, -1.0, -1.0])
            assert np.allclose(turn.T, as_written, rtol=0, atol=2e-4)


def test_nerfstudio_axes_and_intrinsics_are_read(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    _write(tmp_path, _transforms(tmp_path, k1=0.1))
    capture = _find(tmp_path)
    assert capture.posed_by == "nerfstudio"
    view = capture.views["c.png"].view("c.png", (40, 30))
    expected = np.eye(4)
    expected[0, 3] = -2.0
    assert np.allclose(view.cam_from_world, expected)
    assert (view.fx, view.fy, view.cx, view.cy, view.k1) == (35.0, 36.0, 20.5, 14.5, 0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR is not known"),
        ({"w": 0}, "does not tell the photos' size"),
        ({"frames": [{}]}, "not a list of posed photos"),
        ({"fl_x": "wide"}, "not a list of posed photos"),
        ({"w": float("inf")}, "not a list of posed photos"),
        ({"w": -80, "h": -60}, r"the camera of a\.jpg .* not positive"),
        ({"fl_x": 0.0}, r"the camera of a\.jpg .* not positive"),
        ({"fl_y": -72.0}, r"the camera of a\.jpg .* not positive"),
        ({"fl_x": float("nan")}, r"the camera of a\.jpg .* not finite"),
        ({"k1": float("nan")}, r"the camera of a\.jpg .* not finite"),
        ({"cx": float("inf")}, r"the camera of a\.jpg .* not finite"),
    ],
)
def test_bad_transforms_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    _photos(tmp_path / "images")
    with pytest.raises(UserError, match=message):
        read_nerfstudio(_write(tmp_path, _transforms(tmp_path) | change))


@pytest.mark.parametrize("angle", [0.0, -0.5, 4.0])
def test_an_angle_that_no_lens_sees(tmp_path: Path, angle: float) -> None:
    _photos(tmp_path / "images")
    content = _transforms(tmp_path) | {"camera_angle_x": angle}
    del content["fl_x"]
    with pytest.raises(UserError, match=r"the camera of a\.jpg"):
        read_nerfstudio(_write(tmp_path, content))


def test_instant_ngps_fisheyes_and_masks_that_are_null(tmp_path: Path) -> None:
    """It tells them by a flag, where nerfstudio names the model; k3 and k4 then are the fisheye's."""
    _photos(tmp_path / "images")
    content = _transforms(tmp_path, is_fisheye=True, k1=0.01, k2=0.02, k3=0.03, k4=0.04, p1=9.0)
    for frame in content["frames"]:
        frame["mask_path"] = None
    view = read_nerfstudio(_write(tmp_path, content))[0]
    assert view.fisheye and view.distortion == (0.01, 0.02, 0.03, 0.04)
    assert view.mask_path is None
    assert not read_nerfstudio(_write(tmp_path, content | {"is_fisheye": False}))[0].fisheye


def test_a_pose_that_is_not_rigid_and_a_photo_that_is_not_there_are_named(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    content = _transforms(tmp_path)
    content["frames"][1]["transform_matrix"][0][0] = 2.0
    with pytest.raises(UserError, match=r"the pose of b\.jpg is not a rotation"):
        read_nerfstudio(_write(tmp_path, content))
    content = _transforms(tmp_path)
    content["frames"][1]["file_path"] = "images/z.jpg"
    with pytest.raises(UserError, match=r"names images/z\.jpg, which does not exist"):
        read_nerfstudio(_write(tmp_path, content))
    content = _transforms(tmp_path)
    content["frames"][1]["mask_path"] = "images/a.jpg"
    with pytest.raises(UserError, match=r"names no mask for a\.jpg, c\.jpg"):
        read_nerfstudio(_write(tmp_path, content))


def test_one_radial_term_is_carried_and_more_is_taken_away() -> None:
    view = GivenView(Path("a"), np.eye(4), 400, 300, 300.0, 300.0, 200.0, 150.0)
    assert view.carried

    def bent(*distortion: float, fisheye: bool = False) -> GivenView:
        return GivenView(
            Path("a"), np.eye(4), 400, 300, 300.0, 300.0, 200.0, 150.0, distortion, fisheye
        )

    assert bent(0.1, 0.0, 0.0, 0.0).carried
    assert not bent(0.1, 0.01).carried
    assert not bent(0.6).carried, "k1 r^2 = 0.6 * 0.69 in the corner: rays would not be exact"
    assert not bent(fisheye=True).carried


@pytest.mark.parametrize("fisheye", [False, True])
def test_straightened_lines_are_where_a_pinhole_sees_them(fisheye: bool) -> None:
    """A dot drawn where the bent camera sees a point must land where the straight one sees it."""
    bent = GivenView(
        Path("a"), np.eye(4), 400, 300, 300.0, 310.0, 203.0, 148.0, (-0.2, 0.05, 0.0, 0.0), fisheye
    )
    straight = straightened(bent)
    assert not straight.distortion and not straight.fisheye
    for x, y in ((0.3, 0.2), (-0.25, 0.1), (0.0, -0.3)):
        r2 = x * x + y * y
        if fisheye:
            angle = np.arctan(np.sqrt(r2))
            gain = angle * (1 - 0.2 * angle**2 + 0.05 * angle**4) / np.sqrt(r2)
        else:
            gain = 1 - 0.2 * r2 + 0.05 * r2**2
        # Pixel indices: the centre of pixel (0, 0) lies at (0.5, 0.5).
        column, row = 300.0 * x * gain + 203.0 - 0.5, 310.0 * y * gain + 148.0 - 0.5
        rows, columns = np.mgrid[:300, :400]
        dot = np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / 8).astype(np.float32)
        seen = Straightener(bent, straight)(np.repeat(dot[..., None], 3, axis=2))[..., 0]
        total = seen.sum()
        found = (seen * columns).sum() / total, (seen * rows).sum() / total
        expected = straight.fx * x + straight.cx - 0.5, straight.fy * y + straight.cy - 0.5
        assert found == pytest.approx(expected, abs=0.1)
    white = Straightener(bent, straight)(np.ones((300, 400), np.uint8))
    assert white.all(), "the straight picture is covered wholly"


@pytest.mark.parametrize(
    ("distortion", "fisheye"), [((0.0, -30.0, 0.0, 0.0), False), ((-3.0, 0.0, 0.0, 0.0), True)]
)
def test_a_lens_that_folds_back_is_not_straightened(
    distortion: tuple[float, ...], fisheye: bool
) -> None:
    """r - 30 r^5 falls from r = 0.29 on, and in the corner r is 0.75: nothing is seen there."""
    bent = GivenView(Path("a.jpg"), np.eye(4), 120, 90, 100, 100, 60, 45, distortion, fisheye)
    with pytest.raises(UserError, match=r"a\.jpg was taken .* cannot be straightened"):
        straightened(bent)


def test_rain_mask_has_the_official_layout_and_polarity(tmp_path: Path) -> None:
    keep_masks = [np.ones((3, 5), bool) for _ in range(4)]
    keep_masks[2][1, 4] = False
    array = rain_mask(keep_masks)
    assert array.shape == (3, 5, 4), "[H, W, N]"
    assert array[1, 4, 2] == 1 and array.sum() == 1, "1 is a drop"
    np.save(tmp_path / "rainMask.npy", array.astype(np.float32))
    assert np.array_equal(read_rain_mask(tmp_path / "rainMask.npy", 4), np.stack(keep_masks))
    with pytest.raises(UserError, match=r"\(height, width, 5\) is expected"):
        read_rain_mask(tmp_path / "rainMask.npy", 5)
    np.save(tmp_path / "rainMask.npy", array * 255)
    with pytest.raises(UserError, match="outside 0"):
        read_rain_mask(tmp_path / "rainMask.npy", 4)


@pytest.mark.parametrize("white", [1, 255, 65535])
def test_black_is_dropped_in_masks_of_other_programs(tmp_path: Path, white: int) -> None:
    values = np.zeros((4, 6), np.uint16 if white > 255 else np.uint8)
    values[:, 3:] = white
    cv2.imwrite(str(tmp_path / "m.png"), values)
    keep_mask = read_foreign_mask(tmp_path / "m.png")
    assert keep_mask[:, 3:].all() and not keep_mask[:, :3].any()
    cv2.imwrite(str(tmp_path / "rgb.png"), np.repeat(values[..., None], 3, axis=2))
    assert np.array_equal(read_foreign_mask(tmp_path / "rgb.png"), keep_mask)


def test_a_coloured_mask_is_refused_and_a_small_one_scaled(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), "red").save(tmp_path / "m.png")
    with pytest.raises(UserError, match="is coloured"):
        read_foreign_mask(tmp_path / "m.png")
    keep_mask = np.ones((4, 4), bool)
    keep_mask[:2, :2] = False
    assert fit_mask(keep_mask, (2, 2)).tolist() == [[False, True], [True, True]]


@pytest.mark.parametrize("colour", [0, 255])
def test_a_mask_in_the_transparency_is_refused_and_one_beside_it_is_read(
    tmp_path: Path, colour: int
) -> None:
    grey = Image.new("L", (6, 4), 255)
    grey.paste(0, (0, 0, 3, 4))
    flat = Image.new("L", (6, 4), colour)
    for kind, channels in (("LA", [flat, grey]), ("RGBA", [flat, flat, flat, grey])):
        Image.merge(kind, channels).save(tmp_path / "m.png")
        with pytest.raises(UserError, match="more or less transparent"):
            read_foreign_mask(tmp_path / "m.png")
    for clear in (grey, Image.new("L", (6, 4), 255), Image.new("L", (6, 4), 128)):
        Image.merge("LA", [grey, clear]).save(tmp_path / "m.png")
        assert read_foreign_mask(tmp_path / "m.png").tolist() == [[False] * 3 + [True] * 3] * 4
    Image.merge("LA", [flat, Image.new("L", (6, 4), 255)]).save(tmp_path / "m.png")
    assert (read_foreign_mask(tmp_path / "m.png") == (colour > 0)).all()  # all is kept, or dropped


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_mask_with_values_that_are_no_numbers_is_refused(tmp_path: Path, wrong: float) -> None:
    values = np.ones((4, 6), np.float32)
    values[0, 0] = wrong
    cv2.imwrite(str(tmp_path / "m.tiff"), values)
    with pytest.raises(UserError, match="holds NaN or infinity; a mask"):
        read_foreign_mask(tmp_path / "m.tiff")


def test_masks_are_found_by_any_usual_name_and_for_all_or_none(tmp_path: Path) -> None:
    _photos(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in ("a.jpg.png", "b.jpg", "c.png"):
        Image.new("L", (40, 30), 255).save(tmp_path / "masks" / name)
    found = _find(tmp_path).masks
    assert {name: path.name for name, path in found.items()} == {
        "a.png": "a.jpg.png",
        "b.png": "b.jpg",
        "c.png": "c.png",
    }
    (tmp_path / "masks/b.jpg").unlink()
    with pytest.raises(UserError, match=r"no mask for b\.jpg"):
        _find(tmp_path)
    for path in (tmp_path / "masks").iterdir():
        path.rename(path.with_name(f"mask of {path.name}"))
    with pytest.raises(UserError, match=r"no mask for a\.jpg, b\.jpg, c\.jpg"):
        _find(tmp_path)  # not passed over in silence
    for path in (tmp_path / "masks").iterdir():
        path.unlink()
    assert not _find(tmp_path).masks, "an empty folder holds none, for nobody"


def test_a_video_stands_alone(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").touch()
    assert _find(tmp_path).video == tmp_path / "a.mp4"
    _photos(tmp_path)
    with pytest.raises(UserError, match=r"holds a\.mp4 and a\.jpg"):
        _find(tmp_path)


def test_adopting_copies_what_belongs_and_nothing_else(tmp_path: Path) -> None:
    source, data = tmp_path / "capture", tmp_path / "data/garden"
    _photos(source / "images")
    _write(source, _transforms(source))
    (source / "truth").mkdir()
    (source / "truth/cameras.json").write_text("{}")
    (source / "private.txt").write_text("not for you")
    adopt(source, data, 3, _no_colmap)
    files = {path.relative_to(data).as_posix() for path in data.rglob("*") if path.is_file()}
    assert files == {*(f"images/{n}" for n in NAMES), "transforms.json", "truth/cameras.json"}
    assert _find(data).posed_by == "nerfstudio"


@pytest.mark.parametrize("change", ["none", "another photo", "other bytes", "one more here"])
def test_a_scene_is_only_brought_in_again_when_it_is_the_same(tmp_path: Path, change: str) -> None:
    """A run that was stopped goes on with the same command; photos are never exchanged unasked."""
    source, data = tmp_path / "capture", tmp_path / "data/garden"
    _photos(source)
    adopt(source, data, 3, _no_colmap)
    before = {path: path.read_bytes() for path in data.iterdir()}
    if change == "another photo":
        (source / "z.jpg").write_bytes((source / NAMES[0]).read_bytes())
    elif change == "other bytes":
        (source / NAMES[0]).write_bytes((source / NAMES[0]).read_bytes() + b"\0")
    elif change == "one more here":
        (data / "z.jpg").write_bytes(b"mine")
        before[data / "z.jpg"] = b"mine"
    if change == "none":
        adopt(source, data, 3, _no_colmap)
    else:
        with pytest.raises(UserError, match="exists already and holds something else"):
            adopt(source, data, 3, _no_colmap)
    assert {path: path.read_bytes() for path in data.iterdir()} == before


def test_what_lies_beside_the_capture_does_not_make_it_another(tmp_path: Path) -> None:
    data = tmp_path / "data/garden"
    _photos(data)
    (data / "notes.txt").write_text("taken in May")
    adopt(data, data, 3, _no_colmap)  # the folder itself, as the README's FROM=data/garden
    source = tmp_path / "capture"
    _photos(source)
    (data / "notes.txt").unlink()
    for clutter in (".DS_Store", "Thumbs.db", f"._{NAMES[0]}"):
        (data / clutter).touch()
    adopt(source, data, 3, _no_colmap)


def test_two_runs_do_not_bring_photos_to_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second would clear away what the first has copied so far."""
    source, data = tmp_path / "capture", tmp_path / "data/garden"
    _photos(source)
    copy, told = shutil.copyfile, []

    def meanwhile(path: Path, target: Path) -> None:
        with pytest.raises(UserError, match=r"are being copied to .*garden already") as error:
            adopt(source, data, 3, _no_colmap)
        told.append(error)
        copy(path, target)

    monkeypatch.setattr("pipeline.io.capture.shutil.copyfile", meanwhile)
    adopt(source, data, 3, _no_colmap)
    assert len(told) == len(NAMES)
    assert sorted(path.name for path in data.iterdir()) == list(NAMES)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf8_are_told(tmp_path: Path) -> None:
    source = tmp_path / "capture"
    _photos(source)
    (source / NAMES[0]).rename(os.fsdecode(os.fsencode(source) + b"/caf\xe9.jpg"))
    with pytest.raises(UserError, match=r"caf\\xe9\.jpg: the name is not UTF-8"):
        adopt(source, tmp_path / "data/garden", 3, _no_colmap)
    assert not (tmp_path / "data/garden").exists()


def test_a_tilde_that_no_shell_has_expanded_is_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`make scene FROM=~/photos` gets there so from some shells."""
    monkeypatch.setenv("HOME", str(tmp_path))
    _photos(tmp_path / "my photos")
    adopt(Path("~/my photos"), tmp_path / "data/garden", 3, _no_colmap)
    assert sorted(path.name for path in (tmp_path / "data/garden").iterdir()) == list(NAMES)
    with pytest.raises(UserError, match="~nobody-here/photos does not exist"):
        adopt(Path("~nobody-here/photos"), tmp_path / "data/other", 3, _no_colmap)


@pytest.mark.parametrize("kind", ["../elsewhere/", "/absolute/"])
def test_photos_outside_of_the_folder_are_refused(tmp_path: Path, kind: str) -> None:
    source = tmp_path / "capture"
    _photos(tmp_path / "elsewhere")
    there = kind if kind.startswith("..") else f"{tmp_path}/elsewhere/"
    content = _transforms(source)
    for frame in content["frames"]:
        frame["file_path"] = there + Path(frame["file_path"]).name
    _write(source, content)
    with pytest.raises(UserError, match=r"transforms\.json names .*a\.jpg, which lies outside"):
        refuse_outside(source, _find(source))
    _photos(source / "images")
    _write(source, _transforms(source))
    refuse_outside(source, _find(source))


def test_adopting_what_cannot_be_used_leaves_nothing(tmp_path: Path) -> None:
    source, data = tmp_path / "capture", tmp_path / "data/garden"
    _photos(tmp_path / "elsewhere")
    content = _transforms(source)
    for frame in content["frames"]:
        frame["file_path"] = "../elsewhere/" + Path(frame["file_path"]).name
    _write(source, content)
    with pytest.raises(UserError, match="lies outside"):
        adopt(source, data, 3, _no_colmap)
    _photos(source / "images")
    for frame in content["frames"]:  # within, but not within the copy
        frame["file_path"] = f"{source}/images/" + Path(frame["file_path"]).name
    _write(source, content)
    with pytest.raises(UserError, match=r"a\.jpg by an absolute path"):
        adopt(source, data, 3, _no_colmap)
    with pytest.raises(UserError, match="nothing does not exist"):
        adopt(tmp_path / "nothing", data, 3, _no_colmap)
    with pytest.raises(UserError, match="no folder and no video"):
        adopt(source / "transforms.json", data, 3, _no_colmap)
    assert not data.exists()


def test_a_video_beside_poses_is_not_taken_for_the_scene(tmp_path: Path) -> None:
    """Poses are those of photos: which of the two is meant, the user says."""
    _photos(tmp_path / "images")
    _write(tmp_path, _transforms(tmp_path))
    (tmp_path / "walk.mp4").touch()
    with pytest.raises(UserError, match=r"holds walk\.mp4 and transforms\.json"):
        _find(tmp_path)
    (tmp_path / "transforms.json").unlink()
    for part in ("cameras", "images", "points3D"):
        (tmp_path / "sparse/0").mkdir(parents=True, exist_ok=True)
        (tmp_path / f"sparse/0/{part}.bin").touch()
    with pytest.raises(UserError, match=r"holds walk\.mp4 and cameras\.bin"):
        _find(tmp_path)


def test_a_stray_picture_above_the_photos_is_not_the_capture(tmp_path: Path) -> None:
    for folder in ("images_8", "images", "images_4"):
        _photos(tmp_path / folder)
    np.save(tmp_path / "poses_bounds.npy", np.stack([_llff_row(x, 30, 40, 50) for x in range(3)]))
    Image.new("RGB", (40, 30)).save(tmp_path / "overview.png")
    found = _find(tmp_path)
    assert {path.parent.name for path in found.photos.values()} == {"images"}
    assert len(found.views) == 3


def test_masks_that_the_poses_name_go_before_all_others(tmp_path: Path) -> None:
    _photos(tmp_path / "images", (80, 60))
    content = _transforms(tmp_path)
    for frame in content["frames"]:
        frame["mask_path"] = f"{frame['file_path']}.mask.png"
        Image.new("L", (80, 60), 255).save(tmp_path / frame["mask_path"])
    _write(tmp_path, content)
    np.save(tmp_path / "rainMask.npy", np.ones((60, 80, 3), np.uint8))
    capture = _find(tmp_path)
    assert capture.masked_by == "mask pictures" and len(capture.masks) == 3
    assert all(keep_mask.all() for _, keep_mask in given_masks(capture)), "not rainMask's drops"


@pytest.mark.parametrize("place", ["photo", "truth"])
def test_links_to_nowhere_are_not_left_out_of_a_copy(tmp_path: Path, place: str) -> None:
    source, data = tmp_path / "capture", tmp_path / "data/garden"
    _photos(source)
    link = source / ("d.jpg" if place == "photo" else "truth/clean/a.png")
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to("/absent")
    with pytest.raises(UserError, match=re.escape(str(link))):
        adopt(source, data, 3, _no_colmap)
    assert not data.exists() and list(data.parent.glob(".*tmp-*")) == []


def test_archives_and_headers_that_lie_are_no_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "several.npz", a=np.zeros(3))
    several = (tmp_path / "several.npz").read_bytes()
    array, vast = tmp_path / "p.npy", io.BytesIO()
    told = {"descr": "<f8", "fortran_order": False, "shape": (10**13, 17)}
    np.lib.format.write_array_header_1_0(vast, told)
    for content in (several, several[:100], b"PK\x03\x04", b"", vast.getvalue()):
        array.write_bytes(content)
        with pytest.raises(UserError, match=r"p\.npy is not a readable array"):
            read_poses_bounds(array, [])


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        (np.array([[0, 255]], np.uint16), [[False, True]]),
        (np.array([[0.0, 0.4, 0.6, 1.0]], np.float32), [[False, False, True, True]]),
        (np.array([[0.0, 255.0]], np.float32), [[False, True]]),
    ],
)
def test_masks_of_wider_numbers_than_their_values_need(
    tmp_path: Path, values: np.ndarray, kept: list[list[bool]]
) -> None:
    """8-bit values in 16 bits, floats: their range tells, not their type."""
    cv2.imwrite(str(tmp_path / "m.tiff"), values)
    assert read_foreign_mask(tmp_path / "m.tiff").tolist() == kept


def test_a_focal_length_of_nothing_is_no_defect(tmp_path: Path) -> None:
    _photos(tmp_path / "images")
    path = _write(tmp_path, _transforms(tmp_path, fl_x=1e-200, fl_y=1e-200, k1=0.1))
    assert not read_nerfstudio(path)[0].carried
