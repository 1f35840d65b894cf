"""Poses that came with the photos: read from a COLMAP model, kept, and points found for them."""

from __future__ import annotations

import logging
import shutil
import zlib  # noqa: F401  before pycolmap, see the package
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.errors import UserError
from pipeline.geometry.poses import as_4x4, centre
from pipeline.io.given import GivenView, checked_camera
from pipeline.io.transforms import View
from pipeline.sfm.database import Progress, build_database
from pipeline.sfm.model import points_of, with_depths
from pipeline.sfm.reconstruct import check_inputs, refuse_few, silent, tell_lost
from pipeline.sfm.result import Attempt, LostImage, Matching, Reconstructed, Settings
from pipeline.sfm.whole import refuse_cut_short

log = logging.getLogger(__name__)

# Of each camera model: how many focal lengths lead its parameters, OpenCV's names of the coefficients
# that follow the principal point, and whether they bend as a fisheye.
_MODELS: dict[str, tuple[int, tuple[str, ...], bool]] = {
    "SIMPLE_PINHOLE": (1, (), False),
    "PINHOLE": (2, (), False),
    "SIMPLE_RADIAL": (1, ("k1",), False),
    "RADIAL": (1, ("k1", "k2"), False),
    "OPENCV": (2, ("k1", "k2", "p1", "p2"), False),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), False),
    "SIMPLE_RADIAL_FISHEYE": (1, ("k1",), True),
    "RADIAL_FISHEYE": (1, ("k1", "k2"), True),
    "OPENCV_FISHEYE": (2, ("k1", "k2", "k3", "k4"), True),
}
# Shares of matched features that become points. Measured: 0.77 and 0.83 with right poses, 0.12 and 0.06
# with each photo's pose given to its neighbour or to the fifth from it.
MISFIT, DOUBTFUL = 0.2, 0.5
MANY_VIEWS, NEIGHBOURS = 60, 20  # of more views than that, each is matched with its nearest
MOST_OFF_PX = 1.0  # that rounding to 32 bits may move what the cameras see
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_ORDER_FISHEYE = ("k1", "k2", "k3", "k4")


def read_colmap(folder: Path, photos: Sequence[Path]) -> list[GivenView]:
    """The cameras of a COLMAP model, text or binary, of those `photos` that it has placed.

    Images are found by their file names. UserError for a damaged model, a camera model that cannot be
    expressed, or a model of other photos.
    """
    try:
        refuse_cut_short(folder)
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, IndexError, KeyError, MemoryError) as error:
        raise UserError(f"{folder} is not a readable COLMAP model ({error}).") from None
    by_name = {photo.name: photo for photo in photos}
    called = Counter(Path(image.name).name for image in model.images.values())
    if twice := sorted(name for name in by_name if called[name] > 1):
        raise UserError(
            f"{folder} holds {called[twice[0]]} images called {twice[0]}, in different folders.",
            "Photos are found by their file names: give each a name of its own, in the model too.",
        )
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        photo = by_name.get(Path(image.name).name)
        if photo is not None and image.has_pose:
            views.append(_given(folder, photo, image))
    if not views:
        raise UserError(
            f"{folder} places none of the photos in {photos[0].parent}.",
            "The model's image names must be the photos' file names.",
        )
    return views


def _given(folder: Path, photo: Path, image: pycolmap.Image) -> GivenView:
    camera = image.camera
    if camera.model_name not in _MODELS:
        raise UserError(
            f"{folder}: the camera model {camera.model_name} of {photo.name} cannot be used.",
            "Undistort the model first (`colmap image_undistorter`).",
        )
    focals, names, fisheye = _MODELS[camera.model_name]
    params = [float(value) for value in camera.params]
    bent = dict(zip(names, params[focals + 2 :], strict=True))
    order = _ORDER_FISHEYE if fisheye else _ORDER
    try:
        pose = as_4x4(image.cam_from_world().matrix())
    except (RuntimeError, ValueError):  # the rig has a pose, its camera none on it
        raise UserError(
            f"{folder} does not tell where on its rig the camera of {photo.name} is.",
            "Calibrate the rig first, or take that camera's photos away.",
        ) from None
    view = GivenView(
        photo=photo,
        cam_from_world=pose,
        width=int(camera.width),
        height=int(camera.height),
        fx=params[0],
        fy=params[focals - 1],
        cx=params[focals],
        cy=params[focals + 1],
        distortion=tuple(bent.get(name, 0.0) for name in order) if names else (),
        fisheye=fisheye,
    )
    return checked_camera(view, str(folder))


