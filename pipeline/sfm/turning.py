"""Photos taken by turning on the spot: their matches tell directions, and no depth."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see the package
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.optimize import minimize

MOST_PAIRS, MOST_MATCHES = 200, 100  # pairs, and matches of each, that are looked at
PERCENTILE = 90.0  # of distances: some matches are wrong, and depth may show in few
# Focal lengths, in the longest side of a photo where none is known, and times the known one; and how far,
# of the way to a corner, the lens may move it. With more of either, walks along a bare wall pass for turns.
FREE, KNOWN, MOST_BENT = (0.4, 1.25), (0.9, 1.1), 0.02
# A turn leaves matches as far off as features lie wrong. In mean reprojection errors of the model: 3.2 to
# 3.3 for turns, 6 for steps of 1/50 of the depth along a bare wall, 20 for a turn that strays by 1/60 of the
# depth, 36 on the demo, 270 on photos of a tree.
AS_THE_MODEL = 4.0
MOST_PX = 2.0


@dataclass(frozen=True)
class Matches:
    """Pixels `first` and `second` (N, 2) of one point in two photos, from their centres, by pairs of photos.

    `starts` (P,) where each pair begins in them. `unit` (N, 2): what a focal length of 1 is for either side,
    pixels. `corner`: how far the photos reach from their centres, in these units. `known`: the unit is a
    focal length that the photos came with.
    """

    first: np.ndarray
    second: np.ndarray
    starts: np.ndarray
    unit: np.ndarray
    corner: float
    known: bool


def turns_alone(model: pycolmap.Reconstruction, database: Path) -> bool:
    """Whether turning on the spot explains the verified matches of the model's images as the model does.

    If so, its places and depths are made up of what features lie wrong.
    """
    names = {image.name for image in model.images.values() if image.has_pose}
    matches = read_matches(database, names)
    if matches is None:
        return False
    return turned_px(matches) <= min(
        AS_THE_MODEL * model.compute_mean_reprojection_error(), MOST_PX
    )


def turned_px(matches: Matches) -> float:
    """How far off, in pixels, nine of ten matches stay if the camera only turned between photos.

    x' ~ K R K^-1 x with a turn R for each pair and one lens for all: those that explain the matches best.
    """
    low, high = np.log(KNOWN if matches.known else FREE)

    def off(lens: np.ndarray) -> float:
        return float(np.percentile(_residuals(matches, np.exp(lens[0]), lens[1]), PERCENTILE))

    found = []
    for start in np.linspace(low, high, 4)[:-1]:
        simplex = [(start, 0.0), (start + (high - low) / 8, 0.0), (start, MOST_BENT / 2)]
        found.append(
            minimize(
                off,
                simplex[0],
                method="Nelder-Mead",
                bounds=((low, high), (-MOST_BENT, MOST_BENT)),
                options={
                    "initial_simplex": simplex,
                    "xatol": 1e-3,
                    "fatol": 1e-3,
                    "maxfev": 120,
                },
            ).fun
        )
    return float(min(found))


def _residuals(matches: Matches, focal: float, bent: float) -> np.ndarray:
    """(N,) pixels between `second` and where the best turn of its pair takes `first`."""
    flat, rays = [], []
    for side, pixels in enumerate((matches.first, matches.second)):
        xy = pixels / matches.unit[:, side : side + 1]
        far = (xy**2).sum(axis=1, keepdims=True) / matches.corner**2
        flat.append(xy * (1 + bent * far) / focal)
        ray = np.column_stack([flat[-1], np.ones(len(xy))])
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    # The turn that brings rays nearest to rays (Kabsch): U diag(1, 1, det) V^T of the sum of b a^T.
    sums = np.add.reduceat(rays[1][:, :, None] * rays[0][:, None, :], matches.starts, axis=0)
    left, _, right = np.linalg.svd(sums)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    counts = np.diff([*matches.starts, len(rays[0])])
    turned = np.einsum("nij,nj->ni", np.repeat(left @ right, counts, axis=0), rays[0])
    off = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) - flat[1]
    return np.linalg.norm(off, axis=1) * focal * matches.unit[:, 1]


def read_matches(database: Path, names: set[str]) -> Matches | None:
    """Verified matches of pairs of the images `names`, some of each, of some pairs; None for no pair."""
    with pycolmap.Database.open(str(database)) as entries:
        images = {one.image_id: one for one in entries.read_all_images() if one.name in names}
        cameras = {one.camera_id: one for one in entries.read_all_cameras()}
        found = zip(*entries.read_two_view_geometries(), strict=True)
        pairs = [
            (pycolmap.pair_id_to_image_pair(key), geometry.inlier_matches)
            for key, geometry in sorted(found, key=lambda one: one[0])
            if len(geometry.inlier_matches)
        ]
        pairs = [(pair, inliers) for pair, inliers in pairs if set(pair) <= images.keys()]
        pairs = pairs[:: max(1, -(-len(pairs) // MOST_PAIRS))]
        used = sorted({key for pair, _ in pairs for key in pair})
        keypoints = {key: entries.read_keypoints(key)[:, :2] for key in used}
    if not pairs:
        return None
    lens = {key: cameras[images[key].camera_id] for key in used}
    known = all(camera.has_prior_focal_length for camera in lens.values())
    unit = {
        key: float(camera.params[0] if known else max(camera.width, camera.height))
        for key, camera in lens.items()
    }
    corner = max(np.hypot(one.width, one.height) / 2 / unit[key] for key, one in lens.items())
    sides: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    units, starts = [], [0]
    for pair, inliers in pairs:
        chosen = inliers[:: -(-len(inliers) // MOST_MATCHES)]
        for side, key in enumerate(pair):
            sides[side].append(keypoints[key][chosen[:, side]] - lens[key].params[1:3])
        units.append(np.tile([unit[key] for key in pair], (len(chosen), 1)))
        starts.append(starts[-1] + len(chosen))
    first, second = (np.concatenate(side).astype(np.float64) for side in sides)
    return Matches(
        first, second, np.array(starts[:-1]), np.concatenate(units), float(corner), known
    )
