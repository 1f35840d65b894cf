from __future__ import annotations

import errno
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.io.atomic import (
    disk_faults,
    place_fault,
    publish_dir,
    read_json,
    write_bytes,
    write_json,
    write_with_json,
)


def test_a_published_folder_replaces_the_old_one_whole(tmp_path: Path) -> None:
    final = tmp_path / "masks"
    final.mkdir()
    (final / "stale.png").write_bytes(b"old")
    with publish_dir(final) as fresh:
        (fresh / "new.png").write_bytes(b"new")
        assert (final / "stale.png").exists(), "the old result stands until the new one is complete"
    assert [path.name for path in final.iterdir()] == ["new.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["masks"], "no temporary folder is left"


def test_a_failure_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    final = tmp_path / "masks"
    final.mkdir()
    (final / "old.png").write_bytes(b"old")
    with pytest.raises(RuntimeError), publish_dir(final) as fresh:
        (fresh / "half.png").write_bytes(b"half")
        raise RuntimeError("killed")
    assert [path.name for path in final.iterdir()] == ["old.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["masks"]


def test_leftovers_of_a_killed_run_are_cleared(tmp_path: Path) -> None:
    (tmp_path / ".masks.tmp-12345").mkdir()
    with publish_dir(tmp_path / "masks"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["masks"]


def test_a_folder_is_written_under_another_name_each_time(tmp_path: Path) -> None:
    """By one process too: a worker that lives on must not take new files for those it remembers."""
    names = set()
    for _ in range(3):
        with publish_dir(tmp_path / "views") as fresh:
            names.add(fresh.name)
    assert len(names) == 3


def test_a_file_appears_whole(tmp_path: Path) -> None:
    write_bytes(tmp_path / "deep" / "a.bin", b"abc")
    assert (tmp_path / "deep" / "a.bin").read_bytes() == b"abc"
    assert len(list((tmp_path / "deep").iterdir())) == 1


def test_a_full_disk_is_a_sentence() -> None:
    with pytest.raises(UserError, match="the disk is full"), disk_faults(Path("x")):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_json_keeps_no_nan_and_names_the_stage_to_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert not (tmp_path / "a.json").exists()
    with pytest.raises(UserError, match=r"stages\.poses"):
        read_json(tmp_path / "a.json", made_by="poses")
    for damaged in ('{"cut": ', "[1, 2]", "3", "[" * 100_000):
        (tmp_path / "a.json").write_text(damaged)
        with pytest.raises(UserError, match="damaged"):
            read_json(tmp_path / "a.json", made_by="poses")
    (tmp_path / "b.json").mkdir()
    with pytest.raises(UserError, match=r"b\.json cannot be read"):
        read_json(tmp_path / "b.json")


def test_json_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"w": 3}')
    assert read_json(tmp_path / "a.json") == {"w": 3}


def test_what_may_not_be_read_is_not_called_unwritable(tmp_path: Path) -> None:
    """The source of a copy into a folder that is being written."""
    source = tmp_path / "photos" / "a.jpg"
    told = pytest.raises(UserError, match=r"a\.jpg: cannot be read \(Permission denied\)")
    with told, publish_dir(tmp_path / "data" / "scene"):
        raise PermissionError(errno.EACCES, "Permission denied", str(source))
    behind = RuntimeError("copying failed")
    behind.__cause__ = PermissionError(errno.EACCES, "Permission denied", str(source))
    fault = place_fault(behind, tmp_path / "data" / "scene")
    assert fault is not None and "cannot be read" in fault.what
    assert place_fault(RuntimeError("a defect"), tmp_path) is None
    assert place_fault(FileNotFoundError(errno.ENOENT, "none", "a"), tmp_path) is None


def test_a_folder_above_that_takes_nothing_is_called_unwritable() -> None:
    told = pytest.raises(UserError, match=r"/a: cannot be written \(Read-only file system\)")
    with told, disk_faults(Path("/a/b/c/d")):
        raise OSError(errno.EROFS, "Read-only file system", "/a")


class Killed(BaseException):
    """What nothing catches."""


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_a_text_and_its_json_are_of_one_run_wherever_it_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: int
) -> None:
    text, about = tmp_path / "metrics.csv", tmp_path / "metrics.json"
    write_with_json(text, "old", about, {"run": "old"})
    real, done = Path.replace, []

    def replace(self: Path, target: Path) -> Path:
        if len(done) == renames:
            raise Killed
        done.append(target)
        return real(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", replace)
        if renames < 2:
            with pytest.raises(Killed):
                write_with_json(text, "new", about, {"run": "new"})
        else:
            write_with_json(text, "new", about, {"run": "new"})
    assert not about.exists() or read_json(about)["run"] == text.read_text()
    write_with_json(text, "new", about, {"run": "new"})
    assert (text.read_text(), read_json(about)) == ("new", {"run": "new"})
    assert len(list(tmp_path.iterdir())) == 2


def test_a_json_that_cannot_be_written_leaves_both_files_as_they_were(tmp_path: Path) -> None:
    text, about = tmp_path / "metrics.csv", tmp_path / "metrics.json"
    write_with_json(text, "old", about, {"run": "old"})
    with pytest.raises(ValueError):
        write_with_json(text, "new", about, {"run": float("nan")})
    assert (text.read_text(), read_json(about)) == ("old", {"run": "old"})
    assert len(list(tmp_path.iterdir())) == 2
