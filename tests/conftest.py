"""The small scene with every artifact, made once for all tests that break or repeat a part of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.faults.workshop import CHAIN, Workshop, bare


@pytest.fixture(scope="session")
def bare_scene(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return bare(tmp_path_factory.mktemp("scene") / "bare")


@pytest.fixture(scope="session")
def whole_scene(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    full = bare(tmp_path_factory.mktemp("scene") / "full")
    for stage in CHAIN:
        done = full.run(stage)
        assert done.code == 0, done.said
    return full


@pytest.fixture
def photos(bare_scene: Workshop, tmp_path: Path) -> Workshop:
    """A scene with photos and no artifacts."""
    return Workshop(shutil.copytree(bare_scene.root, tmp_path / "project"))


@pytest.fixture
def whole(whole_scene: Workshop, tmp_path: Path) -> Workshop:
    """A scene with every artifact."""
    return Workshop(shutil.copytree(whole_scene.root, tmp_path / "project"))
