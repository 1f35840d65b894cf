from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pipeline.drops import bake as baking
from pipeline.drops import mitsuba_scene as ms
from pipeline.drops import pane, places, storing, synthesis
from pipeline.drops.places_parts import Builder
from pipeline.drops.shape import Drop
from pipeline.errors import UserError
from pipeline.io.photos import list_photos
from pipeline.stage import Job
from stages import synthesize

try:
    baking.mitsuba()
    MISSING = ""
except UserError as error:
    MISSING = str(error)
ray_traced = pytest.mark.skipif(bool(MISSING), reason=f"needs Mitsuba: {MISSING}")
CAMERA = ms.Camera(32, 24, 27.0, 0.001, 8.0)


def wall() -> places.Place:
    """A checked wall 5 m ahead under an even sky of radiance 1/2, no sun."""
    board = (np.indices((8, 8)).sum(0) % 2 * 0.6 + 0.2).astype(np.float32)
    b = Builder({"wall": np.repeat(board[..., None], 3, 2)}, step=2.0)
    b.panel("wall", [-20, -20, 5], [40, 0, 0], [0, 40, 0], tile=4)
    sky = np.full((16, 32, 3), 0.5, np.float32)
    down = np.array([0, 1, 0], np.float32)
    return places.Place("wall", 1, b.meshes(), sky, down, np.zeros(3, np.float32), [])


@pytest.mark.parametrize(("count", "last"), [(1, "view_00"), (100, "view_99"), (101, "view_100")])
def test_views_are_in_the_order_of_their_names(count: int, last: str) -> None:
    names = storing.stems(count)
    assert sorted(names) == list(names) and list(names.values()) == list(range(count))
    assert max(names) == last


@pytest.fixture(scope="module")
def baked() -> ms.Baked:
    return ms.bake_place(wall(), rays=16, bounces=1)


def drop(x: float = 0.0) -> Drop:
    return Drop(center=(x, 0.0), radius=0.02, contact_angle=1.0)


@ray_traced
def test_even_sky_lights_a_free_wall_by_its_radiance(baked: ms.Baked) -> None:
    np.testing.assert_allclose(baked.lights[0], 0.5, rtol=0.02)
    picture = ms.render(baked, CAMERA, np.eye(4), spp=16, seed=1)
    assert picture.radiance.min() > 0.09 and picture.radiance.max() < 0.41
    assert picture.radiance.mean() == pytest.approx(0.25, rel=0.06)
    assert picture.alpha.max() == 0


@ray_traced
def test_depth_of_a_plane_is_along_the_axis_and_follows_the_camera(baked: ms.Baked) -> None:
    pose = np.eye(4)
    pose[2, 3] = -1.5  # the camera 1.5 m ahead of the origin
    np.testing.assert_allclose(
        ms.render(baked, CAMERA, np.eye(4), spp=4, seed=1).depth, 5.0, rtol=5e-3
    )
    np.testing.assert_allclose(ms.render(baked, CAMERA, pose, spp=4, seed=1).depth, 3.5, rtol=5e-3)


@ray_traced
def test_camera_axes_are_right_down_forward() -> None:
    place = wall()
    b = Builder({"mark": np.full((2, 2, 3), 0.9, np.float32)})
    b.panel("mark", [0.5, 0.5, 4.9], [1.5, 0, 0], [0, 1.5, 0], glow=9.0)
    marked = replace(place, meshes=place.meshes + b.meshes())
    light = ms.render(
        ms.bake_place(marked, rays=4, bounces=0), CAMERA, np.eye(4), spp=4, seed=1
    ).radiance[..., 0]
    v, u = np.nonzero(light > 4)
    # Pixel of (x, y, z): 16 + 27 x / z, 12 + 27 y / z.
    assert u.min() >= 18 and v.min() >= 14 and u.max() <= 27 and v.max() <= 23 and len(u) > 40


@ray_traced
def test_sky_is_up_and_where_it_should_be() -> None:
    place = wall()
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16, :, 2] = 1.0
    sky[:16, 48:, 0] = 1.0  # red from the right to behind
    open_air = replace(place, sky=sky)
    pose = np.diag([-1.0, 1.0, -1.0, 1.0])  # looking back, away from the wall
    back = ms.render(
        ms.bake_place(open_air, rays=4, bounces=0), CAMERA, pose, spp=4, seed=1
    ).radiance
    assert back[:10, :, 2].min() > 0.9 and back[14:, :, 2].max() < 0.1
    turned = np.linalg.inv(np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]))
    right = ms.render(
        ms.bake_place(open_air, rays=4, bounces=0), CAMERA, turned, spp=4, seed=1
    ).radiance
    # Looking along +x, what lies behind (-z) is to the right.
    assert right[:8, -6:-2, 0].mean() > 0.9 and right[:8, 2:6, 0].mean() < 0.1