def triangulate(
    image_dir: Path,
    mask_dir: Path | None,
    names: Sequence[str],
    given: Mapping[str, View],
    *,
    work_dir: Path,
    settings: Settings,
    min_registered: float = 0.0,
    depth_margin: float = 0.2,
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Reconstructed:
    """The `given` views unchanged, and the points that the photos show from there.

    The points tell the depths where the views do not, and their error tells whether the poses are
    those of the photos. Images without a given pose are lost. Other arguments as in `reconstruct`.
    UserError when masks are missing, fewer than the share `min_registered` have a pose, the poses do not
    fit, or depths stay unknown.
    """
    names, settings = sorted(names), replace(settings, camera="per_image")
    sizes = check_inputs(image_dir, mask_dir if settings.masked else None, names)
    given = _of_these(given, sizes, image_dir)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    work_dir.mkdir(parents=True, exist_ok=True)
    report = progress if progress is not None else silent
    database = work_dir / "database.db"
    near = nearest_pairs(given) if settings.matcher == "exhaustive" else None
    matching = build_database(
        database, image_dir, mask_dir, sizes, {}, settings,
        seed=seed, threads=threads, progress=report, pairs=near,
    )  # fmt: skip
    lost = _lost(names, given, matching, min_registered, image_dir)
    report("triangulating", 0, 1)
    model = _with_points(_posed_model(database, given), database, image_dir, work_dir, seed)
    report("triangulating", 1, 1)
    _check_fit(model, sum(matching.matched[name] for name in given), image_dir)
    views = with_depths(given, model, depth_margin)
    _check_depths(views)
    _check_origin(views)
    xyz, rgb, error = points_of(model)
    reprojection = model.compute_mean_reprojection_error() if len(xyz) else 0.0
    return Reconstructed(
        views=views,
        lost=lost,
        points_xyz=xyz,
        points_rgb=rgb,
        points_error=error,
        reprojection_px=reprojection,
        model_sizes=[len(views)],
        matching=matching,
        attempts=[Attempt("poses as given", len(views), reprojection, [len(views)], True)],
        settings=settings,
        model=model,
    )


def _of_these(
    given: Mapping[str, View], sizes: Mapping[str, tuple[int, int]], image_dir: Path
) -> dict[str, View]:
    """The views that belong to images, whose sizes are told; UserError for none, or of another size."""
    found = {name: view for name, view in given.items() if name in sizes}
    odd = [name for name, view in found.items() if (view.width, view.height) != sizes[name]]
    if odd or not found:
        told = f"that of {min(odd)} is for another size" if odd else "none is for one of them"
        raise UserError(
            f"the poses that came with the photos in {image_dir} do not fit them: {told}.",
            "Run `python -m stages.ingest` again, or set poses.use_given: false.",
        )
    return found


def nearest_pairs(given: Mapping[str, View]) -> list[tuple[str, str]] | None:
    """Which of many views are matched, by name: each with its NEIGHBOURS nearest; None for all, of few.

    A turn by a radian is as far as the views' mean distance from their midst.
    """
    names = sorted(given)
    if len(names) <= MANY_VIEWS or any(
        name.startswith("#") for name in names
    ):  # a remark in a list
        return None
    centres = np.stack([centre(given[name].cam_from_world) for name in names])
    ahead = np.stack([given[name].cam_from_world[2, :3] for name in names])
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    pairs = set()
    for index, name in enumerate(names):
        away = np.linalg.norm(centres - centres[index], axis=1) / max(extent, 1e-12)
        away += np.arccos(np.clip(ahead @ ahead[index], -1.0, 1.0))
        away[index] = np.inf
        nearest = np.argsort(away, kind="stable")[:NEIGHBOURS]
        pairs |= {(min(name, names[other]), max(name, names[other])) for other in nearest}
    return sorted(pairs)


def _with_points(
    posed: pycolmap.Reconstruction, database: Path, image_dir: Path, work_dir: Path, seed: int
) -> pycolmap.Reconstruction:
    """The posed model with the points that its matches show, cameras and poses unchanged."""
    out = work_dir / "models"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
    return pycolmap.triangulate_points(
        posed, database, image_dir, out,
        clear_points=True, options=options, refine_intrinsics=False,
    )  # fmt: skip


def _lost(
    names: Sequence[str],
    given: Mapping[str, View],
    matching: Matching,
    share: float,
    image_dir: Path,
) -> list[LostImage]:
    """The images without a pose, told; UserError when less than `share` of all has one."""
    lost = [_unposed(name, matching) for name in names if name not in given]
    tell_lost(lost)
    hint = (
        "Find poses for the others too, set poses.use_given: false, or lower poses.min_registered."
    )
    refuse_few(len(given), lost, share, image_dir, hint)
    return lost


def _unposed(name: str, matching: Matching) -> LostImage:
    return LostImage(
        name, matching.keypoints[name], matching.best_match[name], matching.best_partner[name],
        "the capture has no pose for it",
    )  # fmt: skip


def _check_depths(views: Mapping[str, View]) -> None:
    blind = [name for name, view in views.items() if not 0 < view.near < view.far]
    if blind:
        raise UserError(
            f"the photos show no points before {', '.join(blind)}: their depths stay unknown.",
            "Give near and far depths with the poses, or set poses.use_given: false.",
        )


def _check_origin(views: Mapping[str, View]) -> None:
    """A fit counts in 32 bits: cameras in coordinates of the whole earth would stand where these end."""
    views_off = [
        np.finfo(np.float32).eps * np.linalg.norm(centre(view.cam_from_world)) * view.fx / view.near
        for view in views.values()
    ]
    if (off := float(np.median(views_off))) > MOST_OFF_PX:
        raise UserError(
            "the poses that came with the photos lie so far from the origin of their world that a fit would "
            f"see them {off:.0f} px off.",
            "Take the place of one camera from all places, or set poses.use_given: false.",
        )


def _check_fit(model: pycolmap.Reconstruction, matched: int, image_dir: Path) -> None:
    """Poses of these photos turn most of their matched features into points; others, few."""
    share = model.compute_num_observations() / matched if matched else 0.0
    text = f"{share:.0%} of the matched features agree with the poses that came with {image_dir}"
    if matched and share < MISFIT:
        raise UserError(
            f"the poses that came with the photos do not fit them: only {text}.",
            "Check that poses and photos belong together, or set poses.use_given: false.",
        )
    if share < DOUBTFUL:
        log.warning("only %s; better ones may come of poses.use_given: false", text)


def _posed_model(database: Path, given: Mapping[str, View]) -> pycolmap.Reconstruction:
    """A model without points: each given view with a camera of its own, ids as in the database."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(str(database)) as entries:
        for image in sorted(entries.read_all_images(), key=lambda image: image.name):
            if image.name not in given:
                continue
            view = given[image.name]
            camera = pycolmap.Camera(
                model="OPENCV",
                width=view.width,
                height=view.height,
                params=[*view.intrinsics, 0.0, 0.0, 0.0],
                camera_id=image.camera_id,
            )
            entries.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            pose = view.cam_from_world
            rigid = pycolmap.Rigid3d(
                pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3])), pose[:3, 3]
            )
            model.add_image_with_trivial_frame(
                pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                rigid,
            )
    return model
