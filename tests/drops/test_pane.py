"""A pane that stays in the scene, painted onto posed photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.drops import pane, synthesis
from pipeline.drops.optics import make_environment
from pipeline.drops.painter import paint
from pipeline.drops.pane import Shot, pane_before, pane_layer, seen_slopes
from pipeline.drops.shape import Drop, extended_height, sample_drops
from pipeline.errors import UserError
from pipeline.geometry.cameras import intrinsic_matrix, project
from pipeline.io.atomic import read_json
from pipeline.io.transforms import View, write_transforms
from pipeline.stage import Job
from stages import synthesize

K = intrinsic_matrix(240.0, 240.0, 80.0, 60.0)
SIZE = (160, 120)


def turned(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """cam_from_world (3, 3) of a camera turned to the right, up, and about its axis, in radians."""
    aim = cv2.Rodrigues(np.array([pitch, yaw, 0.0]))[0]
    return (aim @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]).T


def camera(x: float = 0.0, y: float = 0.0, z: float = 0.0, *turn: float) -> np.ndarray:
    """cam_from_world (4, 4) of a camera at a place."""
    pose = np.eye(4)
    pose[:3, :3] = turned(*(turn or (0.0, 0.0, 0.0)))
    pose[:3, 3] = -pose[:3, :3] @ [x, y, z]
    return pose


def ahead(distance: float) -> np.ndarray:
    world_from_pane = np.eye(4)
    world_from_pane[2, 3] = distance
    return world_from_pane


@pytest.mark.parametrize(
    "pose", [camera(), camera(0.1, -0.05, 0.1), camera(-0.1, 0.05, 0, 0.35, 0.25, 0.2)]
)
def test_a_drop_lies_where_its_centre_projects(pose: np.ndarray) -> None:
    drop = Drop(center=(0.03, -0.02), radius=0.012, contact_angle=1.0)
    world_from_pane = ahead(0.5)
    pixel, _ = project(np.array([[0.03, -0.02, 0.5]]), pose, K)
    grey = make_environment(np.full((8, 8, 3), 0.5, np.float32), 8.0)
    layer = pane_layer((120, 160), [drop], grey, pose @ world_from_pane, K, blur_px=3.0)
    alpha = layer[..., 3]
    v, u = np.mgrid[:120, :160] + 0.5
    found = [(alpha * u).sum() / alpha.sum(), (alpha * v).sum() / alpha.sum()]
    # A circle seen at a slant is an ellipse whose middle is not quite the circle's.
    np.testing.assert_allclose(found, pixel[0], atol=0.15)


def test_the_slope_is_the_waters_over_the_pane_however_it_is_seen() -> None:
    drop = Drop(center=(0.01, 0.02), radius=0.1, contact_angle=0.8, wobble=((0.1, 1.0),), sag=0.2)
    pose = camera(0.1, 0.1, 0, -0.3, 0.2, 0.3) @ ahead(0.5)
    slope, covered = seen_slopes((120, 160), [drop], pane.pixel_from_pane(K, pose))
    ray = np.linalg.inv(K) @ [70.5, 60.5, 1] @ pose[:3, :3]  # of one pixel, in the pane's frame
    origin = -pose[:3, :3].T @ pose[:3, 3]
    x, y = (origin - ray * origin[2] / ray[2])[:2]
    step = 1e-6

    def height(dx: float, dy: float) -> float:
        return float(extended_height(drop, np.array([x + dx]), np.array([y + dy]))[0])

    by_hand = [height(step, 0) - height(-step, 0), height(0, step) - height(0, -step)]
    assert covered[60, 70] and np.linalg.norm(by_hand) > 0.2 * 2 * step
    np.testing.assert_allclose(slope[60, 70], np.array(by_hand) / (2 * step), atol=0.01)


def test_a_pane_before_a_camera_at_rest_is_the_pane_on_the_lens() -> None:
    rng = np.random.default_rng(3)
    photo = cv2.resize(rng.random((12, 16, 3), dtype=np.float32), SIZE)
    drops = sample_drops(rng, 0.04, 0.03, 0.2, (0.002, 0.008))
    how = {"aperture_radius": 0.001, "focus_distance": 8.0}
    on_lens, alpha = paint(photo, drops, focal_px=240.0, pane_distance=0.12, **how)
    in_scene, same = pane.paint_pane(photo, drops, ahead(0.12), K, **how)
    assert 0.1 < (alpha > 0.5).mean() < 0.3
    np.testing.assert_allclose(same, alpha, atol=1e-5)
    np.testing.assert_allclose(in_scene, on_lens, atol=2e-3)


def test_the_plan_for_a_camera_at_rest_is_that_of_the_lens() -> None:
    photo = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    shared = {
        "seed": 5,
        "pane_m": 0.12,
        "coverage": 0.2,
        "radius_mm": (2.0, 6.0),
        "aperture_mm": 1.0,
    }
    stains = {"dirt": 0.05}
    rainy, alpha = synthesis.painted(
        photo, **shared, stains=stains, focal=240.0, field_of_view_deg=60
    )
    shot = Shot(np.eye(4), K, SIZE)
    plan = synthesis.pane_plan({"a": shot, "b": shot}, **shared, stains=stains)
    again, same = synthesis.painted_pane(photo, shot, *plan, aperture_mm=1.0)
    np.testing.assert_allclose(same, alpha, atol=1e-5)
    assert np.abs(again.astype(int) - rainy).max() <= 1


def test_the_pane_stands_before_the_mean_camera_and_spans_what_all_see() -> None:
    shots = {name: Shot(camera(x), K, SIZE) for name, x in (("left", -0.1), ("right", 0.3))}
    found = pane_before(shots, 0.6, margin=0.01)
    np.testing.assert_allclose(found.world_from_pane[:3, 3], [0.1, 0.0, 0.6], atol=1e-12)
    np.testing.assert_allclose(found.world_from_pane[:3, :3], np.eye(3), atol=1e-12)
    # Half the view at 0.6 m is 0.6 * 80 / 240 across; the cameras stray by 0.2 from their middle.
    np.testing.assert_allclose(found.half, [0.2 + 0.2 + 0.01, 0.6 * 60 / 240 + 0.01])


def test_cameras_behind_the_pane_or_looking_away_are_named() -> None:
    shots = {"a": Shot(camera(z=-0.5), K, SIZE), "ahead": Shot(camera(z=0.5), K, SIZE)}
    with pytest.raises(UserError, match=r"ahead was taken 0\.10 m behind the pane"):
        pane_before(shots, 0.4)
    shots = {str(k): Shot(camera(0.0, 0.0, 0.0, 0.02 * k, 0.0, 0.0), K, SIZE) for k in range(5)}
    aside = {
        **shots,
        "aside": replace(shots["0"], cam_from_world=camera(0.0, 0.0, 0.0, 1.6, 0.0, 0.0)),
    }
    with pytest.raises(UserError, match="aside looks along the pane"):
        pane_before(aside, 0.4)


SHIFT = 0.5 * 16 / 60  # metres by which the second camera moves: 16 pixels of a pane at 0.5 m
RECIPE = {
    "mode": "paint", "place": "street", "source": "dry", "seed": 1, "views": 2, "width": 64,
    "height": 48, "field_of_view_deg": 62, "spp": 4, "clean_spp": 4, "coverage": 0.2,
    "drift_mm": 0.0, "stains": {"dirt": 0.03}, "paint_pane": "scene", "unit_m": 1.0,
    "radius_mm": [15.0, 40.0], "pane_m": 0.5, "aperture_mm": 2.0, "maps": True,
}  # fmt: skip


def capture(root: Path, unit_m: float = 1.0) -> Path:
    """Two photos, the second taken 16 pixels of the pane to the right, with transforms.json."""
    folder = root / "dry"
    views = []
    for k in range(2):
        pixels = np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"images/{k}.png"), pixels)
        cv2.imwrite(str(folder / f"masks/{k}.png"), np.full((48, 64), 255, np.uint8))
        pose = camera(k * SHIFT / unit_m)
        views.append(View(f"{k}.png", pose, 60.0, 60.0, 32.0, 24.0, 0.0, 64, 48, 1.0, 9.0))
    write_transforms(folder / "transforms.json", views, beside="")
    return folder


def job(root: Path) -> Job:
    return Job(root, "wet", None, "cpu", None, False)


def test_posed_photos_see_one_pane_from_their_places(tmp_path: Path) -> None:
    capture(tmp_path)
    synthesize.main(job(tmp_path), synthesize.Params(**RECIPE))
    truth = tmp_path / "data/wet/truth"
    zero, one = (cv2.imread(str(truth / f"coverage/{k}.png"), -1).astype(int) for k in "01")
    assert 0.1 < (zero > 127).mean() < 0.4
    assert not np.array_equal(zero, one)
    # What the first sees 16 pixels from its left border, the second sees at its left border.
    assert np.abs(zero[:, 16:] - one[:, :-16]).max() <= 1
    told = read_json(truth / "cameras.json")
    np.testing.assert_allclose(told["frames"]["1"]["cam_from_world"], camera(SHIFT), atol=1e-9)
    assert (told["fx"], told["width"], told["unit"]) == (60.0, 64, "m")
    keep_mask = cv2.imread(str(truth / "masks/0.png"), -1) == 255
    assert (zero[keep_mask] <= 0.02 * 255 + 0.5).all() and (zero[~keep_mask] >= 5).all()


def test_the_poses_unit_is_taken_into_metres(tmp_path: Path) -> None:
    for name, unit_m in (("metres", 1.0), ("inches", 0.0254)):
        root = tmp_path / name
        capture(root, unit_m)
        synthesize.main(job(root), synthesize.Params(**RECIPE | {"unit_m": unit_m}))
    metres, inches = (
        cv2.imread(str(tmp_path / name / "data/wet/truth/coverage/1.png"), -1).astype(int)
        for name in ("metres", "inches")
    )
    assert np.abs(metres - inches).max() <= 1


def test_photos_without_poses_are_refused_with_what_to_do(tmp_path: Path) -> None:
    (capture(tmp_path) / "transforms.json").unlink()
    with pytest.raises(UserError, match="tells no poses") as caught:
        synthesize.main(
            job(tmp_path), synthesize.Params(**RECIPE | {"source": str(tmp_path / "dry/images")})
        )
    assert "paint_pane: lens" in caught.value.hint
    assert not (tmp_path / "data").exists()