@ray_traced
def test_pixels_without_water_equal_the_clean_picture(baked: ms.Baked) -> None:
    clean = ms.render(baked, CAMERA, np.eye(4), spp=256, seed=3)
    rainy = ms.render(baked, CAMERA, np.eye(4), spp=256, seed=4, drops=[drop()])
    dry, wet = rainy.alpha == 0, rainy.alpha > 0.99
    assert dry.sum() > 400 and wet.sum() > 20
    difference = np.abs(rainy.radiance - clean.radiance).mean(-1)
    assert difference[dry].mean() < 0.012
    assert difference[wet].mean() > 4 * difference[dry].mean()


@ray_traced
def test_drop_covers_the_pixels_that_its_outline_says(baked: ms.Baked) -> None:
    alpha = ms.render(
        baked, CAMERA, np.eye(4), spp=64, seed=3, drops=[drop(0.015)], pane_m=0.12
    ).alpha
    radius = 0.02 / 0.12 * 27
    assert alpha.sum() == pytest.approx(np.pi * radius**2, rel=0.03)
    u = (alpha.sum(0) * (np.arange(32) + 0.5)).sum() / alpha.sum()
    assert u == pytest.approx(16 + 0.015 / 0.12 * 27, abs=0.1)


@ray_traced
def test_pane_in_the_scene_stays_and_pane_on_the_lens_follows(baked: ms.Baked) -> None:
    pose = np.eye(4)
    pose[0, 3] = -0.05
    fixed = np.eye(4)
    fixed[2, 3] = 0.3
    big = Drop(center=(0.0, 0.0), radius=0.03, contact_angle=1.0)

    def middle(**where: object) -> float:
        alpha = ms.render(baked, CAMERA, pose, spp=16, seed=1, drops=[big], **where).alpha
        return float((alpha.sum(0) * (np.arange(32) + 0.5)).sum() / alpha.sum())

    assert middle(world_from_pane=fixed) == pytest.approx(16 - 0.05 / 0.3 * 27, abs=0.2)
    assert middle(pane_m=0.3) == pytest.approx(16, abs=0.2)


@ray_traced
def test_painted_pane_covers_what_the_rendered_one_covers(baked: ms.Baked) -> None:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.15, 0.3, 0.1]))[0]
    pose[:3, 3] = [0.1, -0.02, 0.03]
    fixed = np.eye(4)
    fixed[2, 3] = 0.3
    drops = [
        replace(drop(x), center=(x, y)) for x, y in ((-0.12, 0.0), (0.0, 0.05), (-0.04, -0.06))
    ]
    rendered = ms.render(
        baked, CAMERA, pose, spp=256, seed=5, drops=drops, world_from_pane=fixed
    ).alpha
    grey = np.full((24, 32, 3), 0.5, np.float32)
    how = {"aperture_radius": CAMERA.aperture_m, "focus_distance": CAMERA.focus_m}
    k = synthesis.camera_matrix(CAMERA)
    _, alpha = pane.paint_pane(grey, drops, pose @ fixed, k, supersample=8, **how)
    assert rendered.sum() > 20 and alpha.sum() == pytest.approx(rendered.sum(), rel=0.03)
    assert np.minimum(alpha, rendered).sum() > 0.95 * np.maximum(alpha, rendered).sum()


@ray_traced
def test_same_seed_same_numbers(baked: ms.Baked) -> None:
    again = ms.bake_place(wall(), rays=16, bounces=1)
    np.testing.assert_array_equal(baked.lights[0], again.lights[0])
    one, two, other = (
        ms.render(b, CAMERA, np.eye(4), spp=4, seed=s, drops=[drop()])
        for b, s in ((baked, 7), (again, 7), (again, 8))
    )
    np.testing.assert_array_equal(one.radiance, two.radiance)
    assert not np.array_equal(one.radiance, other.radiance)


def test_missing_mitsuba_is_told_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(UserError) as caught:
        baking.mitsuba()
    assert "pip install '.[synth]'" in caught.value.hint and "libllvm" in caught.value.hint


def test_trajectory_is_a_grid_that_looks_ahead() -> None:
    poses = ms.trajectory(np.random.default_rng(1), 24)
    centres = np.array([np.linalg.inv(p)[:3, 3] for p in poses])
    assert len(poses) == 24 and np.abs(centres[:, 2]).max() < 0.15
    assert np.ptp(centres[:, 0]) == pytest.approx(1.1, abs=0.15)
    assert np.ptp(centres[:, 1]) == pytest.approx(0.64, abs=0.15)
    for pose in poses:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert pose[2, 2] > np.cos(np.radians(10))


RECIPE = {
    "mode": "paint", "place": "street", "source": "clean", "seed": 1, "views": 2, "width": 32,
    "height": 24, "field_of_view_deg": 62, "spp": 4, "clean_spp": 4, "coverage": 0.15,
    "drift_mm": 0.0, "stains": {}, "paint_pane": "lens", "unit_m": 1.0,
    "radius_mm": [3.0, 9.0], "pane_m": 0.12, "aperture_mm": 1.0, "maps": False,
}  # fmt: skip


def job(root: Path) -> Job:
    return Job(root, "wet", None, "cpu", None, False)


