"""What leaves the house is read by others as it was meant: polarity, size and pose at every door."""

from __future__ import annotations

import json
import zlib  # noqa: F401
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from pipeline.geometry.fuse import DepthView, fuse
from pipeline.io.capture import find_capture
from pipeline.io.images import read_image, write_image
from pipeline.io.llff import poses_bounds
from pipeline.io.maps import read_depth
from pipeline.io.masks import read_keep_mask
from pipeline.io.ply import read_ply, write_ply
from pipeline.io.straighten import common_pinholes
from pipeline.sfm import read_colmap
from pipeline.stage import Job
from stages import export
from tests.export.made import (
    HEIGHT,
    K1,
    NAMES,
    PARAMS,
    POINTS,
    VIEWS,
    WIDTH,
    bent,
    exported,
    lens_at,
    scene,
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything, of a world that begins where the capture's does."""
    return exported(scene(tmp_path_factory.mktemp("export")))


def test_the_common_pinhole_is_covered_wholly_and_no_wider() -> None:
    """Pincushion (k1 > 0): a corner of the pinhole at r must come from r (1 + k1 r^2) in the frame."""
    straight = common_pinholes(VIEWS)["a.png"]
    assert straight.k1 == 0 and straight.fx == straight.fy
    x, y = WIDTH / 2 / straight.fx, HEIGHT / 2 / straight.fx
    gain = 1 + K1 * (x * x + y * y)
    assert 70 * x * gain == pytest.approx(WIDTH / 2, rel=1e-6), "the corner touches the edge"
    assert common_pinholes([lens_at("a.png", 0, 0.0)])["a.png"].fx == pytest.approx(70.0)
    barrel = common_pinholes([lens_at("a.png", 0, -0.1)])["a.png"]
    y = HEIGHT / 2 / barrel.fx  # the middle of the upper edge is the first to leave the frame
    assert 70 * y * (1 - 0.1 * y * y) == pytest.approx(HEIGHT / 2, rel=1e-6)


def test_llff_as_the_official_loader_reads_it(made: Path) -> None:
    """networks.md's reading of load_llff.py, step by step, from the files alone."""
    factor = PARAMS.llff_factor
    array = np.load(made / "llff/poses_bounds.npy")
    files = sorted(p.name for p in (made / f"llff/images_{factor}").iterdir())
    assert array.shape == (3, 17) and len(array) == len(files)
    poses = array[:, :-2].reshape(-1, 3, 5).transpose(1, 2, 0)
    bounds = array[:, -2:].T
    height, width = cv2.imread(str(made / f"llff/images_{factor}" / files[0])).shape[:2]
    assert poses[:2, 4, 0].tolist() == [HEIGHT, WIDTH], "H and W of images/"
    focal = poses[2, 4, 0] / factor
    assert (height, width) == (HEIGHT // factor, WIDTH // factor)
    # Columns are (down, right, back): the loader makes (right, up, back) of them.
    poses = np.concatenate([poses[:, 1:2], -poses[:, 0:1], poses[:, 2:]], axis=1)
    for number, one in enumerate(VIEWS):
        camera_to_world = poses[:, :4, number]
        # Its rays: d = ((i - W/2) / f, -(j - H/2) / f, -1) in the camera, OpenGL axes.
        point = POINTS[0]
        in_camera = camera_to_world[:, :3].T @ (point - camera_to_world[:, 3])
        i = width / 2 + focal * in_camera[0] / -in_camera[2]
        j = height / 2 - focal * in_camera[1] / -in_camera[2]
        straight = common_pinholes(VIEWS)[one.name]
        expected = bent(point[None], straight)[0] / factor
        assert (i, j) == pytest.approx(tuple(expected))
    assert np.allclose(bounds, [[1.5] * 3, [4.0] * 3])
    mask = np.load(made / "llff/rainMask.npy")
    assert mask.shape == (height, width, len(files)), "[H, W, N], of images_<factor>"
    assert mask[height // 2, 2, 1] == 1 and not mask[..., [0, 2]].any(), "1 is a drop, in b alone"
    assert not mask[:, width // 2 :, 1].any()


def test_pycolmap_reads_the_model_and_its_points_project_where_it_says(made: Path) -> None:
    model = pycolmap.Reconstruction(str(made / "colmap/sparse/0"))
    assert model.num_reg_images() == 3 and model.num_points3D() == 3
    assert model.compute_mean_reprojection_error() < 1e-6
    camera = next(iter(model.cameras.values()))
    assert camera.model_name == "PINHOLE" and (camera.width, camera.height) == (WIDTH, HEIGHT)
    for image in model.images.values():
        assert read_image(made / "colmap/images" / image.name).shape == (HEIGHT, WIDTH, 3)
        mask = read_keep_mask(made / "colmap/masks" / f"{image.name}.png", (WIDTH, HEIGHT))
        assert mask[:, :15].any() == (image.name != "b.png") and mask[:, 30:].all()


def test_the_colmap_masks_hide_features_from_colmap(made: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_image(tmp_path / "b.png", cv2.resize(rng.random((15, 20, 3)), (WIDTH, HEIGHT)))
    reader = pycolmap.ImageReaderOptions(mask_path=str(made / "colmap/masks"))
    pycolmap.extract_features(
        tmp_path / "d.db", tmp_path, image_names=["b.png"], reader_options=reader,
        device=pycolmap.Device.cpu,
    )  # fmt: skip
    with pycolmap.Database.open(str(tmp_path / "d.db")) as database:
        found = database.read_keypoints(1)
    assert len(found) > 5 and found[:, 0].min() > 15, "the left of b is dropped"


@pytest.mark.parametrize("door", ["nerfstudio", "colmap", "llff"])
def test_our_own_door_reads_it_back(made: Path, door: str) -> None:
    capture = find_capture(made / door, 3, read_colmap)
    assert list(capture.views) == list(NAMES)
    straight = common_pinholes(VIEWS)
    for view in VIEWS:
        back = capture.views[view.name].view(view.name, (WIDTH, HEIGHT))
        sent = view if door == "nerfstudio" else straight[view.name]
        assert np.allclose(back.cam_from_world, sent.cam_from_world, atol=1e-9)
        assert back.intrinsics == pytest.approx(sent.intrinsics)
    assert capture.masked_by == ("rainMask.npy" if door == "llff" else "mask pictures")


def test_photos_depth_and_points(made: Path) -> None:
    with Image.open(made / "photos/a.jpg") as photo:
        equivalent = photo.getexif().get_ifd(0x8769)[0xA405]
    assert equivalent == round(70 / 100 * np.hypot(36, 24)), "the diagonal is 100 px"
    assert np.allclose(read_depth(made / "depth/a.exr"), 2.0)
    xyz, rgb = read_ply(made / "ply/sparse.ply")
    assert np.allclose(xyz, POINTS) and (rgb == [10, 20, 30]).all()
    dense, _ = read_ply(made / "ply/dense.ply")
    assert len(dense) > WIDTH * HEIGHT * 0.9 and np.allclose(dense[:, 2], 2.0, atol=1e-5)
    body = json.loads((made / "nerfstudio/transforms.json").read_text())
    assert (made / "nerfstudio" / body["ply_file_path"]).is_file()
    for frame in body["frames"]:
        assert (made / "nerfstudio" / frame["file_path"]).is_file()
        assert (made / "nerfstudio" / frame["mask_path"]).is_file()


def test_a_variant_is_exported_beside_its_fit_not_over_its_scene(made: Path) -> None:
    """The variant has no views here; what the scene exported must still be where they were."""
    job = Job(made.parents[2], "made", "unmasked", "cpu", None, False)
    export.main(job, PARAMS)
    assert len(list((made / "photos").iterdir())) == len(NAMES)
    assert (made.parent / "unmasked/export/nerfstudio/transforms.json").is_file()


def test_depths_that_no_other_view_confirms_are_left_out() -> None:
    """Three cameras before a wall at 2; one of them sees half of it at 3."""
    wall = np.full((20, 30), 2.0, np.float32)
    wrong = wall.copy()
    wrong[:10] = 3.0
    grey = np.zeros((20, 30, 3), np.uint8)

    def camera(x: float, depth: np.ndarray) -> DepthView:
        pose = np.eye(4)
        pose[0, 3] = -x
        return DepthView(depth, grey, pose, 30.0, 30.0, 15.0, 10.0)

    xyz, _ = fuse([camera(0, wall), camera(0.05, wrong), camera(0.1, wall)], step=1, agreeing=1)
    assert np.allclose(xyz[:, 2], 2.0)
    # Once per place: all of the first view, and from the others only the strips beyond its edge.
    assert 20 * 30 * 0.9 <= len(xyz) <= 20 * 33


def test_points_and_rows_come_back(tmp_path: Path) -> None:
    xyz, rgb = np.random.default_rng(1).normal(size=(7, 3)), np.full((7, 3), 9, np.uint8)
    write_ply(tmp_path / "p.ply", xyz, rgb)
    assert np.allclose(read_ply(tmp_path / "p.ply")[0], xyz, atol=1e-6)
    utm = (4e5, 5e6, 0.0)
    write_ply(tmp_path / "far.ply", xyz, rgb, utm)
    far, colours = read_ply(tmp_path / "far.ply")
    assert np.allclose(far - utm, xyz, rtol=0, atol=1e-8) and (colours == rgb).all()
    shuffled = poses_bounds([replace(view, k1=0.0) for view in reversed(VIEWS)])
    assert shuffled[:, 3].tolist() == pytest.approx([0.0, 0.1, 0.2]), "rows go by name"
