from __future__ import annotations

import re
import struct
import time
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import psutil
import pytest
import torch
from safetensors.torch import save_file

from pipeline.errors import UserError
from pipeline.io.images import image_size, read_image, write_image
from pipeline.io.maps import read_depth, read_map, write_depth, write_map
from pipeline.io.masks import read_foreign_mask, read_keep_mask, write_keep_mask
from pipeline.io.posed import posed_records, read_posed_images
from pipeline.io.scene import ImageRecord, read_images_json, write_images_json
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.io.transforms import (
    FAR_OFF,
    ORIGIN,
    View,
    near_origin,
    read_transforms,
    write_transforms,
)
from pipeline.io.video import write_video
from pipeline.io.weights import fill, read_state
from pipeline.tables.shrink import smaller_view


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_an_image_comes_back_to_the_last_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    pixels = rng.integers(0, 256, (13, 17, 3), dtype=np.uint8)
    write_image(tmp_path / "a.png", pixels)
    back = read_image(tmp_path / "a.png")
    assert back.dtype == np.float32
    assert np.array_equal(np.rint(back * 255).astype(np.uint8), pixels)
    write_image(tmp_path / "b.png", back)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_red_is_the_first_channel(tmp_path: Path) -> None:
    red = np.zeros((4, 4, 3), np.float32)
    red[..., 0] = 1
    write_image(tmp_path / "red.png", red)
    assert np.array_equal(read_image(tmp_path / "red.png"), red)


def test_a_map_comes_back_within_half_precision(tmp_path: Path, rng: np.random.Generator) -> None:
    values = rng.random((11, 7), np.float32)
    write_map(tmp_path / "a.exr", values, {"attention:model": "test"})
    assert np.abs(read_map(tmp_path / "a.exr") - values).max() < 5e-4


def test_maps_written_at_different_times_have_the_same_bytes(tmp_path: Path) -> None:
    values = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8)
    write_map(tmp_path / "a.exr", values)
    time.sleep(1.1)
    write_map(tmp_path / "b.exr", values)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_damaged_map_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    write_map(tmp_path / "a.exr", rng.random((64, 64), np.float32))
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match="cannot be read"):
        read_map(tmp_path / "cut.exr")
    with pytest.raises(UserError, match=r"stages\.attention"):
        read_map(tmp_path / "missing.exr")
    with pytest.raises(ValueError, match="NaN"):
        write_map(tmp_path / "nan.exr", np.full((2, 2), np.nan, np.float32))


def test_a_map_whose_header_is_no_text_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    """The library quotes the header when it says what is wrong, and that is no UTF-8."""
    path = tmp_path / "m.exr"
    write_map(path, rng.random((9, 12)))
    path.write_bytes(path.read_bytes().replace(b"chlist", b"\xffhlist"))
    with pytest.raises(UserError, match=r"m\.exr cannot be read \(its header is damaged\)"):
        read_map(path)


def test_depth_keeps_single_precision(tmp_path: Path, rng: np.random.Generator) -> None:
    depth = rng.random((5, 6), np.float32) * 1000
    write_depth(tmp_path / "d.exr", depth)
    assert np.array_equal(read_depth(tmp_path / "d.exr"), depth)


def test_masks_are_255_for_keep(tmp_path: Path, rng: np.random.Generator) -> None:
    keep_mask = rng.random((9, 12)) > 0.5
    write_keep_mask(tmp_path / "m.png", keep_mask)
    stored = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(stored, np.where(keep_mask, 255, 0))
    assert np.array_equal(read_keep_mask(tmp_path / "m.png", (12, 9)), keep_mask)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.ones((4, 5), np.uint8), "other than 0"),
        (np.zeros((4, 5, 3), np.uint8), "3 channels"),
        (np.zeros((5, 5), np.uint8), "its image is 5x4"),
    ],
)
def test_a_mask_that_means_something_else_is_refused(
    tmp_path: Path, values: np.ndarray, sentence: str
) -> None:
    cv2.imwrite(str(tmp_path / "m.png"), values)
    with pytest.raises(UserError, match=sentence):
        read_keep_mask(tmp_path / "m.png", (5, 4))


