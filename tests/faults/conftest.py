from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.faults.workshop import CHAIN, Workshop, bare


@pytest.fixture(scope="session")
def _bare(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return bare(tmp_path_factory.mktemp("faults") / "bare")


@pytest.fixture(scope="session")
def _full(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    full = bare(tmp_path_factory.mktemp("faults") / "full")
    for stage in CHAIN:
        done = full.run(stage)
        assert done.code == 0, done.said
    return full


@pytest.fixture
def photos(_bare: Workshop, tmp_path: Path) -> Workshop:
    """A scene with photos and no artifacts."""
    return Workshop(shutil.copytree(_bare.root, tmp_path / "project"))


@pytest.fixture
def whole(_full: Workshop, tmp_path: Path) -> Workshop:
    """A scene with every artifact."""
    return Workshop(shutil.copytree(_full.root, tmp_path / "project"))
