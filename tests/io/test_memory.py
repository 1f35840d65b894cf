"""Free memory as control groups of both versions limit it; the machine has 100 bytes and 10 of swap."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
import torch

from pipeline.io.memory import free_memory, is_out_of_memory, memory_fault


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=100))
    monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(free=10))


def _group(folder: Path, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / f"memory.{name.replace('__', '.')}").write_text(f"{content}\n")


def _free(root: Path, own: str) -> int:
    (root / "own").write_text(own)
    return free_memory(root / "groups", root / "own")


def test_without_groups_it_is_the_machines(tmp_path: Path) -> None:
    assert free_memory(tmp_path / "absent", tmp_path / "absent") == 110


def test_version_2(tmp_path: Path) -> None:
    """60 allowed, 50 held, 20 of that files: 30 free, and 4 of swap."""
    own = tmp_path / "groups/job"
    _group(own, max=60, current=50, swap__max=5, swap__current=1, stat="anon 30\ninactive_file 20")
    assert _free(tmp_path, "0::/job\n") == 34
    _group(own, swap__max="max")
    assert _free(tmp_path, "0::/job\n") == 40
    _group(own, max="max")
    assert _free(tmp_path, "0::/job\n") == 110


def test_version_1(tmp_path: Path) -> None:
    """60 allowed, 50 held, 20 of that files: 30 free; with swap 66 less 54: 32."""
    own = tmp_path / "groups/memory/job"
    stat = "inactive_file 1\ntotal_inactive_file 20"
    _group(own, limit_in_bytes=60, usage_in_bytes=50, stat=stat)
    lines = "3:cpuset:/\n4:hugetlb,memory:/job\n0::/\n"
    assert _free(tmp_path, lines) == 40
    _group(own, memsw__limit_in_bytes=66, memsw__usage_in_bytes=54)
    assert _free(tmp_path, lines) == 32
    _group(own, limit_in_bytes=2**63 - 4096, memsw__limit_in_bytes=2**63 - 4096)
    assert _free(tmp_path, lines) == 110


def test_the_tightest_of_the_groups_around_counts(tmp_path: Path) -> None:
    _group(tmp_path / "groups/slice", max=40, current=10, swap__max=0, swap__current=0)
    _group(tmp_path / "groups/slice/job", max=90, current=10, swap__max=0, swap__current=0)
    assert _free(tmp_path, "0::/slice/job\n") == 30


def test_a_place_that_only_the_host_sees(tmp_path: Path) -> None:
    """In a container without a namespace of its own the files of its group lie at the root."""
    _group(tmp_path / "groups/memory", limit_in_bytes=40, usage_in_bytes=10)
    assert _free(tmp_path, "4:memory:/docker/0123abc\n") == 40


def test_more_held_than_allowed_is_nothing_free(tmp_path: Path) -> None:
    _group(tmp_path / "groups", max=40, current=60, swap__max=0, swap__current=0)
    assert _free(tmp_path, "0::/\n") == 0


@pytest.mark.parametrize("take", [lambda: torch.empty(2**50), lambda: np.empty(2**50)])
def test_memory_that_is_not_there_is_known_behind_other_errors(take: Any) -> None:
    try:
        try:
            take()
        except Exception as error:
            raise RuntimeError("render failed on a.png") from error
    except RuntimeError as error:
        assert is_out_of_memory(error)
        fault = memory_fault(error)
    assert fault is not None and fault.what == "There was not enough memory."


def test_a_full_gpu_is_told_as_such_and_other_errors_are_not() -> None:
    full = memory_fault(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB."))
    assert full is not None and full.what.startswith("The GPU")
    assert memory_fault(RuntimeError("shapes do not match")) is None