def test_only_booleans_are_masks(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bool"):
        write_keep_mask(tmp_path / "m.png", np.ones((2, 2), np.uint8))


def test_tensors_and_their_metadata_come_back_with_the_same_bytes(tmp_path: Path) -> None:
    tensors = {"b": np.arange(6.0).reshape(2, 3), "a": np.ones(3, np.float16)}
    metadata = {str(number): "x" * number for number in range(20)}
    save_tensors(tmp_path / "one.safetensors", tensors, metadata)
    save_tensors(tmp_path / "two.safetensors", dict(reversed(tensors.items())), metadata)
    assert (tmp_path / "one.safetensors").read_bytes() == (
        tmp_path / "two.safetensors"
    ).read_bytes()
    back, header = load_tensors(tmp_path / "one.safetensors")
    assert header == metadata
    assert all(np.array_equal(back[name], tensors[name]) for name in tensors)
    (tmp_path / "bad.safetensors").write_bytes(b"not tensors")
    with pytest.raises(UserError, match="safetensors"):
        load_tensors(tmp_path / "bad.safetensors")


def _view(name: str) -> View:
    angle = 0.3
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1, 2, 3]
    return View(name, pose, 100.0, 101.0, 32.0, 24.0, -0.05, 64, 48, 0.5, 9.0)


def test_posed_views_come_back(tmp_path: Path) -> None:
    views = {name: _view(name) for name in ("b.png", "a.png")}
    write_transforms(tmp_path / "transforms.json", views.values())
    back = read_transforms(tmp_path / "transforms.json")
    assert list(back) == ["a.png", "b.png"]
    assert np.allclose(back["a.png"].cam_from_world, views["a.png"].cam_from_world, atol=1e-10)
    assert (back["b.png"].fx, back["b.png"].k1, back["b.png"].far) == (100.0, -0.05, 9.0)


def test_the_file_holds_opengl_axes(tmp_path: Path) -> None:
    """A camera at the origin looking along +z (OpenCV) looks along -z of its own OpenGL frame."""
    view = View("a.png", np.eye(4), 1, 1, 0, 0, 0, 2, 2, 1, 2)
    write_transforms(tmp_path / "t.json", [view])
    import json

    matrix = json.loads((tmp_path / "t.json").read_text())["frames"][0]["transform_matrix"]
    assert np.array_equal(np.array(matrix), np.diag([1, -1, -1, 1]))


def test_poses_far_from_the_origin_are_moved_and_say_from_where(tmp_path: Path) -> None:
    """Poses up to FAR_OFF stay to the last bit, and nothing is written down for them."""
    near, far = [], []
    for number in range(3):
        pose = np.eye(4)
        pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
        pose[:3, 3] = -pose[:3, :3] @ [FAR_OFF - 10, number, 0.5]
        view = View(f"{number}.png", pose, 70, 70, 40, 30, 0.0, 80, 60, 1.0, 9.0)
        near.append(view)
        pose = pose.copy()
        pose[:3, 3] = -pose[:3, :3] @ [4e5 + 0.25, 5e6 + number, 300.25]
        far.append(replace(view, cam_from_world=pose))
    assert all(a is b for a, b in zip(near_origin(near), near, strict=True))
    write_transforms(tmp_path / "near.json", near_origin(near))
    assert "world_origin" not in (tmp_path / "near.json").read_text()
    write_transforms(tmp_path / "far.json", near_origin(far))
    for view in read_transforms(tmp_path / "far.json").values():
        assert view.origin == (4e5, 5e6 + 1, 300)
        number = int(view.name[0])
        assert view.world_from_cam[:3, 3].tolist() == pytest.approx([0.25, number - 1, 0.25])
        back = view.as_given
        assert back.origin == ORIGIN
        assert np.allclose(back.cam_from_world, far[number].cam_from_world, rtol=0, atol=1e-8)
    half = smaller_view(near_origin(far)[0], (40, 30))
    assert half.origin == (4e5, 5e6 + 1, 300), "a smaller picture has the same world"


