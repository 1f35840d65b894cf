from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.evaluation.references import find_references, read_reference
from pipeline.io.images import write_image
from pipeline.io.scene import ImageRecord


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


def test_a_reference_of_another_size_is_refused(tmp_path):
    write_image(tmp_path / "a.png", picture(16, 12))
    with pytest.raises(UserError, match="16x12, its image is 8x6"):
        read_reference(tmp_path / "a.png", record(8, 6), tmp_path / "a.jpg")
    cv2.imwrite(str(tmp_path / "a.jpg"), picture(16, 12))
    with pytest.raises(UserError, match="16x12, its image is 6x8"):
        read_reference(tmp_path / "a.png", record(6, 8), tmp_path / "a.jpg")
