"""What is loaded where the rows' processes are copied from: the stages of rows, of which there are many, and
the machine code of a fit and a view, fetched by a tiny one of each; the parameters that all profiles build on.
What is done once per scene loads itself.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.fit import fit
from pipeline.field.model import build_around
from pipeline.field.render import render_view
from pipeline.io.transforms import View
from pipeline.params import read_params

STAGES = ("refine", "nerf", "render", "evaluate")
SIDE = 8  # pixels


def _tiny() -> None:
    """A step of a fit to one dark photo, and a view of it."""
    middle, size = SIDE / 2, (SIDE, SIDE)
    view = View("dark", np.eye(4), SIDE, SIDE, middle, middle, 0.0, *size, near=1.0, far=2.0)
    photo = PosedPhoto(
        view.name, np.zeros((*size, 3), np.float32), np.ones(size, np.bool_),
        view.cam_from_world, view.intrinsics, view.near, view.far,
    )  # fmt: skip
    sizes: dict[str, Any] = {"resolution": 32, "table_log2": 10, "distortion": 0.002}
    field = build_around("fast", [view], view.near, view.far, **sizes)
    fit(field, RayBuffer([photo], 0), steps=1, batch_rays=16, seed=0, shards=1, threads=1)
    render_view(field, view.cam_from_world, view.intrinsics, size, view.near, view.far)


for stage in STAGES:
    importlib.import_module(f"stages.{stage}")
_tiny()
with suppress(UserError):  # the stages tell it
    read_params(Path(__file__).with_name("params.yaml"))