@pytest.mark.parametrize("origin", ["[1, 2]", '"here"', "[1, 2, NaN]", "7"])
def test_an_origin_that_is_no_place_is_refused(tmp_path: Path, origin: str) -> None:
    view = View("0.png", np.eye(4), 70, 70, 40, 30, 0.0, 80, 60, 1.0, 9.0, (1e5, 0.0, 0.0))
    path = tmp_path / "t.json"
    write_transforms(path, [view])
    words = re.sub(r'("world_origin": )\[[^]]*\]', rf"\g<1>{origin}", path.read_text())
    assert origin in words
    path.write_text(words)
    with pytest.raises(UserError, match=r"t\.json"):
        read_transforms(path)


def test_a_pose_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[0, 0] = 2
    write_transforms(tmp_path / "t.json", [View("a.png", pose, 1, 1, 0, 0, 0, 2, 2, 1, 2)])
    with pytest.raises(UserError, match=r"a\.png"):
        read_transforms(tmp_path / "t.json")


def test_a_narrow_video_is_the_same_whatever_was_in_memory(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    frames = [rng.random((37, 50, 3)).astype(np.float32) for _ in range(24)]
    made = set()
    for k in range(20):
        write_video(tmp_path / "other.mp4", [np.full((45, 60 + 2 * k, 3), k / 20)] * 2, fps=10)
        write_video(tmp_path / "a.mp4", frames, fps=10)
        made.add((tmp_path / "a.mp4").read_bytes())
    assert len(made) == 1


def test_a_video_has_every_frame_even_sides_and_the_same_bytes(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    frames = [rng.random((33, 47, 3)) for _ in range(7)]
    write_video(tmp_path / "a.mp4", frames, fps=10)
    write_video(tmp_path / "b.mp4", frames, fps=10)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as video:
        decoded = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(decoded) == 7
    assert decoded[0].shape == (32, 46, 3)


@pytest.mark.parametrize("spare", [-1, 0])
@pytest.mark.parametrize("held", [25, 36])
def test_photos_that_do_not_fit_into_memory_are_told_before_any_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spare: int, held: int
) -> None:
    """Two photos of 64x48 at 25 bytes per pixel (in the loop 36): a byte less is refused, enough is not."""
    memory, swap = 2 * 64 * 48 * held - 10_000 + spare, 10_000
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=memory))
    monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(free=swap))
    names = ("a.png", "b.png")
    records = [ImageRecord(name, name, "", 64, 48, None, "train", 0) for name in names]
    write_images_json(tmp_path, records)
    told = r"2 photos of 64x48 need about 0\.0 GB" if spare else r"a\.png does not exist"
    with pytest.raises(UserError, match=told):
        read_posed_images(tmp_path, None, {name: _view(name) for name in names}, held)


@pytest.mark.parametrize("over", [1, 0])
def test_more_pixels_than_a_fit_can_number_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, over: int
) -> None:
    """They are numbered from 0 in 32 bits with a sign: 2^31 - 1 are enough, one more is not."""
    monkeypatch.setattr("pipeline.io.posed.free_memory", lambda: 2**60)
    record = ImageRecord("a.png", "a.png", "", 2**31 - 1 + over, 1, None, "train", 0)
    write_images_json(tmp_path, [record])
    view = replace(_view("a.png"), width=record.width, height=1)
    told = r"2\.1 thousand million pixels" if over else r"a\.png does not exist"
    with pytest.raises(UserError, match=told):
        read_posed_images(tmp_path, None, {"a.png": view})


def test_weights_that_numpy_has_no_name_for_are_told(tmp_path: Path) -> None:
    """Published weights are often in bfloat16."""
    save_file({"a": torch.zeros(3, dtype=torch.bfloat16)}, tmp_path / "half.safetensors")
    with pytest.raises(UserError, match=r"half\.safetensors holds numbers .* cannot be read"):
        load_tensors(tmp_path / "half.safetensors")
    save_file({"a": torch.zeros(3)}, tmp_path / "list.safetensors", {"metadata": "[1]"})
    with pytest.raises(UserError, match="no names with values"):
        load_tensors(tmp_path / "list.safetensors")


