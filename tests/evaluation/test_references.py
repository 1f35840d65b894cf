from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UserError
from pipeline.evaluation.references import find_references, read_reference
from pipeline.io.images import write_image
from pipeline.io.scene import ImageRecord, read_images_json
from pipeline.stage import Job
from stages import ingest


def record(width: int, height: int, turned: int = 0, name: str = "a.png") -> ImageRecord:
    return ImageRecord(name, "a.jpg", "0" * 64, width, height, None, "train", turned)


def picture(width: int, height: int) -> np.ndarray:
    random = np.random.default_rng(width)
    return random.integers(0, 256, (height, width, 3)).astype(np.uint8)


def test_references_are_found_by_stem_whatever_their_suffix(tmp_path):
    records = [record(8, 6), record(8, 6, name="b.png")]
    assert find_references(tmp_path / "clean", records) is None
    write_image(tmp_path / "a.png", picture(8, 6))
    cv2.imwrite(str(tmp_path / "b.jpg"), picture(8, 6))
    (tmp_path / "notes.txt").write_text("not a picture")
    found = find_references(tmp_path, records)
    assert {name: path.name for name, path in found.items()} == {"a.png": "a.png", "b.png": "b.jpg"}


def test_references_are_renamed_as_ingest_renames_their_photos(tmp_path):
    """`IMG 1.jpg` becomes the image IMG_1.png; `mean` is taken, by the temporal mean."""
    for name in ("IMG 1.png", "mean.png", ".b.png", "c_d.png"):
        write_image(tmp_path / name, picture(8, 6))
    names = ("IMG_1.png", "mean_.png", "_b.png", "c_d.png")
    found = find_references(tmp_path, [record(8, 6, name=name) for name in names])
    assert [found[name].name for name in names] == ["IMG 1.png", "mean.png", ".b.png", "c_d.png"]
    write_image(tmp_path / "IMG_1.png", picture(8, 6))
    with pytest.raises(UserError, match="one image"):
        find_references(tmp_path, [record(8, 6, name="IMG_1.png")])


def test_a_missing_or_doubled_reference_is_named(tmp_path):
    write_image(tmp_path / "a.png", picture(8, 6))
    with pytest.raises(UserError, match=r"no reference for b\.png"):
        find_references(tmp_path, [record(8, 6), record(8, 6, name="b.png")])
    write_image(tmp_path / "a.bmp.png", picture(8, 6))
    cv2.imwrite(str(tmp_path / "a.jpg"), picture(8, 6))
    with pytest.raises(UserError, match="one image"):
        find_references(tmp_path, [record(8, 6)])


@pytest.mark.parametrize("turned", [0, 90, 180, 270])
def test_a_reference_is_turned_as_its_photo_was(tmp_path, turned):
    stored = picture(8, 6)
    write_image(tmp_path / "a.png", stored)
    size = (8, 6) if turned % 180 == 0 else (6, 8)
    read = read_reference(tmp_path / "a.png", record(*size, turned), tmp_path / "a.jpg")
    np.testing.assert_allclose(read * 255, np.rot90(stored, turned // 90), atol=1e-4)


def test_a_reference_of_the_photos_size_is_scaled_like_the_photo(tmp_path):
    stored = picture(16, 12)
    write_image(tmp_path / "a.png", stored)
    cv2.imwrite(str(tmp_path / "a.jpg"), picture(16, 12))
    read = read_reference(tmp_path / "a.png", record(8, 6), tmp_path / "a.jpg")
    blocks = stored.reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
    assert np.abs(read * 255 - blocks).max() <= 0.51


@pytest.mark.parametrize("content", [b"", b"rain", b"\x89PNG\r\n\x1a\n"])
def test_a_photo_that_cannot_be_read_any_more_is_no_defect(tmp_path, content):
    write_image(tmp_path / "a.png", picture(16, 12))
    (tmp_path / "photo.jpg").write_bytes(content)
    with pytest.raises(UserError, match="its image is 8x6"):
        read_reference(tmp_path / "a.png", record(8, 6), tmp_path / "photo.jpg")


def test_a_reference_of_another_size_is_refused(tmp_path):
    write_image(tmp_path / "a.png", picture(16, 12))
    with pytest.raises(UserError, match="16x12, its image is 8x6"):
        read_reference(tmp_path / "a.png", record(8, 6), tmp_path / "a.jpg")
    cv2.imwrite(str(tmp_path / "a.jpg"), picture(16, 12))
    with pytest.raises(UserError, match="16x12, its image is 6x8"):
        read_reference(tmp_path / "a.png", record(6, 8), tmp_path / "a.jpg")


@pytest.mark.parametrize(
    "lens",
    [
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.1},
        {"k1": -0.3, "k2": 0.1},
        {"k1": -0.3, "k2": 0.1, "turned": 6},
    ],
)
@pytest.mark.parametrize("scale", [1, 2])
def test_a_reference_is_straightened_as_its_photo_was(tmp_path: Path, lens, scale: int) -> None:
    """The photo itself, taken for its reference, must come out as the image does."""
    data, turned = tmp_path / "data/made", lens.get("turned", 1)
    data.mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0112] = turned
    smooth = cv2.resize(picture(9, 7), (120, 90), interpolation=cv2.INTER_CUBIC)
    frames = []
    for number, name in enumerate("abc"):
        Image.fromarray(smooth).save(data / f"{name}.png", exif=exif)
        matrix = np.eye(4)
        matrix[0, 3] = number
        frames.append({"file_path": f"{name}.png", "transform_matrix": matrix.tolist()})
    size = (120, 90) if turned == 1 else (90, 120)
    numbers = {"w": size[0], "h": size[1], "fl_x": 70.0, "cx": 0.52 * size[0], **lens}
    (data / "transforms.json").write_text(json.dumps({**numbers, "frames": frames}))
    job = Job(tmp_path, "made", None, "cpu", None, False)
    how = {"min_images": 3, "holdout": 2, "frames": 4, "mixed_sizes": "scale"}
    ingest.main(job, ingest.Params(max_size=120 // scale, **how))
    one = read_images_json(job.paths.images)[0]
    assert one.lens is not None and one.turned == 0
    image = cv2.imread(str(job.paths.images / "a.png"))[..., ::-1]
    read = read_reference(data / "a.png", one, data / "a.png") * 255
    assert np.abs(read - image).max() <= 0.51
    bare = read_reference(data / "a.png", replace(one, lens=None), data / "a.png") * 255
    assert np.abs(bare - image).mean() > 3, "the lens matters here"
