"""Rendered pairs to train on: a folder holds those of one recipe."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from experiments import drops_training

WORDS = ["--seeds", "100", "102", "--views", "2", "--spp", "36"]


def render(monkeypatch: pytest.MonkeyPatch, out: Path, *words: str) -> int:
    """How the command ends; 1 where it would have rendered."""
    monkeypatch.setattr(sys, "argv", ["drops_training", str(out), *words])
    monkeypatch.setattr(drops_training.places, "build", lambda *_: sys.exit(1))
    try:
        drops_training.main()
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code
    return 0


def fill(out: Path, count: int) -> None:
    for folder in drops_training.FOLDERS:
        (out / folder).mkdir(parents=True, exist_ok=True)
        for k in range(count):
            (out / folder / f"{k:03d}.png").write_bytes(b"a picture")


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (["--seeds", "110", "112", "--views", "2", "--spp", "36"], "seeds [100, 102]"),
        ([*WORDS[:-1], "25"], "spp 36"),
        ([*WORDS, "--arm"], "arm False"),
    ],
)
def test_pictures_of_another_recipe_are_not_taken_for_these(
    other: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "rendered"
    assert render(monkeypatch, out, *WORDS) == 1
    assert json.loads((out / "recipe.json").read_text())["seeds"] == [100, 102]
    assert render(monkeypatch, out, *WORDS) == 1  # goes on
    fill(out, 4)
    assert render(monkeypatch, out, *WORDS) == 0
    assert render(monkeypatch, out, *other) == 2
    assert f"holds pictures of another recipe: {told}." in capsys.readouterr().err


def test_a_folder_of_before_passes_when_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path, 4)
    assert render(monkeypatch, tmp_path, *WORDS) == 0
    assert not (tmp_path / "recipe.json").exists()  # nobody knows of which it is
    (tmp_path / "rainy/003.png").unlink()
    assert render(monkeypatch, tmp_path, *WORDS) == 2
    assert "does not say of which recipe" in capsys.readouterr().err