def test_archives_of_weights(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    big_endian = np.arange(3, dtype=">f4")
    np.savez(path, a=big_endian, about=np.array(["made", "by", "hand"]))
    state = read_state(path)
    assert state.keys() == {"a"} and state["a"].tolist() == [0, 1, 2], "text is no weight"
    for content in (path.read_bytes()[:60], b"PK\x03\x04", b""):
        path.write_bytes(content)
        with pytest.raises(UserError, match="not an npz file"):
            read_state(path)


def test_weights_as_a_trainer_of_waterdrop_removal_saves_them(tmp_path: Path) -> None:
    """Wen et al.'s: the state dict under `network`, beside those of optimiser and scheduler."""
    network = torch.nn.Conv2d(3, 2, 1)
    optimiser = torch.optim.Adam(network.parameters(), betas=(0.0, 0.999))
    network(torch.ones(1, 3, 1, 1)).sum().backward()
    optimiser.step()
    whole = {
        "network": network.state_dict(),
        "optimizer": optimiser.state_dict(),
        "scheduler": torch.optim.lr_scheduler.StepLR(optimiser, 50_000, 0.5).state_dict(),
    }
    torch.save(whole, tmp_path / "75000_state_G.pth")
    state = read_state(tmp_path / "75000_state_G.pth")
    assert state.keys() == {"weight", "bias"}
    assert all(torch.equal(state[name], value) for name, value in network.state_dict().items())


def test_tensors_without_names_are_told(tmp_path: Path) -> None:
    for state in (
        {0: torch.zeros(2)},
        {"state_dict": {"a": torch.zeros(2), (1, 2): torch.ones(1)}},
    ):
        torch.save(state, tmp_path / "numbers.pt")
        with pytest.raises(UserError, match=r"numbers\.pt holds tensors without names \(the first"):
            read_state(tmp_path / "numbers.pt", "Set it.")


def test_weights_that_overflow_are_not_finite(tmp_path: Path) -> None:
    network = torch.nn.Linear(1, 1)
    state = {"weight": torch.full((1, 1), 1e300, dtype=torch.float64), "bias": torch.zeros(1)}
    with pytest.raises(UserError, match="weight holds numbers that are not finite"):
        fill(network, state, "w.npz")


def test_a_picture_that_claims_too_many_pixels_is_told(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    path = tmp_path / "huge.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IEND", b""))
    for read in (read_image, read_keep_mask, read_foreign_mask):
        with pytest.raises(UserError, match=r"huge\.png is not a readable image"):
            read(path)
    with pytest.raises(OSError, match="pixels"):
        image_size(path)


def test_two_poses_of_one_image_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    write_transforms(path, [_view("a.png"), _view("a.png")])
    with pytest.raises(UserError, match=r"a\.png has two poses"):
        read_transforms(path)


def test_poses_for_another_size_are_told_before_any_image_is_read(tmp_path: Path) -> None:
    record = ImageRecord("a.png", "a.jpg", "0", 128, 96, None, "train", 0)
    write_images_json(tmp_path, [record])
    with pytest.raises(UserError, match=r"a\.png is for 64x48 pixels; it has 128x96"):
        posed_records(tmp_path, {"a.png": _view("a.png")})


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"turned": 45}, "turned by 45 degrees"),
        ({"focal_px": -3.0}, "focal length that is not positive"),
        ({"width": 10**400}, "size that is not in pixels"),
    ],
)
def test_entries_of_images_that_cannot_be(
    tmp_path: Path, change: dict[str, Any], told: str
) -> None:
    record = replace(ImageRecord("a.png", "a.jpg", "0", 8, 6, None, "train", 0), **change)
    write_images_json(tmp_path, [record])
    with pytest.raises(UserError, match=told):
        read_images_json(tmp_path)
    write_images_json(tmp_path, [replace(record, turned=0, focal_px=None, width=8)] * 2)
    with pytest.raises(UserError, match=r"it names a\.png twice"):
        read_images_json(tmp_path)
