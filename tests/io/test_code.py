"""What hangs on the project's code is begun anew when that changes."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.io import code
from pipeline.io.code import code_key


def test_a_change_of_the_code_gives_another_key_and_nothing_else_does(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(code, "PIPELINE", tmp_path)
    (tmp_path / "room/inner").mkdir(parents=True)
    for name in ("room/a.py", "room/inner/b.py", "other.py"):
        (tmp_path / name).write_text("x = 1\n")
    first = code_key("room", "other.py")
    (tmp_path / "room/__pycache__").mkdir()
    (tmp_path / "room/__pycache__/a.pyc").write_bytes(b"compiled")
    (tmp_path / "beside.py").write_text("")
    assert code_key("room", "other.py") == first
    seen = {first, code_key("room")}
    (tmp_path / "other.py").write_text("x = 2\n")
    seen.add(code_key("room", "other.py"))
    (tmp_path / "room/inner/b.py").rename(tmp_path / "room/inner/c.py")
    seen.add(code_key("room"))
    assert len(seen) == 4


def test_a_place_without_code_is_no_key() -> None:
    for place in ("nowhere", "nowhere.py"):
        with pytest.raises(FileNotFoundError):
            code_key(place)


def test_the_rooms_that_stages_name_are_there() -> None:
    assert code_key("attention", "drops", "removal") != code_key("attention", "drops")
