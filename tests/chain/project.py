"""A copy of the project with a tiny scene of known truth, and how to run it as a user would."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from ruamel.yaml import YAML

from pipeline.drops.synthesis import painted
from pipeline.io.atomic import write_json
from pipeline.io.images import as_bytes
from tests import planes

ROOT = Path(__file__).resolve().parents[2]
SCENE, VIEWS, FIELD_OF_VIEW = "tiny", 9, 57.2
LEFT_BEHIND = shutil.ignore_patterns(
    ".git", ".venv", "artifacts", "data", "tests", "cache", "tmp", "*.lock", "__pycache__", ".*_cache",
    "config.local",
)  # fmt: skip
# Small enough to see every stage at work within seconds.
SMALL: dict[str, dict[str, Any]] = {
    "poses": {"align_rounds": 1, "align_first_steps": 40},
    "refine": {"rounds": 1, "first_steps": 40, "batch_rays": 1024},
    "nerf": {"steps": 40, "batch_rays": 1024, "levels": 2, "table_log2": 12, "resolution": 64},
    "render": {"path_frames": 4, "path_scale": 0.25},
    "report": {"picture_size": 120},
}
# Programs that a checkout needs beside its environment; there is no compiler among them.
PROGRAMS = ("sh", "bash", "env", "dirname", "grep", "uname")


def copy_project(root: Path) -> None:
    """The project without its repository, data and results, with the scene `tiny` as its only one."""
    shutil.copytree(ROOT, root, ignore=LEFT_BEHIND, symlinks=True)
    photograph(root / "data" / SCENE)
    write_small_params(root)


def write_small_params(root: Path) -> None:
    """Puts the scene `tiny` into params.yaml in the demo's place, with little work to do."""
    text = YAML()
    params = text.load(root / "params.yaml")
    demo = {stage: dict(values) for stage, values in params["scenes"]["demo"].items()}
    for stage, values in SMALL.items():
        demo[stage] = demo.get(stage, {}) | values
    params["scenes"] = {SCENE: demo}
    params["comparisons"] = {
        name.replace("demo", SCENE): {**values, "scene": SCENE}
        for name, values in params["comparisons"].items()
        if values["scene"] == "demo"
    }
    text.dump(params, root / "params.yaml")


def set_param(root: Path, section: str, key: str, value: Any) -> None:
    """Changes one line of params.yaml, as an editor would."""
    file = root / "params.yaml"
    body = re.compile(rf"(?m)^({section}:\n(?:  .*\n)*?  {key}: )[^\s#]+")
    text, count = body.subn(rf"\g<1>{value}", file.read_text())
    assert count == 1, f"{section}.{key} stands once in params.yaml"
    file.write_text(text)


def set_scene_param(root: Path, section: str, key: str, value: Any) -> None:
    """Changes one of the scene's own values in params.yaml."""
    text = YAML()
    params = text.load(root / "params.yaml")
    params["scenes"][SCENE][section][key] = value
    text.dump(params, root / "params.yaml")


def photograph(folder: Path) -> None:
    """Walls of brick from nine places, as photos through drops on the lens, with their truth."""
    cams = {}
    for index in range(VIEWS):
        angle, radius = 2.4 * index, 0.9 * np.sqrt((index + 0.5) / VIEWS)
        place = (radius * np.cos(angle), 0.4 * radius * np.sin(angle), 0.2 * np.sin(3 * angle))
        cam = planes.camera_at(*place)
        clean = as_bytes(planes.draw(cam, cover=planes.masonry))
        rainy, coverage = painted(
            clean, seed=3, pane_m=0.12, coverage=0.11, radius_mm=(2.5, 6.0), aperture_mm=1.0,
            field_of_view_deg=FIELD_OF_VIEW, focal=planes.FOCAL,
        )  # fmt: skip
        name = f"view_{index}"
        cams[name] = {"cam_from_world": cam.tolist()}
        _save(folder / f"{name}.png", rainy)
        _save(folder / f"truth/clean/{name}.png", clean)
        _save(folder / f"truth/coverage/{name}.png", as_bytes(coverage))
    write_json(folder / "truth/cameras.json", {"frames": cams, "unit": "m"})


def _save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels)


def environment(root: Path) -> dict[str, str]:
    """What a bare machine's shell knows: no compiler and no GPU; an active environment, unless the
    checkout has its own in .venv."""
    programs = root.parent / "programs"
    if not programs.exists():
        programs.mkdir()
        for name in PROGRAMS:
            (programs / name).symlink_to(shutil.which(name) or "/absent")
    return {
        "PATH": str(programs),
        "HOME": str(root.parent),
        **({} if (root / ".venv").exists() else {"VIRTUAL_ENV": sys.prefix}),
        "CUDA_VISIBLE_DEVICES": "",
        "DVC_NO_ANALYTICS": "1",
        "DVC_SITE_CACHE_DIR": str(root.parent / "dvc"),
        **{name: value for name, value in os.environ.items() if name.endswith("_NUM_THREADS")},
    }


@functools.cache
def offline() -> tuple[str, ...]:
    """What to put before a command so that it has no network, where the system lets us."""
    wall = ("unshare", "--map-root-user", "--net")
    if (
        shutil.which("unshare")
        and not subprocess.run([*wall, "true"], capture_output=True).returncode
    ):
        return (str(shutil.which("unshare")), *wall[1:])
    return ()


def dvc(root: Path, *arguments: str, cores: set[int] | None = None) -> str:
    """What `dvc` says; fails when it does."""
    command = [Path(sys.executable).with_name("dvc"), *arguments]
    return _run(root, command, cores)


def start_dvc(root: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """A `dvc` that is running."""
    command = [Path(sys.executable).with_name("dvc"), *arguments]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=root, env=environment(root), stdout=quiet, stderr=quiet)


def by_hand(root: Path, command: str, cores: set[int] | None = None) -> str:
    """What a stage says when its command is typed in."""
    return _run(root, ["sh", "-c", command], cores)


def _run(root: Path, command: list[Any], cores: set[int] | None) -> str:
    done = subprocess.run(
        [*offline(), *command], cwd=root, env=environment(root), capture_output=True, text=True,
        preexec_fn=(lambda: os.sched_setaffinity(0, cores)) if cores else None,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def ran(said: str) -> list[str]:
    """The stages that a `dvc repro` ran, in their order."""
    return re.findall(r"^Running stage '([^']+)'", said, re.MULTILINE)


def fingerprints(root: Path) -> dict[str, str]:
    """The SHA-256 of every file under artifacts/, by its path there; scratch is left out."""
    folder = root / "artifacts" / SCENE
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Graph:
    """The stages of dvc.lock: what each runs, and which need which."""

    def __init__(self, root: Path) -> None:
        entries = yaml.safe_load((root / "dvc.lock").read_text())["stages"]
        self.commands: dict[str, str] = {name: entry["cmd"] for name, entry in entries.items()}
        outs = {name: [out["path"] for out in entry["outs"]] for name, entry in entries.items()}
        needs = {name: [dep["path"] for dep in entry["deps"]] for name, entry in entries.items()}
        self.needs = {
            name: {
                maker
                for maker, made in outs.items()
                if any(f"{dep}/".startswith(f"{out}/") for dep in needs[name] for out in made)
            }
            for name in entries
        }
        self.order = list(TopologicalSorter(self.needs).static_order())

    def after(self, *names: str) -> set[str]:
        """The named stages and all that follow from them."""
        found = set(names)
        for name in self.order:
            if self.needs[name] & found:
                found.add(name)
        return found
