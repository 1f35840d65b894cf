"""Scripts beside the chain, which no other test runs: what they use of the project exists."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from types import ModuleType

import pytest

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
