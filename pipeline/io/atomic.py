"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.io.shapes import Shape, misfit

# Of places rather than of programs: who looks at the file or folder that is named can mend it.
_PLACES = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG,
    errno.ELOOP,
)  # fmt: skip


def _disk_error(error: OSError, path: Path) -> UserError | None:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(
            f"{path}: the disk is full.",
            "Free some space and run again; older results are untouched.",
        )
    if error.errno in _PLACES:
        place = (
            Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else path
        )
        what = f"{place}: cannot be read ({error.strerror})."
        if place.is_relative_to(path.parent) or path.is_relative_to(place):
            what = f"{place}: cannot be written ({error.strerror})."
        return UserError(what, "Check its permissions, kind and name.")
    return None


def place_fault(error: BaseException | None, folder: Path) -> UserError | None:
    """The fault of a file or folder that may not be read or written, behind `error`; None for others.

    What lies beside `folder` is written by its stage, everything else is read.
    """
    while error is not None:
        if isinstance(error, OSError) and (fault := _disk_error(error, folder)):
            return fault
        error = error.__cause__ or error.__context__
    return None


def disk_fault(folder: Path) -> UserError | None:
    """The fault of a disk that takes nothing more into `folder`, found by trying; None when it does.

    Libraries written in other languages tell a full disk in their own ways, or not at all.
    """
    probe = folder / f".probe.tmp-{os.getpid()}"
    try:
        with probe.open("wb") as file:
            file.write(bytes(1 << 16))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return _disk_error(error, folder)
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


@contextmanager
def disk_faults(path: Path) -> Iterator[None]:
    """Turns a full or read-only disk met while writing `path` into a UserError."""
    try:
        yield
    except OSError as error:
        fault = _disk_error(error, path)
        if fault is None:
            raise
        raise fault from error


@contextmanager
def publish_dir(final: Path) -> Iterator[Path]:
    """Yields a fresh folder beside `final`; on success it takes that name, on failure it is gone.

    Leftovers of killed runs are cleared at the start. Whatever stood at `final` stays there until the
    new folder is complete.
    """
    with disk_faults(final):
        final.parent.mkdir(parents=True, exist_ok=True)
        for leftover in final.parent.glob(f".{final.name}.tmp-*"):
            shutil.rmtree(leftover, ignore_errors=True)
        # A name never used before: workers that live on remember files by their paths, and in
        # containers every run may have the same process id.
        fresh = final.parent / f".{final.name}.tmp-{os.getpid()}-{os.urandom(4).hex()}"
        fresh.mkdir()
        try:
            yield fresh
            _swap(fresh, final)
        except UserError:
            raise
        except Exception as error:
            fault = disk_fault(fresh)  # now: once the folder is gone, there is room again
            if fault is None:
                raise
            raise fault from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _swap(fresh: Path, final: Path) -> None:
    """Two renames, so that the old result survives until the new one can take its place."""
    if not final.exists():
        fresh.replace(final)
        return
    old = final.parent / f".{final.name}.tmp-old-{os.getpid()}"
    final.replace(old)
    fresh.replace(final)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _fresh(path: Path) -> Iterator[Path]:
    """Yields a name beside `path`; the file of that name is gone afterwards if not renamed."""
    with disk_faults(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.parent / f".{path.name}.tmp-{os.getpid()}"
        try:
            yield fresh
        finally:
            fresh.unlink(missing_ok=True)


@contextmanager
def _beside(path: Path, data: bytes) -> Iterator[Path]:
    """Yields a file beside `path` that holds `data`, flushed to disk; it is gone afterwards if not renamed."""
    with _fresh(path) as fresh:
        with fresh.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield fresh


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a name beside `path` to write to; the file is then flushed to disk and renamed to `path`."""
    with _fresh(path) as fresh:
        yield fresh
        with fresh.open("rb+") as file:
            os.fsync(file.fileno())
        fresh.replace(path)


def clear_torn(path: Path) -> None:
    """What writers of `path` that were killed left beside it is gone; nobody else may be writing it."""
    for torn in path.parent.glob(f".{path.name}.tmp-*"):
        torn.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path`: beside it first, flushed to disk, then renamed."""
    with _beside(path, data) as fresh:
        fresh.replace(path)


def link_or_copy(source: Path, target: Path) -> None:
    """Gives the file `source` a second name, or a copy where the disk knows no links."""
    with disk_faults(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            target.hardlink_to(source)
        except (OSError, NotImplementedError):
            shutil.copyfile(source, target)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 `text` to `path`, whole or not at all."""
    write_bytes(path, text.encode())


def write_with_json(path: Path, text: str, json_path: Path, content: Any) -> None:
    """Writes UTF-8 `text` and a JSON that belong together: where the JSON is, the text is of the same run.

    A kill may leave both old, both new, or no JSON.
    """
    with (
        _beside(path, text.encode()) as fresh,
        _beside(json_path, _as_json(content).encode()) as fresh_json,
    ):
        json_path.unlink(missing_ok=True)
        fresh.replace(path)
        fresh_json.replace(json_path)


def write_npy(path: Path, values: np.ndarray) -> None:
    """Writes an array as .npy; same values, same bytes."""
    file = io.BytesIO()
    np.save(file, values, allow_pickle=False)
    write_bytes(path, file.getvalue())


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[float | str]]) -> None:
    """Writes rows under the names of their columns."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_text(path, text.getvalue())


def write_json(path: Path, content: Any) -> None:
    """Writes `content` as JSON with sorted keys; raises ValueError on NaN or infinity."""
    write_text(path, _as_json(content))


def _as_json(content: Any) -> str:
    return json.dumps(content, indent=2, sort_keys=True, allow_nan=False) + "\n"


def read_json(path: Path, made_by: str = "", shape: Shape = dict[str, Any]) -> dict[str, Any]:
    """The object in a JSON file, of a `shape` (see `pipeline.io.shapes`).

    UserError when it is missing, damaged or of another shape, naming the stage that makes it.
    """
    hint = f"Run `python -m stages.{made_by}` first." if made_by else "Restore the file."
    again = hint.replace("first", "again")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))  # some editors put a mark first
    except FileNotFoundError:
        raise UserError(f"{path} does not exist.", hint) from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}).", again) from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is damaged: {error}.", again) from None
    if not isinstance(content, dict):
        raise UserError(f"{path} is damaged: it holds a {type(content).__name__}.", again)
    if fault := misfit(content, shape):
        raise UserError(f"{path} is damaged: {fault}.", again)
    return content


def read_npy(path: Path) -> np.ndarray:
    """The array in a .npy file; UserError when it is damaged or holds Python objects."""
    try:
        found = np.load(path, allow_pickle=False)
        if not isinstance(found, np.ndarray):  # an archive of several
            found.close()
            raise ValueError("it holds several arrays, as numpy.savez writes them")
        return found
    except Exception as error:  # what a damaged header or archive raises has no common kind
        raise UserError(
            f"{path} is not a readable array ({error}).", "Save it anew with numpy.save."
        ) from None
