"""Scripts beside the chain, which no other test runs: what they use of the project exists, and ordinary
mistakes are told.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from experiments import loop
from experiments.command import picture, write_picture
from pipeline.io.images import read_image
from tests.evaluation.fabricated import fabricate

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = [*sorted(ROOT.glob("experiments/**/*.py")), *sorted(ROOT.glob("benchmarks/*.py"))]
OWN = ("pipeline", "stages", "experiments", "benchmarks")


def imported(tree: ast.AST) -> dict[str, object]:
    """What a script imports of the project, by the name that it has there; AttributeError if absent."""
    found: dict[str, object] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in OWN:
                    found[alias.asname or alias.name] = importlib.import_module(alias.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OWN:
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name):  # a module of a package that is not loaded yet
                    importlib.import_module(f"{node.module}.{alias.name}")
                found[alias.asname or alias.name] = getattr(module, alias.name)
    return found


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_names_of_the_project_exist(script: Path) -> None:
    tree = ast.parse(script.read_text(encoding="utf-8"))
    modules = {k: one for k, one in imported(tree).items() if isinstance(one, ModuleType)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            there = module is None or hasattr(module, node.attr)
            assert there, f"{script.name}:{node.lineno}: {node.value.id}.{node.attr}"


@pytest.mark.parametrize(
    "command, told",
    [
        ("tables.publish quick", "run `make tables PROFILE=quick` first"),
        ("loop --params params.yaml nosuch", "nosuch/images"),
        ("removers.score attgan --out new", "name --scenes, --photos or --pairs"),
        ("removers.score attgan --out new --pairs .", "No picture of these sets"),
        ("detector.score unet:file --threshold 1", "--threshold 1 is not in [0, 1)"),
        ("detector.score unet", "Write MODEL:FILE."),
        ("poses.measure --photos a/b --ways filter --out new", "add plain to --ways"),
        ("detector.failures unet:file out.gif --rendered .", "out.gif does not end with .jpg"),
    ],
)
def test_an_ordinary_mistake_ends_with_a_sentence(
    command: str,
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name, *words = command.split()
    module = importlib.import_module(f"experiments.{name}")
    monkeypatch.setattr("experiments.tables.publish.HERE", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *words])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 2
    assert told in capsys.readouterr().err


def test_a_picture_gets_the_folder_that_it_needs(tmp_path: Path) -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[..., 2] = 200  # red, as OpenCV has it
    for name in ("a.png", "b/c.JPG"):
        target = picture(str(tmp_path / "new" / name))
        write_picture(target, pixels, 90)
        assert np.allclose(read_image(target)[0, 0], (200 / 255, 0, 0), atol=0.02)
    with pytest.raises(argparse.ArgumentTypeError, match="does not end with"):
        picture("out.gif")


def test_the_loops_picture_goes_by_the_coverage_that_is_asked_for(tmp_path: Path) -> None:
    """Above 1 no pixel is covered: none is found or missed, whatever is masked is too much."""
    fabricate(tmp_path, variant=None, video=False)
    red = np.array(loop.TOO_MUCH, np.float32) * 0.55

    def marks(covered: float) -> np.ndarray:
        photo, marked = np.split(loop.picture(tmp_path, "made", covered), 2, axis=1)
        return np.unique(np.round((marked - 0.45 * photo)[(marked != photo).any(2)], 3), axis=0)

    assert np.allclose(marks(1.0), red, atol=1e-3)
    assert not np.allclose(marks(0.05)[:, 0], red[0], atol=1e-3)
