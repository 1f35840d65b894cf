"""What users get wrong ends with exit code 2 and a sentence, and leaves nothing half-written."""

from __future__ import annotations

import os
import shutil
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.io.images import write_image
from tests.faults.workshop import CHAIN, SCENE, Workshop


def _photos(workshop: Workshop) -> list[Path]:
    return sorted(workshop.data.glob("*.png"))


def _as_jpeg(path: Path) -> Path:
    target = path.with_suffix(".jpg")
    Image.open(path).save(target, quality=90)
    path.unlink()
    return target


# --- photos --------------------------------------------------------------------------------------


def test_a_missing_folder(photos: Workshop) -> None:
    shutil.rmtree(photos.data)
    photos.refuses("ingest", f"data/{SCENE} does not exist", "Put your photos there")


def test_an_empty_folder(photos: Workshop) -> None:
    for path in _photos(photos):
        path.unlink()
    photos.refuses("ingest", f"data/{SCENE} holds no photos")


def test_one_photo_only(photos: Workshop) -> None:
    for path in _photos(photos)[1:]:
        path.unlink()
    photos.refuses("ingest", "one photo only", "at least 3")


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_a_truncated_jpeg(photos: Workshop, share: float) -> None:
    path = _as_jpeg(_photos(photos)[4])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    photos.refuses("ingest", str(path))


def test_a_truncated_png(photos: Workshop) -> None:
    path = _photos(photos)[4]
    path.write_bytes(path.read_bytes()[:4000])
    photos.refuses("ingest", str(path), "cut short")


@pytest.mark.parametrize("content", [b"", b"Dear diary,\n", b"\0" * 5000])
def test_no_photo_in_a_jpg(photos: Workshop, content: bytes) -> None:
    path = photos.data / "view_9.jpg"
    path.write_bytes(content)
    photos.refuses("ingest", f"{path} is not an image", "Remove it")


def test_mixed_sizes(photos: Workshop) -> None:
    photos.set("ingest", mixed_sizes="refuse")
    path = _photos(photos)[3]
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (200, 180)))
    photos.refuses("ingest", "mixed sizes", "8 of 240x180", "1 of 200x180", path.stem)


def test_a_picture_larger_than_any_camera_takes(photos: Workshop) -> None:
    path = _photos(photos)[0]
    data = bytearray(path.read_bytes())
    data[16:24] = (100_000).to_bytes(4, "big") * 2  # width and height in the header
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    path.write_bytes(bytes(data))
    photos.refuses("ingest", str(path))


def test_a_link_to_nowhere(photos: Workshop) -> None:
    path = photos.data / "view_9.jpg"
    path.symlink_to("/absent/view_9.jpg")
    photos.refuses("ingest", str(path))


@pytest.mark.parametrize("name", ["view_9.heic", "view_9.dng", "walk.mp4"])
def test_kinds_that_are_not_read(photos: Workshop, name: str) -> None:
    (photos.data / name).write_bytes(b"whatever")
    photos.refuses("ingest", name)


def test_two_photos_of_one_name(photos: Workshop) -> None:
    shutil.copyfile(_photos(photos)[0], photos.data / "view_0.bmp")
    photos.refuses("ingest", "would both become view_0.png", "Rename")


def test_what_lies_about_in_folders_of_photos_is_no_fault(photos: Workshop) -> None:
    (photos.data / ".DS_Store").write_bytes(b"\0")
    (photos.data / "Thumbs.db").write_bytes(b"\0")
    (photos.data / "notes.txt").write_text("rain")
    (photos.data / "raw").mkdir()
    first = _photos(photos)[0]
    first.rename(first.with_name("-день 1.PNG"))
    done = photos.run("ingest")
    assert done.code == 0, done.said
    assert len(list((photos.artifacts / "images").glob("*.png"))) == 9


def test_names_of_other_alphabets_and_none(photos: Workshop) -> None:
    """What is no UTF-8 in a name becomes an image of another, and everything else can be written."""
    first, second = _photos(photos)[:2]
    first.rename(first.with_name(os.fsdecode(b"stra\xdfe.png")))
    second.rename(second.with_name('it\'s "wet" & 100%.png'))
    assert photos.run("ingest").code == 0
    names = sorted(path.name for path in (photos.artifacts / "images").glob("*.png"))
    assert names[:2] == ["it's_wet_&_100%.png", "stra_e.png"]
    assert all(name.encode() for name in names)


def test_a_name_longer_than_files_may_have(photos: Workshop) -> None:
    first = _photos(photos)[0]
    first.rename(first.with_name("x" * 250 + ".png"))
    photos.refuses("ingest", "xxx", "File name too long")


@pytest.mark.parametrize("place", ["artifacts", "artifacts/.work", f"artifacts/{SCENE}"])
def test_a_file_where_a_folder_is_wanted(photos: Workshop, place: str) -> None:
    path = photos.root / place
    path.parent.mkdir(exist_ok=True)
    path.write_text("")
    outcome = photos.run("ingest")
    assert outcome.code == 2, outcome.said
    assert "cannot be written" in outcome.said and "Traceback" not in outcome.said


# --- parameters ----------------------------------------------------------------------------------


def test_an_unknown_parameter_names_the_nearest(photos: Workshop) -> None:
    photos.set("ingest", max_sise=3)
    photos.refuses("ingest", "ingest.max_sise is unknown (did you mean max_size?)")


