"""Poses that come along: read from a COLMAP model, kept to the last bit, points found for them."""

from __future__ import annotations

import dataclasses
import json
import shutil
import zlib  # noqa: F401
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from ruamel.yaml import YAML

from pipeline.errors import UserError
from pipeline.geometry.trajectory import look_at
from pipeline.io.capture import adopt, find_capture
from pipeline.io.images import write_image
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.ply import read_ply
from pipeline.io.transforms import View, read_transforms, write_transforms
from pipeline.sfm import Settings, read_colmap, triangulate
from pipeline.sfm.given import _check_origin, nearest_pairs
from pipeline.stage import Job
from stages import export, ingest, masks, poses

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
SETTINGS = Settings(
    camera="single",
    matcher="exhaustive",
    mapper="incremental",
    max_features=800,
    max_image_size=0,
    masked=False,
    still=False,
    refine_focal=True,
    refine_distortion=True,
)


def true_views(scene) -> dict[str, View]:
    return {
        name: View(
            name, cam, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.0, WIDTH, HEIGHT, 0.0, 0.0
        )
        for name, cam in scene.cams.items()
    }  # fmt: skip


def pass_on(scene, views, work, names=None, **more):
    names = names or scene.names
    return triangulate(scene.images, None, names, views, work_dir=work, settings=SETTINGS, **more)


@pytest.mark.parametrize(
    ("width", "focal", "place", "told"),
    [
        (120, 100.0, 0.25, ""),
        (0, 100.0, 0.25, "not positive"),
        (120, 0.0, 0.25, "not positive"),
        (120, np.nan, 0.25, "not finite"),
        (120, 100.0, np.nan, "not a rotation"),
    ],
)
def test_colmap_cameras_that_are_none(tmp_path: Path, width, focal, place, told) -> None:
    model = pycolmap.Reconstruction()
    lens = [focal, 110, 60, 45]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=90, params=lens, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([place, 0.5, 0.0]))
    image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pose)
    model.write_binary(str(tmp_path))
    if told:
        with pytest.raises(UserError, match=rf"a\.jpg .*{told}"):
            read_colmap(tmp_path, [Path("a.jpg")])
    else:
        assert read_colmap(tmp_path, [Path("a.jpg")])[0].fx == 100.0


@pytest.mark.parametrize("far_off", [1e3, 5e6])
def test_poses_too_far_from_their_origin_for_a_fit_are_refused(far_off: float) -> None:
    """What `ingest` did not move: 32 bits know 5,000,000 to half a metre, some 20 px at 20 m."""
    pose = np.eye(4)
    pose[:3, 3] = 0.0, -far_off, 0.0
    assert (far_off == 5e6) == (np.spacing(np.float32(far_off)) * 700 / 20 > 1)
    views = {"a.png": View("a.png", pose, 700, 700, 400, 300, 0.0, 800, 600, 20.0, 90.0)}
    if far_off == 5e6:
        with pytest.raises(UserError, match=r"so far from the origin .* 21 px off"):
            _check_origin(views)
    else:
        _check_origin(views)


def test_given_poses_stay_and_points_tell_the_depths(scene, tmp_path):
    views = true_views(scene)
    found = pass_on(scene, views, tmp_path)
    assert list(found.views) == scene.names
    for name, view in found.views.items():
        assert np.array_equal(view.cam_from_world, views[name].cam_from_world)
        assert view.intrinsics == views[name].intrinsics
    # What is written as `sparse/`, where points are found for it: the same cameras.
    for image in found.model.images.values():
        pose = views[image.name].cam_from_world
        assert np.allclose(image.cam_from_world().matrix(), pose[:3], rtol=0, atol=1e-12)
        assert list(image.camera.params) == [*views[image.name].intrinsics, 0, 0, 0]
    assert sorted(image.name for image in found.model.images.values()) == scene.names
    for view in found.views.values():
        assert 2.9 * 0.6 < view.near < 2.9 and 5.0 < view.far < 5.0 * 1.6
    assert found.reprojection_px < 0.5 and len(found.points_xyz) > 100
    # The planes stand at 5, 3.6 and 2.9 metres along the world's z.
    off = np.abs(found.points_xyz[:, 2:] - [[5.0, 3.6, 2.9]]).min(axis=1)
    assert np.median(off) < 0.03


