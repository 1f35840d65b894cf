"""The options of the stages `nerf` and `render` that only whole artifacts show."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from pipeline.io.images import read_image, write_image
from pipeline.io.maps import write_map
from pipeline.io.masks import write_keep_mask
from tests.faults.workshop import Workshop


def _fitted(scene: Workshop) -> bytes:
    done = scene.run("nerf")
    assert done.code == 0, done.said
    return (scene.artifacts / "nerf/field.safetensors").read_bytes()


def test_soft_masks_are_the_attention_of_what_is_kept(whole: Workshop) -> None:
    """Attention of nothing weighs nothing down; in stripes it does."""
    plain = _fitted(whole)
    whole.set("nerf", soft_masks=True)
    maps = sorted((whole.artifacts / "attention").glob("view_*.exr"))
    size = read_image(whole.artifacts / "images" / f"{maps[0].stem}.png").shape[:2]
    for path in maps:
        write_map(path, np.zeros(size, np.float32))
    assert _fitted(whole) == plain
    patchy = np.zeros(size, np.float32)
    patchy[:, ::2] = 0.5
    for path in maps:
        write_map(path, patchy)
    assert _fitted(whole) != plain
    maps[0].unlink()
    whole.refuses("nerf", f"{maps[0].name} does not exist", "python -m stages.attention")


def test_a_darker_photo_is_mended_as_dark_as_it_is(whole: Workshop) -> None:
    """All photos half as bright and the field told so: composites are half as bright, in the drops too."""
    assert whole.run("render").code == 0
    about = json.loads((whole.artifacts / "nerf/field.json").read_text())
    before = {}
    for name in about["photos"]:
        photo = read_image(whole.artifacts / "images" / name)
        keep_mask = np.ones(photo.shape[:2], bool)
        keep_mask[40:120, 60:180] = False
        write_keep_mask(whole.artifacts / "refine" / name, keep_mask)
        before[name] = keep_mask
    assert whole.run("render").code == 0
    lit = {name: read_image(whole.artifacts / "views/composite" / name) for name in before}
    for name in before:
        path = whole.artifacts / "images" / name
        write_image(path, 0.5 * read_image(path))
    about["gains"] = [[0.5] * 3] * len(about["photos"])
    (whole.artifacts / "nerf/field.json").write_text(json.dumps(about))
    assert whole.run("render").code == 0
    for name, keep_mask in before.items():
        dark = read_image(whole.artifacts / "views/composite" / name)
        inside = cv2.erode((~keep_mask).astype(np.uint8), np.ones((9, 9))) > 0
        assert np.abs(dark - 0.5 * lit[name])[inside].mean() < 0.01


@pytest.mark.parametrize("gains", [[[1.0] * 3], [[1.0] * 2] * 9, [[-1.0] * 3] * 9, "bright"])
def test_gains_that_fit_no_photos_are_told(whole: Workshop, gains: object) -> None:
    path = whole.artifacts / "nerf/field.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"gains": gains}))
    whole.refuses("render", "tells no depths or brightnesses", "python -m stages.nerf")
