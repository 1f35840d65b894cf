"""Structure from motion: where the photos were taken from. The only room that knows pycolmap.

pycolmap exports a zlib of its own. Loaded before the system's, it makes the first PNG that OpenCV
writes abort the process; hence the import below, which must stay first.
"""

import zlib  # noqa: F401

from pipeline.sfm.model import write_sparse
from pipeline.sfm.reconstruct import reconstruct
from pipeline.sfm.result import Attempt, LostImage, Reconstructed, Settings

__all__ = ["Attempt", "LostImage", "Reconstructed", "Settings", "reconstruct", "write_sparse"]
