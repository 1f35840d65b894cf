from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UserError
from pipeline.io.images import can_read, image_size, read_photo, turn
from pipeline.io.intake import enough
from pipeline.io.photos import (
    Photo,
    convert,
    examine,
    final_size,
    list_photos,
    plan_sizes,
)
from pipeline.io.scene import image_name

ORIENTATION = 0x0112
FOCAL_35MM = 0xA405
EXIF_IFD = 0x8769


def _photo(
    path: Path, size: tuple[int, int] = (40, 30), orientation: int = 1, focal: int = 0
) -> Path:
    """A photo whose stored top left corner is red and top right corner is green."""
    pixels = np.full((size[1], size[0], 3), 90, np.uint8)
    pixels[:8, :8] = (250, 0, 0)
    pixels[:8, -8:] = (0, 250, 0)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif[0x010E] = path.stem  # a description: no two photos are the same file
    if focal:
        exif.get_ifd(EXIF_IFD)[FOCAL_35MM] = focal
    Image.fromarray(pixels).save(path, quality=95, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_become_upright_as_the_metadata_says(tmp_path: Path, orientation: int) -> None:
    from PIL import ImageOps

    path = _photo(tmp_path / "a.jpg", orientation=orientation)
    pixels, info = read_photo(path)
    with Image.open(path) as photo:
        expected = np.asarray(ImageOps.exif_transpose(photo).convert("RGB"))
    assert np.array_equal(turn(pixels, info.upright_turn), expected)


def test_focal_length_in_pixels_from_the_35mm_equivalent(tmp_path: Path) -> None:
    # 43.27 mm is the diagonal of 35 mm film; the photo's is 50 px: f = 28 / 43.27 * 50 = 32.36 px
    photo = examine(_photo(tmp_path / "a.jpg", focal=28))
    assert photo.focal_px == pytest.approx(32.36, abs=0.01)
    assert examine(_photo(tmp_path / "b.jpg")).focal_px is None


def test_portrait_and_landscape_of_one_camera_get_one_size(tmp_path: Path) -> None:
    photos = {
        name: examine(_photo(tmp_path / name, orientation=orientation))
        for name, orientation in (("a.jpg", 1), ("b.jpg", 1), ("c.jpg", 6))
    }
    plan = plan_sizes(photos)
    assert plan.turns == {"a.jpg": 0, "b.jpg": 0, "c.jpg": 0}, "all in the frame of the sensor"
    assert (plan.size, plan.left_out) == ((40, 30), [])
    assert plan.said == ["1 of 3 photos stay turned, so that drops on the lens keep their place"]
    portraits = {
        name: examine(_photo(tmp_path / name, orientation=6)) for name in ("d.jpg", "e.jpg")
    }
    plan = plan_sizes(portraits)
    assert set(plan.turns.values()) == {270}, "all portrait: upright"
    assert (plan.size, plan.said) == ((30, 40), [])


@pytest.mark.parametrize(
    "size, orientations, common",
    [((40, 30), (1, 1, 1, 3), 0), ((40, 30), (6, 6, 8), 270), ((30, 30), (1, 6, 1), 0)],
)
def test_photos_that_fit_either_way_stay_in_the_frame_of_the_sensor(
    tmp_path: Path, size: tuple[int, int], orientations: tuple[int, ...], common: int
) -> None:
    """Made upright, they would have one size too, but a drop on the lens two places."""
    photos = {
        f"{n}.jpg": examine(_photo(tmp_path / f"{n}.jpg", size, orientation=orientation))
        for n, orientation in enumerate(orientations)
    }
    plan = plan_sizes(photos)
    assert set(plan.turns.values()) == {common}
    assert plan.said == [
        f"1 of {len(photos)} photos stay turned, so that drops on the lens keep their place"
    ]


def test_photos_that_only_fit_upright_are_made_so(tmp_path: Path) -> None:
    """One was turned by a program, its pixels and all."""
    photos = {
        "a.jpg": examine(_photo(tmp_path / "a.jpg", (40, 30), orientation=6)),
        "b.jpg": examine(_photo(tmp_path / "b.jpg", (40, 30), orientation=6)),
        "c.jpg": examine(_photo(tmp_path / "c.jpg", (30, 40))),
    }
    plan = plan_sizes(photos)
    assert plan.turns == {"a.jpg": 270, "b.jpg": 270, "c.jpg": 0}
    assert (plan.size, plan.said) == ((30, 40), [])


def _examined(folder: Path, *sizes: tuple[int, int]) -> dict[str, Photo]:
    return {
        f"{number}.png": examine(_photo(folder / f"{number}.jpg", size))
        for number, size in enumerate(sizes)
    }


def test_photos_of_one_shape_are_scaled_to_the_smallest_and_it_is_said(tmp_path: Path) -> None:
    photos = _examined(tmp_path, (80, 60), (40, 30), (80, 60), (57, 43))
    plan = plan_sizes(photos)
    assert (plan.size, plan.left_out) == ((40, 30), ["3.png"])
    assert "2 of 80x60, 1 of 40x30" in plan.said[0]
    assert plan.said[1].endswith("left out: 3"), "57/43 = 1.326 is not 4/3"
    with pytest.raises(UserError, match=r"mixed sizes: 2 of 80x60, 1 of 40x30, 1 of 57x43"):
        plan_sizes(photos, mixed="refuse")


def test_photos_that_fall_apart_into_many_shapes_are_refused(tmp_path: Path) -> None:
    photos = _examined(tmp_path, (40, 30), (44, 30), (48, 30))
    with pytest.raises(UserError, match=r"1 of 40x30, 1 of 44x30, 1 of 48x30"):
        plan_sizes(photos)


def test_images_have_the_size_that_was_planned(tmp_path: Path) -> None:
    assert final_size((400, 300), 200) == (200, 150)
    assert final_size((400, 300), 0) == final_size((400, 300), 4000) == (400, 300)
    path = _photo(tmp_path / "a.jpg", (400, 300))
    convert(path, tmp_path / "a.png", 0, (200, 150))
    convert(path, tmp_path / "b.png", 90, (300, 400))
    assert image_size(tmp_path / "a.png") == (200, 150)
    assert image_size(tmp_path / "b.png") == (300, 400)


def test_what_is_transparent_is_black(tmp_path: Path) -> None:
    pixels = np.full((6, 8, 4), 255, np.uint8)
    pixels[:, :4, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    read, _ = read_photo(tmp_path / "a.png")
    assert read[:, :4].max() == 0 and read[:, 4:].min() == 255


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_photos_of_phones_come_as_the_sensor_saw_them(tmp_path: Path, suffix: str) -> None:
    """Whoever decodes them turns some upright unasked: a drop on the lens would have two places."""
    if not can_read(suffix):
        pytest.skip(f"{suffix} needs another package")
    rng = np.random.default_rng(0)
    seen = np.repeat(np.repeat(rng.integers(0, 256, (6, 8, 3), np.uint8), 8, 0), 8, 1)
    for orientation, degrees in ((1, 0), (3, 180), (6, 270), (8, 90)):
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        path = tmp_path / f"{orientation}{suffix}"
        Image.fromarray(seen).save(path, quality=95, exif=exif.tobytes())
        pixels, info = read_photo(path)
        assert info.upright_turn == degrees
        assert pixels.shape == seen.shape
        assert np.abs(pixels.astype(int) - seen).mean() < 12


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_damaged_photos_of_phones_are_told(tmp_path: Path, suffix: str) -> None:
    if not can_read(suffix):
        pytest.skip(f"{suffix} needs another package")
    rng = np.random.default_rng(1)
    path = tmp_path / f"a{suffix}"
    Image.fromarray(rng.integers(0, 256, (48, 64, 3), np.uint8)).save(path)
    whole, refused = path.read_bytes(), 0
    for _ in range(150):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 6):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            read_photo(path)
        except UserError:
            refused += 1
    assert refused > 10


def test_a_drawing_called_a_photo_is_not_run(tmp_path: Path) -> None:
    """Pillow would hand PostScript to Ghostscript: here it would never end."""
    path = tmp_path / "a.jpg"
    path.write_text(
        "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n{ } loop\n%%EOF\n"
    )
    with pytest.raises(UserError, match=r"a\.jpg is not an image"):
        read_photo(path)
    with pytest.raises(OSError):
        image_size(path)


def test_heic_without_its_package_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.io.photos.can_read", lambda suffix: suffix != ".heic")
    (tmp_path / "a.heic").touch()
    with pytest.raises(UserError, match=r"HEIC files need another package.*\[heic\]"):
        list_photos(tmp_path, 1)


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK", "I;16", "LA"])
def test_every_kind_of_pixel_becomes_rgb(tmp_path: Path, mode: str) -> None:
    if mode == "I;16":
        photo = Image.fromarray(np.full((6, 8), 65535, np.uint16))
    else:
        photo = Image.new("RGB", (8, 6), "white").convert(mode)
    path = tmp_path / ("a.tif" if mode in ("CMYK", "I;16") else "a.png")
    photo.save(path)
    pixels, _ = read_photo(path)
    assert pixels.shape == (6, 8, 3)
    assert pixels.dtype == np.uint8
    assert pixels.min() >= 250


def test_grey_floats_between_0_and_1_are_no_black_photo(tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 11, dtype=np.float32).reshape(1, 11)
    for name, top in (("one.tif", 1), ("bytes.tif", 255), ("words.tif", 65535)):
        Image.fromarray(ramp * top).save(tmp_path / name)
        pixels, _ = read_photo(tmp_path / name)
        assert np.abs(pixels[0, :, 0] - 255 * ramp[0]).max() <= 0.5 + 1e-3, name


def test_a_photo_that_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(path: Path, **options: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Image, "open", forbidden)
    with pytest.raises(UserError, match=r"a\.jpg cannot be read \(Permission denied\)"):
        read_photo(tmp_path / "a.jpg")


def test_photos_of_200_megapixels_are_read_and_larger_ones_told_so(tmp_path: Path) -> None:
    """Phones take 16320x12240; Pillow alone refuses more than 179 million pixels as an attack."""
    photo = tmp_path / "a.png"
    photo.write_bytes(_png_header(16320, 12240))
    assert image_size(photo) == (16320, 12240)
    with pytest.raises(
        UserError, match=r"a\.png is damaged or cut short \(image file is truncated"
    ):
        read_photo(photo)  # only because there is nothing behind the header
    photo.write_bytes(_png_header(100_000, 100_000))
    with pytest.raises(UserError, match="has 100000x100000 pixels"):
        read_photo(photo)


def _png_header(width: int, height: int) -> bytes:
    """The beginning of a grey PNG without any pixels."""
    size = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = ((size, 13), (b"IDAT", 0), (b"IEND", 0))
    told = (struct.pack(">I", n) + data + struct.pack(">I", zlib.crc32(data)) for data, n in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(told)


def test_what_is_no_photo_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("not a photo")
    with pytest.raises(UserError, match=r"text\.jpg is not an image"):
        read_photo(tmp_path / "text.jpg")
    (tmp_path / "empty.jpg").touch()
    with pytest.raises(UserError, match=r"empty\.jpg"):
        read_photo(tmp_path / "empty.jpg")
    whole = _photo(tmp_path / "whole.jpg", (400, 300)).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(UserError, match=r"cut\.jpg is damaged or cut short"):
        read_photo(tmp_path / "cut.jpg")


def test_the_folder_is_listed_by_the_names_images_will_have(tmp_path: Path) -> None:
    for name in ("b two.JPG", "a.jpg", "mean.png"):
        _photo(tmp_path / Path(name).with_suffix(".jpg")).rename(tmp_path / name)
    (tmp_path / ".DS_Store").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "truth").mkdir()
    assert list(list_photos(tmp_path, 1)) == ["a.png", "b_two.png", "mean_.png"]
    assert image_name(Path("-x.jpg")) == "_x.png"
    latin = os.fsdecode(b"caf\xe9.jpg")  # a name that is no UTF-8
    assert image_name(Path(latin)) == "caf_.png"
    with pytest.raises(UserError, match="3 photos only"):
        list_photos(tmp_path, 4)
    _photo(tmp_path / "a.png")
    with pytest.raises(UserError, match=r"both become a\.png"):
        list_photos(tmp_path, 1)


def test_photos_in_a_subfolder_are_pointed_at(tmp_path: Path) -> None:
    (tmp_path / "roll" / "one").mkdir(parents=True)
    with pytest.raises(UserError, match="Twenty or more"):
        list_photos(tmp_path, 1)
    _photo(tmp_path / "roll" / "a.jpg")
    with pytest.raises(UserError, match=r"holds no photos.*name .*roll with --from"):
        list_photos(tmp_path, 1)


def test_raw_files_name_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "a.dng").touch()
    _photo(tmp_path / "b.jpg")
    with pytest.raises(UserError, match=r"a\.dng.*Convert them to JPEG"):
        list_photos(tmp_path, 1)
    _photo(tmp_path / "a.JPG")
    assert list(list_photos(tmp_path, 1)) == ["a.png", "b.png"], "cameras can store both"


