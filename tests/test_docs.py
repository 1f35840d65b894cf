"""The guides quote messages that the code really says, and link to files that exist."""

from __future__ import annotations

import ast
import importlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs/troubleshooting.md"


def _texts() -> str:
    """All string literals of the code, adjacent ones joined, with … for what is filled in."""
    found = []
    for path in [*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [p.value if isinstance(p, ast.Constant) else "…" for p in node.values]
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def _quoted() -> list[str]:
    lines = GUIDE.read_text(encoding="utf-8").splitlines()
    return [line.removeprefix("### ") for line in lines if line.startswith("### ")]


@pytest.mark.parametrize("message", _quoted())
def test_quoted_messages_stand_in_the_code(message: str) -> None:
    texts = re.sub(r"%[.\d]*[sdf]", "…", _texts())
    pieces = [piece.strip() for piece in message.split("…") if len(piece.strip()) > 1]
    assert pieces, message
    pattern = r"[^\n]*".join(re.escape(piece) for piece in pieces)
    assert re.search(pattern, texts), f"no message reads: {message}"


PAGES = [
    path
    for pattern in ("*.md", "docs/**/*.md", "weights/**/*.md", "experiments/*/*.md")
    for path in sorted(ROOT.glob(pattern))
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_and_parameters_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for module in re.findall(
        r"python -m ((?:stages|pipeline|experiments|benchmarks)[.\w]*\w)", text
    ):
        assert module == "stages" or (ROOT / f"{module.replace('.', '/')}.py").is_file(), module
    for section, key in re.findall(r"`([a-z_]+)\.([a-z_0-9]+)(?:: [^`]*)?`", text):
        if (ROOT / f"stages/{section}.py").is_file() and key not in ("json", "py", "csv", "yaml"):
            fields = importlib.import_module(f"stages.{section}").Params.model_fields
            assert key in fields, f"{section}.{key}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(
        r"\]\(([^)#:]*)#?([^):]*)\)", page.read_text(encoding="utf-8")
    ):
        other = page.parent / target if target else page
        assert other.exists(), f"{page.name} links to {target}"
        assert not anchor or anchor in _anchors(other), f"{page.name} links to {target}#{anchor}"


def _anchors(page: Path) -> set[str]:
    """What a page's headings are called in addresses."""
    lines = page.read_text(encoding="utf-8").splitlines()
    heads = [line.lstrip("#").strip().lower() for line in lines if line.startswith("#")]
    return {re.sub(r"[^\w -]", "", head).replace(" ", "-") for head in heads}


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_one_command_brings_photos_in_and_makes_everything_of_them() -> None:
    def recipes(*words: str) -> str:
        told = ["make", "--dry-run", "--no-print-directory", "scene", "SCENE=garden", *words]
        return subprocess.run(told, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    own = recipes("FROM=/my photos")
    brought = own.index('python -m stages.ingest --scene garden --from "/my photos"')
    assert brought < own.index("dvc repro report@garden") < own.index("garden/views/composite")
    assert "stages.ingest" not in recipes()
    assert "make scene SCENE=garden FROM=" in (ROOT / "README.md").read_text(encoding="utf-8")