def test_of_many_views_each_is_matched_with_its_nearest(scene):
    """61 cameras on a circle around a thing: ten to either side, so 610 pairs instead of 1830."""
    circle = {}
    for index in range(61):
        angle = 2 * np.pi * index / 61
        place = np.array([np.sin(angle), 0.0, -np.cos(angle)]) * 5
        pose = look_at(place, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        circle[f"{index:02d}"] = dataclasses.replace(
            true_views(scene)["v0.png"], name=f"{index:02d}", cam_from_world=pose
        )
    pairs = nearest_pairs(circle)
    apart = [(int(b) - int(a)) % 61 for a, b in pairs]
    assert len(pairs) == len(set(pairs)) == 610
    assert max(min(steps, 61 - steps) for steps in apart) == 10
    circle.popitem()
    assert nearest_pairs(circle) is None


def test_views_at_one_place_are_near_when_they_look_one_way(scene):
    """Two hundred cameras on a tripod: none is matched with one that looks another way."""
    turned = {}
    for index in range(200):
        angle = 2 * np.pi * index / 200
        ahead = np.array([np.sin(angle), 0.0, np.cos(angle)])
        pose = look_at(np.zeros(3), ahead, np.array([0.0, 1.0, 0.0]))
        turned[f"{index:03d}"] = dataclasses.replace(
            true_views(scene)["v0.png"], name=f"{index:03d}", cam_from_world=pose
        )
    steps = [(int(b) - int(a)) % 200 for a, b in nearest_pairs(turned)]
    assert max(min(step, 200 - step) for step in steps) == 10


def test_only_listed_pairs_are_matched(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.sfm.given.MANY_VIEWS", 4)
    monkeypatch.setattr("pipeline.sfm.given.NEIGHBOURS", 1)
    found = pass_on(scene, true_views(scene), tmp_path)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        listed = len((tmp_path / "pairs.txt").read_text().splitlines())
        assert 3 <= listed < 6 and database.num_verified_image_pairs() == listed
    assert sorted(found.views) == scene.names


def test_given_depths_stay_and_a_photo_without_a_pose_is_lost(scene, tmp_path, caplog):
    views = {
        name: dataclasses.replace(view, near=1.5, far=7.0)
        for name, view in true_views(scene).items()
        if name != "v2.png"
    }
    found = pass_on(scene, views, tmp_path)
    assert {(view.near, view.far) for view in found.views.values()} == {(1.5, 7.0)}
    assert [image.name for image in found.lost] == ["v2.png"]
    assert "no pose" in str(found.lost[0])
    assert "no pose for v2.png" in caplog.text


def test_too_few_given_poses_are_refused(scene, tmp_path):
    views = {name: view for name, view in true_views(scene).items() if name != "v2.png"}
    assert len(pass_on(scene, views, tmp_path, min_registered=0.8).views) == 4
    with pytest.raises(UserError, match=r"only 4 of 5 photos .*Lost: v2\.png"):
        pass_on(scene, views, tmp_path, min_registered=0.81)


def test_poses_of_other_photos_are_refused(scene, tmp_path):
    """Each camera stands opposite of where it stood: the matches meet behind them."""
    views = true_views(scene)
    for name, view in views.items():
        pose = view.cam_from_world.copy()
        pose[:3, 3] *= -1
        views[name] = dataclasses.replace(view, cam_from_world=pose)
    with pytest.raises(UserError, match="do not fit them"):
        pass_on(scene, views, tmp_path)


def _model(folder: Path, scene, model: str, params: list[float]) -> pycolmap.Reconstruction:
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    made.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(scene.names, start=1):
        cam = scene.cams[name]
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(cam[:3, :3])), cam[:3, 3])
        image = pycolmap.Image(name=f"sub/{name}", camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, rigid)
    folder.mkdir(parents=True, exist_ok=True)
    return made