def photos(root: Path) -> None:
    (root / "clean").mkdir()
    for k in range(2):
        pixels = np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)
        cv2.imwrite(str(root / f"clean/{k}.png"), pixels)


def test_paint_wets_all_photos_with_the_same_drops(tmp_path: Path) -> None:
    photos(tmp_path)
    synthesize.main(job(tmp_path), synthesize.Params(**RECIPE))
    data = tmp_path / "data/wet"
    zero, one = (cv2.imread(str(data / f"truth/coverage/{k}.png"), -1) for k in "01")
    np.testing.assert_array_equal(zero, one)
    assert 0.05 < (zero > 12).mean() < 0.5
    rainy, clean = (
        cv2.imread(str(p)).astype(int) for p in (data / "0.jpg", data / "truth/clean/0.jpg")
    )
    difference = np.abs(rainy - clean).mean(-1)
    assert difference[zero > 200].mean() > 3 * difference[zero == 0].mean()
    first = (data / "0.jpg").read_bytes()
    synthesize.main(job(tmp_path), synthesize.Params(**RECIPE))  # its own folder: made again
    assert (data / "0.jpg").read_bytes() == first


@pytest.mark.parametrize("change", [{}, {"seed": 1 + RECIPE["seed"]}])
def test_what_an_interrupted_run_painted_of_a_photo_now_gone_does_not_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, int]
) -> None:
    photos(tmp_path)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(synthesize, "publish_dir", interrupted)
        synthesize.main(job(tmp_path), synthesize.Params(**RECIPE | change))
    work = job(tmp_path).paths.work("synthesize")
    assert any(work.glob("*/"))
    (tmp_path / "clean/1.png").unlink()
    synthesize.main(job(tmp_path), synthesize.Params(**RECIPE))
    made = {path.stem for path in (tmp_path / "data/wet").rglob("*.*") if path.stem in "01"}
    assert made == {"0"}
    assert not any(work.glob("*/"))


def test_folders_of_others_are_refused_and_left_alone(tmp_path: Path) -> None:
    photos(tmp_path)
    (tmp_path / "data/wet").mkdir(parents=True)
    (tmp_path / "data/wet/mine.jpg").write_bytes(b"precious")
    with pytest.raises(UserError, match="did not make"):
        synthesize.main(job(tmp_path), synthesize.Params(**RECIPE))
    assert [p.name for p in (tmp_path / "data/wet").iterdir()] == ["mine.jpg"]


@ray_traced
def test_stage_renders_resumes_and_repeats_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places, "build", lambda name, seed: wall())
    params = synthesize.Params(**RECIPE | {"mode": "lens", "maps": True})
    real, calls = synthesis.wet_view, []

    def stopped(*args: object, **more: object) -> synthesis.WetView:
        calls.append(more["seed"])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(synthesis, "wet_view", stopped)
    with pytest.raises(KeyboardInterrupt):
        synthesize.main(job(tmp_path), params)
    data = tmp_path / "data/wet"
    assert not data.exists()
    synthesize.main(job(tmp_path), params)
    assert len(calls) == 3 and calls[1] == calls[2]
    resumed = {p.relative_to(data): p.read_bytes() for p in data.rglob("*") if p.is_file()}
    monkeypatch.setattr(synthesis, "wet_view", real)
    synthesize.main(job(tmp_path), params)
    assert resumed == {p.relative_to(data): p.read_bytes() for p in data.rglob("*") if p.is_file()}
    assert len(list_photos(data, 1)) == 2 and len(list(data.glob("truth/depth/*.exr"))) == 2


def test_views_of_other_code_or_another_recipe_are_not_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "shape.py").write_text("FACTOR = 1\n")
    first = storing.work_key(RECIPE, tmp_path)
    assert storing.work_key(dict(reversed(RECIPE.items())), tmp_path) == first
    assert storing.work_key(RECIPE | {"seed": 1 + RECIPE["seed"]}, tmp_path) != first
    (tmp_path / "shape.py").write_text("FACTOR = 2\n")
    assert storing.work_key(RECIPE, tmp_path) != first
    (tmp_path / "shape.py").write_text("FACTOR = 1\n")
    assert storing.work_key(RECIPE, tmp_path) == first


def test_the_demo_is_whole() -> None:
    data = Path(__file__).resolve().parents[2] / "data/demo"
    stems = sorted(p.stem for p in data.glob("*.jpg"))
    cameras = yaml.safe_load((data / "truth/cameras.json").read_text())
    assert len(stems) == 24 and sorted(cameras["frames"]) == stems
    shares = []
    for stem in stems:
        coverage = cv2.imread(str(data / f"truth/coverage/{stem}.png"), cv2.IMREAD_UNCHANGED)
        clean = cv2.imread(str(data / f"truth/clean/{stem}.jpg"))
        assert coverage.shape == clean.shape[:2] == (cameras["height"], cameras["width"])
        shares.append((coverage > 0.05 * 255).mean())
    assert 0.10 < np.mean(shares) < 0.20
