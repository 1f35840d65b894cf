"""How much memory this process may still take: the machine's, or what its container leaves of it."""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil

from pipeline.errors import UserError

GROUPS = Path("/sys/fs/cgroup")
OWN_GROUP = Path("/proc/self/cgroup")
V2 = ("memory.max", "memory.current", "inactive_file")
V1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def free_memory(groups: Path = GROUPS, own: Path = OWN_GROUP) -> int:
    """Bytes, swap included, that can be taken before the system ends this process.

    The machine's, or less where a control group (a container, a batch job, a systemd slice) sets a limit:
    Linux, versions 2 and 1, at `groups`; `own` is the file that tells the process's place there. What a
    group holds of files and can drop again counts as free.
    """
    swap = psutil.swap_memory().free
    rooms = [psutil.virtual_memory().available + swap]
    for folder, names in _limiting(groups, own):
        limit, held = (_number(folder / name) for name in names[:2])
        if limit is None or held is None:
            continue
        droppable = _stat(folder / "memory.stat", names[2])
        rooms.append(limit - held + droppable + _swap(folder, swap))
        both, held_both = (
            _number(folder / f"memory.memsw.{kind}_in_bytes") for kind in ("limit", "usage")
        )
        if both is not None and held_both is not None:
            rooms.append(both - held_both + droppable)
    return max(0, min(rooms))


@functools.cache
def keep_memory() -> None:
    """What is freed stays with this process: a step of a fit takes and frees some 100 MB.

    By default glibc gives large pieces back, and the kernel clears every page when it is next touched, which
    took a seventh of a step (``mallopt(3)``). Other libraries of C are left as they are.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        trim_threshold, mmap_max = -1, -4  # malloc.h
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)


def refuse_without_room(needed: float, what: str, hint: str) -> None:
    """UserError when fewer bytes are free than `what` (in the plural) need: the system would end it unasked."""
    free = free_memory()
    if needed > free:
        raise UserError(
            f"{what} need about {needed / 1e9:.1f} GB of memory; {free / 1e9:.1f} GB are free.",
            hint,
        )


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether a request for memory that was refused stands behind `error`: Python's, OpenCV's or torch's."""
    told = ("not enough memory", "can't allocate memory", "Failed to allocate", "bad_alloc")
    while error is not None:
        if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
            return True
        if any(words in str(error) for words in told):
            return True
        error = error.__cause__ or error.__context__
    return False


def memory_fault(error: BaseException) -> UserError | None:
    """The sentence for memory that ran out, behind `error`; None for other faults."""
    if not is_out_of_memory(error):
        return None
    if "CUDA" in str(error):
        return UserError(
            "The GPU has not enough memory.",
            "End what else runs on it, lower ingest.max_size, or compute on the processor: --device cpu.",
        )
    return UserError(
        "There was not enough memory.",
        "Lower ingest.max_size or ingest.frames, end other programs, or raise the container's limit.",
    )


def _limiting(groups: Path, own: Path) -> Iterator[tuple[Path, tuple[str, str, str]]]:
    """The folders of the process's groups, up to the outermost, with the names of their files."""
    for line in _text(own).splitlines():
        _, kinds, place = line.split(":", 2)
        if kinds == "":
            root, names = groups, V2
        elif "memory" in kinds.split(","):
            root, names = groups / "memory", V1
        else:
            continue
        # Seen from inside a container the place may not exist: its own group is then the root.
        folder = root / place.lstrip("/")
        yield from ((one, names) for one in (folder, *folder.parents) if one.is_relative_to(root))


def _swap(folder: Path, free: int) -> int:
    """How much of the machine's free swap a group may use; version 1 limits the sum instead."""
    limit, held = _number(folder / "memory.swap.max"), _number(folder / "memory.swap.current")
    return free if limit is None or held is None else max(0, min(free, limit - held))


def _number(file: Path) -> int | None:
    """The number in a file; None where there is none, or "max"."""
    text = _text(file).strip()
    return int(text) if text.isdigit() else None


def _stat(file: Path, name: str) -> int:
    found = dict(line.split(" ", 1) for line in _text(file).splitlines() if " " in line)
    return int(found.get(name, 0))


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
