"""Structure from motion: where the photos were taken from. The only room that knows pycolmap.

pycolmap exports a zlib of its own. Loaded before the system's, it makes the first PNG that OpenCV
writes abort the process; hence the import below, which must stay first.
"""

import zlib  # noqa: F401

from pipeline.sfm.database import Progress
from pipeline.sfm.export import read_sparse, sparse_points, write_straight
from pipeline.sfm.given import read_colmap, triangulate
from pipeline.sfm.model import write_sparse
from pipeline.sfm.placing import with_poses
from pipeline.sfm.reconstruct import reconstruct
from pipeline.sfm.result import (
    Attempt,
    LostImage,
    Reconstructed,
    Settings,
    account,
    fitting_matcher,
)  # fmt: skip

__all__ = [
    "Attempt",
    "LostImage",
    "Progress",
    "Reconstructed",
    "Settings",
    "account",
    "fitting_matcher",
    "read_colmap",
    "read_sparse",
    "reconstruct",
    "sparse_points",
    "triangulate",
    "with_poses",
    "write_sparse",
    "write_straight",
]
