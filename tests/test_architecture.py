"""The plan of the house, held to: imports run one way, and DVC knows what each stage imports."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import subprocess
import sys
from operator import itemgetter
from pathlib import Path
from typing import Any

import grimp
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
# What every stage runs on and what cannot change a result: flags, folders, threads, error texts.
RUNNER = {
    "pipeline",
    "pipeline.errors",
    "pipeline.stage",
    "pipeline.params",
    "pipeline.parallel",
    "pipeline.io",
    "pipeline.io.atomic",
    "pipeline.io.memory",
    "pipeline.io.paths",
    "pipeline.io.shapes",
}


@functools.cache
def _graph() -> Any:
    return grimp.build_graph("pipeline", "stages", cache_dir=None)


def true_code_dependencies(stage: str) -> set[str]:
    """The rooms that a stage imports, directly or not; `io`, which all share, file by file."""
    return _code(f"stages.{stage}")


def _code(module: str) -> set[str]:
    modules = _graph().find_upstream_modules(module) - RUNNER
    paths = set()
    for module in modules:
        parts = module.split(".")
        if parts[0] != "pipeline":
            continue
        paths.add("/".join(parts) + ".py" if parts[1] == "io" else "/".join(parts[:2]))
    return paths


def _stages() -> dict[str, dict[str, Any]]:
    content = yaml.safe_load((ROOT / "dvc.yaml").read_text())
    return {name: entry["do"] for name, entry in content["stages"].items()}


@pytest.mark.parametrize("name", _stages() if (ROOT / "dvc.yaml").exists() else [])
def test_dvc_lists_exactly_the_code_that_a_stage_imports(name: str) -> None:
    entry = _stages()[name]
    stage = entry["cmd"].split("stages.")[1].split()[0]
    listed = {dep for dep in entry["deps"] if dep.startswith("pipeline/")}
    assert listed == true_code_dependencies(stage)
    assert f"stages/{stage}.py" in entry["deps"]


@pytest.mark.parametrize("name", _stages() if (ROOT / "dvc.yaml").exists() else [])
def test_dvc_lists_the_parameters_that_a_stage_reads(name: str) -> None:
    entry = _stages()[name]
    stage = entry["cmd"].split("stages.")[1].split()[0]
    scene = "${item.scene}" if "--variant" in entry["cmd"] else "${key}"
    expected = {stage, f"scenes.{scene}.{stage}"}
    if "--variant" in entry["cmd"]:
        expected.add("variants.${item.variant}")
    assert set(entry["params"]) == expected


def test_the_wet_scenes_follow_the_code_that_renders_them() -> None:
    """`synthesize` can do more, paint on photos that lie anywhere; these scenes are ray traced."""
    content = yaml.safe_load((ROOT / "experiments/scenes/dvc.yaml").read_text())
    deps = {dep.removeprefix(".code/") for dep in content["stages"]["scene"]["do"]["deps"]}
    assert {"stages/synthesize.py", "pipeline/drops", *_code("pipeline.drops.storing")} <= deps


def _md5(path: Path) -> str:
    """What DVC writes down of a file or folder, without what .dvcignore names."""
    if path.is_file():
        return hashlib.md5(path.read_bytes()).hexdigest()
    files = [one for one in path.rglob("*.*") if one.is_file() and one.suffix != ".pyc"]
    listed = [
        {"md5": _md5(one), "relpath": one.relative_to(path).as_posix()}
        for one in files
        if "__pycache__" not in one.parts
    ]
    text = json.dumps(sorted(listed, key=itemgetter("relpath")), sort_keys=True)
    return f"{hashlib.md5(text.encode()).hexdigest()}.dir"


def test_the_wet_scenes_lock_file_is_of_the_code_and_parameters_as_they_are() -> None:
    """Else all are rendered anew wherever the comparison is made. CONTRIBUTING.md says how to renew it."""
    folder = ROOT / "experiments/scenes"
    params = yaml.safe_load((folder / "params.yaml").read_text())
    for name, entry in yaml.safe_load((folder / "dvc.lock").read_text())["stages"].items():
        for dep in entry["deps"]:
            assert dep["md5"] == _md5(folder / dep["path"]), f"{name}: {dep['path']} has changed"
        for key, value in entry["params"]["params.yaml"].items():
            now = functools.reduce(lambda values, part: values[part], key.split("."), params)
            assert value == now, f"{name}: {key} has changed"


def test_the_page_follows_the_numbers_that_it_shows() -> None:
    """metrics.json tells what no image has: the poses, and how the numbers were taken."""
    deps = _stages()["report"]["deps"]
    assert {"artifacts/${key}/metrics.json", "artifacts/${key}/poses"} <= set(deps)


def test_a_stage_says_in_one_sentence_what_it_does() -> None:
    """`--help` shows it."""
    for path, text in _sources().items():
        if path.startswith("stages/") and not path.endswith("__init__.py"):
            told = ast.get_docstring(ast.parse(text)) or ""
            assert told.endswith(".") and "\n" not in told and len(told) > 30, path


def test_a_scenes_page_needs_every_stage_of_it_and_of_its_comparison() -> None:
    """`make demo` asks DVC for the page alone: it must bring everything else along.

    (By a pattern it would not do: DVC runs all scenes where a pattern fits none.)
    """
    items = {"${key}": "demo", "${item.scene}": "demo", "${item.variant}": "unmasked"}
    items["${item.report.compare}"] = "unmasked"

    def filled(paths: list[str]) -> set[str]:
        for mark, word in items.items():
            paths = [path.replace(mark, word) for path in paths]
        return set(paths)

    stages = _stages()
    makes = {
        name: filled([*entry["outs"], *entry.get("metrics", [])]) for name, entry in stages.items()
    }
    found, ahead = {"report"}, ["report"]
    while ahead:
        needs = filled(stages[ahead.pop()]["deps"])
        for name, outs in makes.items():
            below = any(need == out or need.startswith(f"{out}/") for need in needs for out in outs)
            if below and name not in found:
                found.add(name)
                ahead.append(name)
    assert found == set(stages)
    recipes = (ROOT / "Makefile").read_text()
    assert "dvc repro report@demo" in recipes and "dvc repro report@$(SCENE)" in recipes


def test_no_file_that_is_read_can_run_code() -> None:
    """No pickle, no eval, and what could unpickle is told not to."""
    guards = {"load": {"torch": ("weights_only", True), "np": ("allow_pickle", False)}}
    for path, text in _sources().items():
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call):
                continue
            assert not ast.unparse(node.func).startswith(("pickle.", "yaml.", "joblib.")), path
            if isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), f"{path}:{node.lineno}"
            if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
                key, safe = guards.get(node.func.attr, {}).get(node.func.value.id, (None, None))
                given = {word.arg: getattr(word.value, "value", None) for word in node.keywords}
                # NumPy refuses by itself; torch only since 2.6.
                default = False if key == "allow_pickle" else None
                assert key is None or given.get(key, default) is safe, f"{path}:{node.lineno}"


def test_imports_run_one_way() -> None:
    linter = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([linter, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def _sources() -> dict[str, str]:
    """The text of every file of pipeline/ and stages/, by its path."""
    paths = [*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/*.py")]
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted(paths)}


def test_files_stay_small() -> None:
    """Stages only read, call and write: 120 lines are enough; a library file has at most 400."""
    ceiling = {"stages": 120, "pipeline": 400}
    long = {
        path for path, text in _sources().items() if text.count("\n") > ceiling[path.split("/")[0]]
    }
    assert not long


def test_functions_stay_short() -> None:
    """At most 50 lines, not counting what the docstring says."""
    long = set()
    for path, text in _sources().items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                first = node.body[0]
                told = first.end_lineno - first.lineno + 1 if ast.get_docstring(node) else 0
                if node.end_lineno - node.lineno + 1 - told > 50:
                    long.add(f"{path}:{node.name}")
    assert not long


def test_png_can_be_written_after_the_sfm_library_is_loaded() -> None:
    """pycolmap exports a zlib of its own; loaded before the system's, it makes PNG writers abort."""
    program = (
        "import pipeline, pycolmap, cv2, numpy as np;"
        "assert cv2.imencode('.png', np.zeros((64, 64, 3), np.uint8))[0]"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
