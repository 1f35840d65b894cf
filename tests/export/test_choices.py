"""What an export holds, leaves out and says: wet or clean, split, origin, lenses, what was never rendered."""

from __future__ import annotations

import json
import logging
import shutil
import zlib  # noqa: F401
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pipeline.errors import UserError
from pipeline.io.capture import find_capture
from pipeline.io.images import read_image
from pipeline.io.maps import read_depth, write_map
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.ply import read_ply
from pipeline.io.straighten import common_pinholes, kept_share, own_pinholes
from pipeline.io.transforms import GL_FROM_CV, View
from pipeline.sfm import read_colmap, write_straight
from stages import export
from tests.export import made

HEIGHT, WIDTH, NAMES, POINTS, VIEWS = made.HEIGHT, made.WIDTH, made.NAMES, made.POINTS, made.VIEWS
UTM = (412345.0, 5_654_321.0, 312.0)
ALL = {"nerfstudio", "colmap", "llff", "ply", "depth", "photos"}


def _json(path: Path) -> dict:
    return json.loads(path.read_text())


def _folders(out: Path) -> set[str]:
    return {path.name for path in out.iterdir()}


# Wet or clean


@pytest.mark.parametrize(("door", "folder"), [("nerfstudio", ""), ("colmap", ""), ("llff", "_2")])
def test_clean_exports_hold_the_cleaned_photos_and_masks_only_what_is_made_up(
    tmp_path: Path, door: str, folder: str
) -> None:
    """b is dropped in columns 0 to 19; of these no photo saw 0 to 9, which therefore stay masked."""
    job = made.scene(tmp_path, [replace(one, k1=0.0) for one in VIEWS])
    wet = made.exported(job, formats=[door])
    middle = (HEIGHT // 4, WIDTH // 4)
    assert read_image(wet / door / f"images{folder}/b.png")[middle] == pytest.approx(0.5, abs=0.01)
    seen = np.ones((HEIGHT, WIDTH), np.float32)
    seen[:, :10] = 0
    (job.paths.views / "seen").mkdir()
    write_map(job.paths.views / "seen/b.exr", seen)
    clean = made.exported(job, formats=[door], images="clean")
    image = read_image(clean / door / f"images{folder}/b.png")
    assert image[middle] == pytest.approx(made.CLEAN, abs=0.01)
    if door == "llff":
        keep_mask = np.load(clean / "llff/rainMask.npy")[..., 1] == 0
    else:
        name = "b.png" if door == "nerfstudio" else "b.png.png"
        keep_mask = read_keep_mask(clean / door / "masks" / name)
    lost = 10 * keep_mask.shape[1] // WIDTH
    assert not keep_mask[:, :lost].any() and keep_mask[:, lost:].all()


def test_clean_photos_that_are_not_there_are_not_made_up(tmp_path: Path) -> None:
    job = made.scene(tmp_path, rendered=["a.png"])
    with pytest.raises(UserError, match=r"2 of 3 photos have no clean form.*stages\.render"):
        made.exported(job, images="clean")
    shutil.rmtree(job.paths.views)
    with pytest.raises(UserError, match=r"there are no clean photos.*stages\.render"):
        made.exported(job, images="clean", formats=["colmap"])
    assert not (job.paths.out / "export").exists()


# What was never rendered, or rendered of something else


def test_before_render_the_rest_is_written_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    job = made.scene(tmp_path, rendered=[])
    closing = export.main(job, made.PARAMS)
    assert _folders(job.paths.out / "export") == {"nerfstudio", "colmap", "llff", "ply"}
    assert "3 photos as nerfstudio, colmap, llff, ply (sparse points alone) in" in closing
    told = [record.getMessage().split(":")[0] for record in caplog.records]
    assert sorted(told) == [
        "depth/ is left out", "photos/ is left out", "ply/ holds no dense points"
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["depth", "photos"])
def test_what_is_asked_for_by_name_is_written_or_refused(tmp_path: Path, name: str) -> None:
    job = made.scene(tmp_path, rendered=[])
    with pytest.raises(UserError, match=r"there are no .*stages\.render"):
        made.exported(job, formats=["nerfstudio", name])
    assert not (job.paths.out / "export").exists(), "nothing is begun"


def test_what_was_rendered_of_some_photos_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """render.views: test."""
    job = made.scene(tmp_path, rendered=["a.png"], held_out=["a.png"])
    closing = export.main(job, made.PARAMS)
    assert "ply (sparse points alone), depth (1 of 3), photos (1 of 3)" in closing
    assert len([r for r in caplog.records if "render.views: all" in r.getMessage()]) == 2
    assert set(_json(job.paths.out / "export/depth/scene.json")["pinholes"]) == {"a.png"}


def _new_poses(job: export.Job) -> None:
    path = job.paths.poses / "transforms.json"
    path.write_text(path.read_text().replace('"near": 1.5', '"near": 1.25'))


def _new_masks(job: export.Job) -> None:
    write_keep_mask(job.paths.refine / "a.png", np.ones((HEIGHT, WIDTH), bool))
    for name in NAMES[1:]:
        write_keep_mask(job.paths.refine / name, np.ones((HEIGHT, WIDTH), bool))


@pytest.mark.parametrize(("change", "what"), [(_new_poses, "poses"), (_new_masks, "masks")])
def test_views_of_other_poses_or_masks_do_not_go_out(
    tmp_path: Path, change: Callable[[export.Job], None], what: str
) -> None:
    job = made.scene(tmp_path)
    made.exported(job)
    change(job)
    with pytest.raises(UserError, match=f"rendered from other {what} than"):
        made.exported(job, formats=["photos"])
    with pytest.raises(UserError, match=f"rendered from other {what} than"):
        made.exported(job, images="clean")
    assert _folders(made.exported(job)) == ALL - {"depth", "photos"}, "nor do those of before stay"


def test_views_that_do_not_tell_what_they_show_go_out_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    job = made.scene(tmp_path)
    (job.paths.views / "inputs.json").unlink()
    assert _folders(made.exported(job)) == ALL
    assert [r.levelno for r in caplog.records] == [logging.WARNING]
    assert "inputs.json is missing" in caplog.records[0].getMessage()


def test_a_list_of_formats_leaves_the_others_folders(tmp_path: Path) -> None:
    job = made.scene(tmp_path)
    made.exported(job)
    (job.paths.out / "export/ply/sparse.ply").unlink()
    out = made.exported(job, formats=["ply", "ply"])
    assert _folders(out) == ALL and (out / "ply/sparse.ply").is_file()


# Split, lost poses, origin


def test_the_split_goes_along(tmp_path: Path) -> None:
    out = made.exported(made.scene(tmp_path, held_out=["b.png"]))
    body = _json(out / "nerfstudio/transforms.json")
    assert body["train_filenames"] == ["images/a.png", "images/c.png"]
    assert body["val_filenames"] == body["test_filenames"] == ["images/b.png"]
    assert set(body["train_filenames"] + body["test_filenames"]) == {
        frame["file_path"] for frame in body["frames"]
    }, "nerfstudio stops at a name that no frame has"
    for door in ("colmap", "llff", "depth"):
        about = _json(out / door / "scene.json")
        assert (about["train"], about["test"]) == (["a.png", "c.png"], ["b.png"])


def test_without_held_out_photos_nerfstudio_splits_itself(tmp_path: Path) -> None:
    """Empty lists would stop it."""
    body = _json(made.exported(made.scene(tmp_path)) / "nerfstudio/transforms.json")
    assert not [key for key in body if key.endswith("_filenames")]


def test_a_photo_without_a_pose_is_left_out_everywhere(tmp_path: Path) -> None:
    job = made.scene(tmp_path, lost=["aa.png"], held_out=["aa.png", "c.png"])
    closing = export.main(job, made.PARAMS)
    out = job.paths.out / "export"
    assert "3 photos (1 without a pose left out) as" in closing
    for folder in ("nerfstudio/images", "colmap/images", "llff/images", "llff/images_2"):
        assert sorted(path.name for path in (out / folder).iterdir()) == list(NAMES)
    assert len(np.load(out / "llff/poses_bounds.npy")) == 3
    assert np.load(out / "llff/rainMask.npy").shape[2] == 3
    assert _json(out / "colmap/scene.json")["test"] == ["c.png"]
    assert _json(out / "nerfstudio/transforms.json")["test_filenames"] == ["images/c.png"]


def test_readers_in_32_bits_get_a_world_near_its_origin(tmp_path: Path) -> None:
    """nerfstudio and LLFF cast to float32, which knows 5,654,321 to half a metre; COLMAP and PLY do not."""
    near, far = made.exported(made.scene(tmp_path / "near")), made.exported(
        made.scene(tmp_path / "far", origin=UTM)
    )  # fmt: skip
    rows = np.load(far / "llff/poses_bounds.npy").astype(np.float32)[:, :15].reshape(-1, 3, 5)
    assert np.allclose(rows[:, :, 3], [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], atol=1e-6)
    assert _json(far / "llff/scene.json")["world_origin"] == list(UTM)
    body = _json(far / "nerfstudio/transforms.json")
    poses = np.array([frame["transform_matrix"] for frame in body["frames"]], np.float32)
    assert np.allclose(poses[:, :3, 3], rows[:, :, 3], atol=1e-6)
    assert body["world_origin"] == list(UTM)
    assert np.allclose(read_ply(far / "nerfstudio/sparse_pc.ply")[0], POINTS, atol=1e-6)
    for name in ("sparse", "dense"):
        here, there = (read_ply(out / f"ply/{name}.ply")[0] for out in (near, far))
        assert np.allclose(there - np.array(UTM), here, rtol=0, atol=1e-4)
    model = pycolmap.Reconstruction(str(far / "colmap/sparse/0"))
    places = {image.name: image.projection_center() for image in model.images.values()}
    assert np.allclose(places["c.png"] - np.array(UTM), [0.2, 0, 0], atol=1e-6)
    assert "world_origin" not in _json(far / "colmap/scene.json")


def test_what_nerfstudio_is_given_comes_back_in_the_coordinates_of_the_capture(
    tmp_path: Path,
) -> None:
    out = made.exported(made.scene(tmp_path, origin=UTM), formats=["nerfstudio"])
    back = find_capture(out / "nerfstudio", 3, read_colmap).views["c.png"]
    place = np.linalg.inv(back.cam_from_world)[:3, 3]
    assert np.allclose(place - np.array(UTM), [0.2, 0, 0], rtol=0, atol=1e-6)


# Lenses


def _bent_back(view: View, pinhole: View, pixels: np.ndarray) -> np.ndarray:
    """Where the lens of `view` shows what its pinhole shows at `pixels` (N, 2), written out."""
    x, y = (pixels[:, 0] - pinhole.cx) / pinhole.fx, (pixels[:, 1] - pinhole.cy) / pinhole.fy
    gain = 1 + view.k1 * (x * x + y * y)
    return np.stack([view.fx * x * gain + view.cx, view.fy * y * gain + view.cy], axis=1)


@pytest.mark.parametrize("k1", [0.2, -0.1, -0.5])
@pytest.mark.parametrize("cx", [WIDTH / 2, 0.3 * WIDTH, 0.95 * WIDTH])
def test_pinholes_show_no_made_up_borders_wherever_the_axis_is(k1: float, cx: float) -> None:
    one = replace(made.lens_at("a.png", 0, k1), cx=cx)
    corners = np.array([[0, 0], [WIDTH, 0], [0, HEIGHT], [WIDTH, HEIGHT]], float)
    for pinhole in (own_pinholes([one])["a.png"], common_pinholes([one])["a.png"]):
        pixels = _bent_back(one, pinhole, corners)
        assert (pixels > -1e-6).all() and (pixels < [WIDTH + 1e-6, HEIGHT + 1e-6]).all()
        narrower = replace(pinhole, fx=0.99 * pinhole.fx, fy=0.99 * pinhole.fy)
        edge = np.concatenate([corners, [[0, pinhole.cy], [WIDTH, pinhole.cy]]])
        edge = np.concatenate([edge, [[pinhole.cx, 0], [pinhole.cx, HEIGHT]]])
        beyond = _bent_back(one, narrower, edge)
        r2 = ((edge - [pinhole.cx, pinhole.cy]) ** 2 / [narrower.fx**2, narrower.fy**2]).sum(axis=1)
        out = (beyond < 0).any() or (beyond > [WIDTH, HEIGHT]).any() or (1 + 3 * k1 * r2 < 0).any()
        assert out, "a wider one would show borders"


def test_the_share_that_a_pinhole_keeps() -> None:
    """Focal lengths of 30 and 90: the common pinhole has 90, a ninth of the wide photo's area."""
    wide, narrow = made.lens_at("a.png", 0, 0.0, 30.0), made.lens_at("b.png", 0, 0.0, 90.0)
    common = common_pinholes([wide, narrow])
    assert common["a.png"].fx == pytest.approx(90.0)
    assert kept_share(wide, common["a.png"]) == pytest.approx(1 / 9)
    assert kept_share(narrow, common["b.png"]) == pytest.approx(1.0)
    assert own_pinholes([wide, narrow]) == {"a.png": wide, "b.png": narrow}


def test_cameras_of_several_focal_lengths_keep_their_own(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    views = [
        made.lens_at(n, 0.1 * i, 0.0, f)
        for i, (n, f) in enumerate(zip(NAMES, (30, 90, 30), strict=True))
    ]
    out = made.exported(made.scene(tmp_path, views))
    model = pycolmap.Reconstruction(str(out / "colmap/sparse/0"))
    assert len(model.cameras) == 2 and model.compute_mean_reprojection_error() < 1e-6
    focals = {image.name: image.camera.params[0] for image in model.images.values()}
    assert focals == {"a.png": 30, "b.png": 90, "c.png": 30}
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1, "of LLFF, whose one pinhole must serve all"
    assert "llff/ shows only 11 % of a.png, and less than 60 % of 2 photos" in told[0]
    assert _json(out / "depth/scene.json")["pinholes"]["b.png"] == [90, 90, 40, 30]
    assert np.allclose(read_depth(out / "depth/b.exr"), 2.0)
    dense, _ = read_ply(out / "ply/dense.ply")
    assert np.allclose(dense[:, 2], 2.0, atol=1e-5)


def test_an_axis_outside_of_the_picture_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As in a crop of a larger picture: a pinhole says it, LLFF cannot."""
    views = [replace(one, k1=0.0, cx=1.2 * WIDTH) for one in VIEWS]
    job = made.scene(tmp_path, views)
    with pytest.raises(UserError, match=r"meets its picture of 80x60 at \(96, 30\)"):
        made.exported(job, formats=["llff"])
    assert _folders(made.exported(job)) == ALL - {"llff"}
    assert [r for r in caplog.records if "llff/ is left out" in r.getMessage()]
    bent = [replace(one, cx=1.2 * WIDTH) for one in VIEWS]
    with pytest.raises(UserError, match=r"the lens of a\.png cannot be straightened"):
        own_pinholes(bent)


def test_observations_beyond_a_fold_are_left_out(tmp_path: Path) -> None:
    """k1 = -0.5 folds back at r = 0.544 on the picture: keypoints 38.1 px from its middle have no ray.

    Two such stand before the points' in the first photo: the points' must still be found by their tracks.
    """
    views = [made.lens_at(one.name, 0.1 * i, -0.5) for i, one in enumerate(VIEWS)]
    strays = np.array([[1.0, 1.0], [79.0, 30.0]])
    straight = own_pinholes(views)
    write_straight(made.model(views, strays), straight, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_points3D() == 3 and model.compute_mean_reprojection_error() < 1e-6
    for image in model.images.values():
        pixels = np.array([point.xy for point in image.points2D])
        assert pixels.shape == (3, 2) and np.isfinite(pixels).all()
        pinhole = straight[image.name]
        cam = POINTS + pinhole.cam_from_world[:3, 3]
        expected = cam[:, :2] / cam[:, 2:] * pinhole.fx + [pinhole.cx, pinhole.cy]
        assert np.allclose(pixels, expected, atol=1e-6)


def test_a_point_that_only_one_ray_is_left_of_goes(tmp_path: Path) -> None:
    """Of two photos' three points one is seen by the first beyond its fold."""
    views = [made.lens_at(one.name, 0.1 * i, -0.5) for i, one in enumerate(VIEWS[:2])]
    model = made.model(views)
    model.images[5].points2D[0].xy = np.array([1.0, 1.0])
    write_straight(model, own_pinholes(views), tmp_path)
    assert pycolmap.Reconstruction(str(tmp_path)).num_points3D() == 2


def test_a_photo_that_the_model_has_no_features_of_keeps_its_pose(tmp_path: Path) -> None:
    write_straight(made.model(VIEWS[:2]), own_pinholes(VIEWS), tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert {image.name for image in model.images.values() if image.has_pose} == set(NAMES)


def test_nerfstudios_masks_leave_out_what_no_ray_leads_to(tmp_path: Path) -> None:
    views = [made.lens_at(one.name, 0.1 * i, -0.5) for i, one in enumerate(VIEWS)]
    out = made.exported(made.scene(tmp_path, views), formats=["nerfstudio"])
    keep_mask = read_keep_mask(out / "nerfstudio/masks/a.png")
    assert not keep_mask[0, 0] and not keep_mask[-1, -1] and keep_mask[30, 5]
    body = _json(out / "nerfstudio/transforms.json")
    first = np.array(body["frames"][0]["transform_matrix"]) @ GL_FROM_CV
    assert np.allclose(first, np.eye(4))


def test_the_full_size_of_llff_is_one_file_with_two_names(tmp_path: Path) -> None:
    out = made.exported(made.scene(tmp_path), formats=["llff"], llff_factor=1)
    assert (out / "llff/images/a.png").samefile(out / "llff/images_1/a.png")