def _named(sha256: str, size: tuple[int, int] = (40, 30)) -> Photo:
    return Photo(*size, 0, None, sha256)


def test_copies_of_a_photo_are_left_out() -> None:
    """Phones and cloud folders make `IMG_1 (1).jpg`: held out, it would be judged against itself."""
    photos = {f"{name}.png": _named(name[0]) for name in ("a", "b", "a_(1)", "c")}
    plan = plan_sizes(photos)
    assert sorted(plan.turns) == ["a.png", "b.png", "c.png"] and plan.left_out == ["a_(1).png"]
    assert plan.said == ["left out as copies of other photos, byte for byte (1 of 4): a_(1)"]
    given = plan_sizes(photos, fixed_turns=dict.fromkeys(photos, 0))
    assert len(given.turns) == 4, "a pose holds for each"


def test_what_is_left_must_still_be_a_scene() -> None:
    photos = {f"{i}.png": _named("a") for i in range(6)}
    with pytest.raises(UserError, match=r"1 of 6 photos can be used: left out as copies"):
        enough(plan_sizes(photos), photos, 3)
    mixed = {f"{i}.png": _named(str(i), (40, 30) if i < 2 else (30, 30)) for i in range(4)}
    with pytest.raises(UserError, match=r"2 of 4 photos can be used: 2 of 4 .* another shape"):
        enough(plan_sizes(mixed), mixed, 3)
