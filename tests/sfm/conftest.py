"""A scene with known cameras: the three textured planes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.images import write_image
from tests.planes import camera_at, draw


@dataclass(frozen=True)
class Scene:
    """Image folder, names, true cam_from_world by name."""

    images: Path
    cams: dict[str, np.ndarray]

    @property
    def names(self) -> list[str]:
        return sorted(self.cams)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("planes")
    places = [
        (-0.9, -0.2, 0.0),
        (-0.3, 0.25, 0.1),
        (0.3, -0.25, -0.1),
        (0.9, 0.2, 0.0),
        (0, 0, 0.3),
    ]
    cams = {f"v{index}.png": camera_at(*place) for index, place in enumerate(places)}
    for name, cam in cams.items():
        write_image(folder / name, draw(cam))
    return Scene(folder, cams)
