"""What goes into a reconstruction and what comes out, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from pipeline.io.transforms import View

Camera = Literal["single", "per_image"]
Matcher = Literal["exhaustive", "sequential"]
Mapper = Literal["incremental", "global"]


LONG_VIDEO = 100  # frames


def fitting_matcher(kind: str, count: int) -> Matcher:
    """Every pair of photos, but neighbours only for long videos: the pairs are the square of the count."""
    return "sequential" if kind == "video" and count > LONG_VIDEO else "exhaustive"


@dataclass(frozen=True)
class Settings:
    """How one attempt is made. Lengths in pixels; counts per image.

    `camera`: one set of intrinsics for all images of one size, or one for each image. `masked`:
    features under the drops are ignored. `still`: matches that stay at their pixel in both photos
    are dropped, as drops on the lens make them. `loose`: images are placed on fewer and less
    certain matches. `max_image_size` 0 keeps the size for feature extraction.
    """

    camera: Camera
    matcher: Matcher
    mapper: Mapper
    max_features: int
    max_image_size: int
    masked: bool
    still: bool
    refine_focal: bool
    refine_distortion: bool
    peak_threshold: float = 0.02 / 3
    max_ratio: float = 0.8
    loose: bool = False

    def features_key(self) -> tuple[Any, ...]:
        """What features and matches depend on: equal keys share a database."""
        return (
            self.camera,
            self.matcher,
            self.max_features,
            self.max_image_size,
            self.masked,
            self.still,
            self.peak_threshold,
            self.max_ratio,
        )


@dataclass(frozen=True)
class Matching:
    """Per image: features outside the mask, the most verified matches with one other image, and the
    features that match in any other (`matched`)."""

    keypoints: dict[str, int]
    best_match: dict[str, int]
    best_partner: dict[str, str | None]
    matched: dict[str, int]


@dataclass(frozen=True)
class LostImage:
    """An image without a pose, and why; `best_match` verified matches with `best_partner`."""

    name: str
    keypoints: int
    best_match: int
    best_partner: str | None
    reason: str

    def __str__(self) -> str:
        return f"{self.name} ({self.reason})"


@dataclass(frozen=True)
class Attempt:
    """One try: its name, the images it placed, its error, the sizes of all its models."""

    label: str
    registered: int
    reprojection_px: float | None
    model_sizes: list[int]
    chosen: bool = False


@dataclass(frozen=True)
class Reconstructed:
    """The largest model of the best attempt.

    `views` by image name (registered ones only). Points: `points_xyz` (N, 3) float64 in the same
    world, `points_rgb` (N, 3) uint8, `points_error` (N,) mean reprojection error in pixels. The
    world's origin, turn and scale are the solver's own.
    """

    views: dict[str, View]
    lost: list[LostImage]
    points_xyz: np.ndarray
    points_rgb: np.ndarray
    points_error: np.ndarray
    reprojection_px: float
    model_sizes: list[int]
    matching: Matching
    attempts: list[Attempt]
    settings: Settings
    model: Any = field(repr=False)  # the pycolmap.Reconstruction, for write_sparse only
    aligned: bool = False  # whether the cameras were moved onto the photos, see `with_poses`


def account(found: Reconstructed, total: int) -> dict[str, Any]:
    """What poses.json holds: who of `total` was placed, who was not and why, and what was tried."""
    return {
        "total": total,
        "registered": sorted(found.views),
        "lost": [vars(image) for image in found.lost],
        "images": {
            name: {"keypoints": count, "best_match": found.matching.best_match[name]}
            for name, count in found.matching.keypoints.items()
        },
        "reprojection_px": round(found.reprojection_px, 6),
        "points": len(found.points_xyz),
        "model_sizes": found.model_sizes,
        "focal_px": round(float(np.median([view.fx for view in found.views.values()])), 4),
        "aligned": found.aligned,
        "masked": found.settings.masked,
        "stationary_dropped": found.settings.still,
        "tried": [
            {**vars(one), "reprojection_px": one.reprojection_px and round(one.reprojection_px, 6)}
            for one in found.attempts
        ],
    }
