"""What a scene's views were rendered from, so that others can tell whether it is still there."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

from pipeline.io.atomic import read_json, write_json
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import FILE

log = logging.getLogger(__name__)

INPUTS = "inputs.json"


def inputs_of(paths: ScenePaths) -> dict[str, str]:
    """SHA-256 of what views hang on: the list of photos, their poses, their masks (names and bytes)."""
    masks = sorted(paths.refine.glob("*.png"))
    return {
        "photos": _digest([paths.images / FILE]),
        "poses": _digest([paths.poses / "transforms.json"]),
        "masks": _digest(masks),
    }


def write_inputs(folder: Path, paths: ScenePaths) -> None:
    """Writes inputs.json into `folder`, which becomes the scene's views/."""
    write_json(folder / INPUTS, inputs_of(paths))


def changed_inputs(paths: ScenePaths) -> list[str]:
    """Which inputs are not those that views/ was rendered from; none, with a warning, if it does not tell."""
    path = paths.views / INPUTS
    if not path.is_file():
        log.warning("%s is missing: whether views/ shows these photos and poses is not known", path)
        return []
    then, now = read_json(path, "render", dict[str, str]), inputs_of(paths)
    return [name for name in now if then.get(name) != now[name]]


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name}\n{file.stat().st_size}\n".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()
