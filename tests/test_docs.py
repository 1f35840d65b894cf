"""The guides quote messages that the code really says, and link to files that exist."""

from __future__ import annotations

import ast
import re
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


@pytest.mark.parametrize("page", [*sorted(ROOT.glob("docs/*.md")), ROOT / "README.md"])
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