@pytest.mark.parametrize(
    ("stage", "key", "value"),
    [
        ("ingest", "max_size", -1),
        ("ingest", "min_images", "many"),
        ("ingest", "min_images", 2),
        ("attention", "steps", 0),
        ("masks", "threshold", 1.5),
        ("masks", "threshold", float("nan")),
        ("masks", "temporal_mean", True),
        ("poses", "seed", -1),
        ("nerf", "samples", 1000),
        ("nerf", "seed", 1.5),
        ("render", "feather_px", float("inf")),
        ("evaluate", "coverage_threshold", 1),
        ("report", "quality", 0),
    ],
)
def test_a_parameter_out_of_range(photos: Workshop, stage: str, key: str, value: object) -> None:
    photos.set(stage, **{key: value})
    photos.refuses(stage, f"params.yaml: {stage}.{key}")


def test_malformed_parameters_tell_the_line(photos: Workshop) -> None:
    file = photos.root / "params.yaml"
    file.write_text(file.read_text() + "\nmasks: threshold: 1\n")
    line = len(file.read_text().splitlines())
    photos.refuses("masks", "not valid YAML", f"line {line}")


def test_parameters_that_are_missing(photos: Workshop) -> None:
    (photos.root / "params.yaml").unlink()
    photos.refuses("masks", "params.yaml does not exist", "--params")


def test_an_unknown_scene(photos: Workshop) -> None:
    photos.refuses("ingest", "scenes.tinny", "Did you mean tiny?", flags=("--scene", "tinny"))


@pytest.mark.parametrize("scene", ["../demo", "a/b", "", "-x", "tiny "])
def test_a_scene_that_is_no_name(photos: Workshop, scene: str) -> None:
    photos.refuses("ingest", flags=(f"--scene={scene}",))


def test_an_unknown_variant(photos: Workshop) -> None:
    photos.refuses("nerf", "unmaskd", "Did you mean unmasked?", flags=("--variant", "unmaskd"))


@pytest.mark.parametrize("stage", ["ingest", "masks", "refine"])
def test_a_variant_does_not_overwrite_what_it_shares(photos: Workshop, stage: str) -> None:
    folder = "images" if stage == "ingest" else stage
    told = (f"--variant unmasked shares {folder}/ with its scene", f"folders.{folder}")
    photos.refuses(stage, *told, flags=("--variant", "unmasked"))


def test_cuda_where_there_is_none(whole: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    whole.refuses("nerf", "no usable CUDA device", "--device auto", flags=("--device", "cuda"))


# --- stages and what they need -------------------------------------------------------------------


@pytest.mark.parametrize("stage", CHAIN)
def test_a_stage_before_its_input_exists(photos: Workshop, stage: str) -> None:
    if stage == "ingest":
        shutil.rmtree(photos.data)
    photos.refuses(stage, "does not exist")


@pytest.mark.parametrize(
    ("stage", "gone", "maker"),
    [
        ("attention", "images/view_3.png", "ingest"),
        ("masks", "attention", "attention"),
        ("masks", "attention/view_3.exr", "attention"),
        ("poses", "masks", "masks"),
        ("nerf", "poses", "poses"),
        ("refine", "masks", "masks"),
        ("refine", "attention/view_3.exr", "attention"),
        ("refine", "poses", "poses"),
        ("nerf", "refine", "refine"),
        ("nerf", "images/view_3.png", "ingest"),
        ("render", "nerf", "nerf"),
        ("render", "nerf/field.safetensors", "nerf"),
        ("render", "poses", "poses"),
        ("render", "refine", "refine"),
        ("render", "refine/view_3.png", "refine"),
        ("evaluate", "views", "render"),
        ("evaluate", "refine", "refine"),
        ("report", "metrics.json", "evaluate"),
        ("report", "images/view_3.png", "ingest"),
    ],
)
def test_one_thing_gone_names_the_stage_that_makes_it(
    whole: Workshop, stage: str, gone: str, maker: str
) -> None:
    path = whole.artifacts / gone
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    whole.refuses(stage, "does not exist", f"python -m stages.{maker}")


def test_one_mask_gone(whole: Workshop) -> None:
    (whole.artifacts / "masks/view_3.png").unlink()
    whole.refuses("poses", "no mask for view_3.png", "python -m stages.masks")


def test_missing_weights(photos: Workshop) -> None:
    assert photos.run("ingest").code == 0
    shutil.rmtree(photos.root / "weights")
    photos.refuses("attention", "weights/unet.safetensors do not exist")


@pytest.mark.parametrize("content", [b"", b"\x80\x04K\x01.", b"no weights at all, but text"])
def test_damaged_weights(photos: Workshop, content: bytes) -> None:
    assert photos.run("ingest").code == 0
    (photos.root / "weights/unet.safetensors").write_bytes(content)
    photos.refuses("attention", "weights/unet.safetensors")


def test_truncated_weights(photos: Workshop) -> None:
    assert photos.run("ingest").code == 0
    file = photos.root / "weights/unet.safetensors"
    file.write_bytes(file.read_bytes()[:100_000])
    photos.refuses("attention", str(file))


@pytest.mark.parametrize("look", ["grey", "different"])
def test_no_image_registered(photos: Workshop, look: str) -> None:
    photos.set("poses", use_masks=False)
    random = np.random.default_rng(0)
    assert photos.run("ingest").code == 0
    for path in (photos.artifacts / "images").glob("*.png"):
        picture = (
            random.random((180, 240, 3)) if look == "different" else np.full((180, 240, 3), 0.5)
        )
        write_image(path, picture)
    photos.refuses("poses", "photos")


def test_everything_masked(whole: Workshop) -> None:
    whole.set("masks", threshold=0, dilation=20)
    whole.refuses("masks", "every pixel of every image would be masked", "Raise masks.threshold")