@pytest.mark.parametrize("form", ["text", "binary", "old binary"])
def test_a_colmap_model_is_read_in_every_form(scene, tmp_path, form):
    model = _model(tmp_path / "sparse/0", scene, "SIMPLE_RADIAL", [FOCAL, 120.0, 90.0, 0.02])
    write = model.write_text if form == "text" else model.write_binary
    write(str(tmp_path / "sparse/0"))
    if form == "old binary":  # written before rigs and frames were thought of
        for name in ("rigs.bin", "frames.bin"):
            (tmp_path / "sparse/0" / name).unlink()
    shutil.copytree(scene.images, tmp_path / "images")
    capture = find_capture(tmp_path, 3, read_colmap)
    assert capture.posed_by == "COLMAP" and list(capture.views) == scene.names
    view = capture.views["v1.png"].view("v1.png", (WIDTH // 2, HEIGHT // 2))
    assert np.allclose(view.cam_from_world, scene.cams["v1.png"], atol=1e-12)
    assert view.intrinsics == (FOCAL / 2, FOCAL / 2, 60.0, 45.0, 0.02)


def test_of_models_that_did_not_come_together_the_fullest_is_taken(scene, tmp_path, caplog):
    """COLMAP numbers them as they came about: 0 is the first, not the largest; 10 comes after 2."""
    for number, kept in ((0, 2), (2, 5), (10, 4)):
        folder = tmp_path / f"a/sparse/{number}"
        model = _model(folder, scene, "SIMPLE_RADIAL", [FOCAL, 120.0, 90.0, 0.02])
        for image in range(kept + 1, 6):
            model.deregister_frame(model.image(image).frame_id)
        model.write_binary(str(folder))
    shutil.copytree(scene.images, tmp_path / "a/images")
    capture = find_capture(tmp_path / "a", 3, read_colmap)
    assert capture.model == tmp_path / "a/sparse/2" and list(capture.views) == scene.names
    assert "holds 3 models; 2 is taken, which places most photos: 5 of 5" in caplog.text
    adopt(tmp_path / "a", tmp_path / "b", 3, read_colmap)
    assert find_capture(tmp_path / "b", 3, read_colmap).model == tmp_path / "b/sparse/2"


def test_camera_models_keep_their_meaning(scene, tmp_path):
    params = [220.0, 221.0, 120.0, 90.0, 0.1, 0.01, 0.002, 0.003]
    _model(tmp_path, scene, "OPENCV", params).write_binary(str(tmp_path))
    photos = [scene.images / name for name in scene.names]
    view = read_colmap(tmp_path, photos)[0]
    assert (view.fx, view.fy, view.cx, view.cy) == (220.0, 221.0, 120.0, 90.0)
    assert view.distortion[:4] == (0.1, 0.01, 0.002, 0.003) and not view.carried
    _model(tmp_path, scene, "FOV", [220.0, 221.0, 120.0, 90.0, 0.9]).write_binary(str(tmp_path))
    with pytest.raises(UserError, match="the camera model FOV"):
        read_colmap(tmp_path, photos)


def test_two_images_of_one_name_are_not_guessed_between(scene, tmp_path):
    """Two cameras of a rig name their pictures alike; the photos lie in one folder."""
    model = _model(tmp_path, scene, "PINHOLE", [FOCAL, FOCAL, 120.0, 90.0])
    twin = pycolmap.Image(name="other/v1.png", camera_id=1, image_id=99)
    model.add_image_with_trivial_frame(twin, pycolmap.Rigid3d())
    model.write_binary(str(tmp_path))
    photos = [scene.images / name for name in scene.names]
    with pytest.raises(UserError, match=r"2 images called v1\.png"):
        read_colmap(tmp_path, photos)
    assert read_colmap(tmp_path, photos[:1]), "v1 is not asked for"


def test_given_poses_of_no_image_and_of_another_size_are_refused(scene, tmp_path):
    views = true_views(scene)
    with pytest.raises(UserError, match="none is for one of them"):
        pass_on(scene, {"other.png": views["v0.png"]}, tmp_path)
    views["v1.png"] = dataclasses.replace(views["v1.png"], width=2 * WIDTH)
    with pytest.raises(UserError, match=r"that of v1\.png is for another size"):
        pass_on(scene, views, tmp_path)


def test_a_model_of_other_photos_and_a_damaged_one_are_refused(scene, tmp_path):
    _model(tmp_path, scene, "PINHOLE", [FOCAL, FOCAL, 120.0, 90.0]).write_binary(str(tmp_path))
    write_image(tmp_path / "other.png", np.zeros((HEIGHT, WIDTH, 3)))
    with pytest.raises(UserError, match="places none of the photos"):
        read_colmap(tmp_path, [tmp_path / "other.png"])
    (tmp_path / "rigs.bin").write_bytes(b"\x01" + 19 * b"\x00")
    with pytest.raises(UserError, match="not a readable COLMAP model"):
        read_colmap(tmp_path, [scene.images / "v0.png"])


@pytest.fixture(scope="module")
def rigged(tmp_path_factory) -> tuple[Path, list[Path]]:
    """A binary model of two cameras on a rig at three places, and its photos."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=20
    )
    folder = tmp_path_factory.mktemp("rigged")
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    model.write_binary(str(folder))
    return folder, [Path(image.name) for image in model.images.values()]


@pytest.mark.parametrize("part", ["cameras", "rigs", "frames", "images", "points3D"])
def test_a_binary_model_that_is_cut_short_is_refused_wherever_it_is_cut(rigged, tmp_path, part):
    """pycolmap waits for ever for some of them, and reads others with numbers that are not there."""
    folder, photos = rigged
    assert len(read_colmap(folder, photos)) == 6
    shutil.copytree(folder, tmp_path / "m")
    whole = (folder / f"{part}.bin").read_bytes()
    for size in (0, 3, 8, 9, 15, 67, 80, len(whole) // 2, len(whole) - 1):
        (tmp_path / "m" / f"{part}.bin").write_bytes(whole[:size])
        with pytest.raises(UserError, match=rf"{part}\.bin is cut short"):
            read_colmap(tmp_path / "m", photos)


def test_counts_of_millions_of_millions_are_refused_at_once(rigged, tmp_path):
    folder, photos = rigged
    shutil.copytree(folder, tmp_path / "m")
    whole = (folder / "points3D.bin").read_bytes()
    track = 8 + 43  # where the first point's count of its track stands
    (tmp_path / "m/points3D.bin").write_bytes(whole[:track] + b"\xff" * 8 + whole[track + 8 :])
    with pytest.raises(UserError, match="cut short"):
        read_colmap(tmp_path / "m", photos)


def test_a_camera_without_a_place_on_its_rig_is_named(rigged, tmp_path):
    folder, photos = rigged
    model = pycolmap.Reconstruction(str(folder))
    model.write_text(str(tmp_path))
    lines = (tmp_path / "rigs.txt").read_text().splitlines()
    head, sensor = lines[-1].split(" CAMERA ")[:2], lines[-1].split(" CAMERA ")[2].split()[0]
    (tmp_path / "rigs.txt").write_text(
        "\n".join([*lines[:-1], " CAMERA ".join([*head, f"{sensor} 0"])])
    )
    with pytest.raises(UserError, match=r"where on its rig the camera of camera000002_"):
        read_colmap(tmp_path, photos)


def test_a_capture_with_poses_and_masks_goes_through_the_stages(scene, tmp_path):
    """ingest, masks and poses pass on what nerfstudio's file says, images scaled to half."""
    data = tmp_path / "data/made"
    shutil.copytree(scene.images, data / "images")
    keep_mask = np.ones((HEIGHT, WIDTH), np.bool_)
    keep_mask[:40, :60] = False
    for name in scene.names:
        write_keep_mask(data / "masks" / name, keep_mask)
    write_transforms(data / "transforms.json", true_views(scene).values(), beside="")
    job = Job(tmp_path, "made", None, "cpu", None, False)
    params = YAML(typ="safe").load((Path(__file__).parents[2] / "params.yaml").read_text())
    ingest.main(job, ingest.Params(**{**params["ingest"], "max_size": WIDTH // 2}))
    assert "came with the photos" in masks.main(job, masks.Params(**params["masks"]))
    poses.main(job, poses.Params(**params["poses"]))
    assert not read_keep_mask(job.paths.masks / "v0.png", (WIDTH // 2, HEIGHT // 2))[:20, :30].any()
    views = read_transforms(job.paths.poses / "transforms.json")
    for name, view in views.items():
        assert np.allclose(view.cam_from_world, scene.cams[name], atol=1e-9)
        assert (view.fx, view.cx, view.cy) == (FOCAL / 2, WIDTH / 4, HEIGHT / 4)
        assert 0 < view.near < view.far
    account = json.loads((job.paths.poses / "poses.json").read_text())
    assert account["tried"][0]["label"] == "poses as given" and account["lost"] == []
    assert account["aligned"] is False


@pytest.mark.parametrize(("align_rounds", "use_masks"), [(1, True), (0, True), (1, False)])
def test_photos_too_large_to_be_aligned_are_told_before_features(
    scene, tmp_path, monkeypatch, align_rounds, use_masks
):
    """And are let through where they are not aligned: a later stage tells."""
    shutil.copytree(scene.images, tmp_path / "data/made")
    job = Job(tmp_path, "made", None, "cpu", None, False)
    params = YAML(typ="safe").load((Path(__file__).parents[2] / "params.yaml").read_text())
    ingest.main(job, ingest.Params(**params["ingest"]))
    job.paths.masks.mkdir(parents=True)
    monkeypatch.setattr("pipeline.io.posed.free_memory", lambda: 5 * WIDTH * HEIGHT * 25 - 1)
    monkeypatch.setattr("stages.poses.sfm.reconstruct", _began)
    how = {**params["poses"], "align_rounds": align_rounds, "use_masks": use_masks}
    told = "need about" if align_rounds and use_masks else "features"
    with pytest.raises(UserError, match=told):
        poses.main(job, poses.Params(**how))


def _began(*words, **more):
    raise UserError("features")


def test_poses_in_coordinates_of_the_whole_earth_come_back_on_export(scene, tmp_path):
    """Metres of UTM: the fit's own world begins among the cameras, what is exported lies where it was."""
    utm = np.array([412345.678, 5_654_321.25, 312.5])
    data = tmp_path / "data/made"
    shutil.copytree(scene.images, data / "images")
    given = true_views(scene)
    for name, view in given.items():
        pose = view.cam_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ utm
        given[name] = dataclasses.replace(view, cam_from_world=pose)
        write_keep_mask(data / "masks" / name, np.ones((HEIGHT, WIDTH), np.bool_))
    write_transforms(data / "transforms.json", given.values(), beside="")
    job = Job(tmp_path, "made", None, "cpu", None, False)
    params = YAML(typ="safe").load((Path(__file__).parents[2] / "params.yaml").read_text())
    ingest.main(job, ingest.Params(**params["ingest"]))
    masks.main(job, masks.Params(**params["masks"]))
    poses.main(job, poses.Params(**params["poses"]))
    for view in read_transforms(job.paths.poses / "transforms.json").values():
        assert np.abs(view.world_from_cam[:3, 3]).max() < 5 and 0 < view.near < 2.9 < view.far
    wanted = export.Params(
        **{**params["export"], "formats": ["nerfstudio", "colmap", "llff", "ply"]}
    )
    export.main(job, wanted)
    out = job.paths.artifacts / "export"
    origin = np.array(json.loads((out / "llff/scene.json").read_text())["world_origin"])
    for door in ("nerfstudio", "colmap", "llff"):
        for name, view in find_capture(out / door, 3, read_colmap).views.items():
            there = np.linalg.inv(view.cam_from_world)
            if door == "llff":  # near its world's origin, for readers in 32 bits
                assert np.abs(there[:3, 3]).max() < 5
                there[:3, 3] += origin
            assert np.allclose(there, given[name].world_from_cam, rtol=0, atol=1e-7)
    model = pycolmap.Reconstruction(str(out / "colmap/sparse/0"))
    assert model.compute_mean_reprojection_error() < 0.5
    in_model = np.array([point.xyz for point in model.points3D.values()])
    in_cloud = read_ply(out / "ply/sparse.ply")[0]
    near = read_ply(out / "nerfstudio/sparse_pc.ply")[0]
    assert np.allclose(near + origin, in_cloud, rtol=0, atol=1e-5) and np.abs(near).max() < 20
    for points in (in_model, in_cloud):
        off = np.abs(points[:, 2:] - utm[2] - [[5.0, 3.6, 2.9]]).min(axis=1)
        assert np.median(off) < 0.03 and np.abs(points - utm).max() < 20
