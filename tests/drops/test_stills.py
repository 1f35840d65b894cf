"""Photographs to paint on are read once, and what is painted is named by seed and content."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from pipeline.drops import stills
from pipeline.io.images import write_image


def test_names_depend_on_seed_and_content_and_on_no_folder(tmp_path: Path) -> None:
    grey = np.full((4, 5, 3), 90, np.uint8)
    for name in ("one/a.png", "two/b.png"):
        write_image(tmp_path / name, grey)
    write_image(tmp_path / "two/c.png", grey + 1)
    first, same, other = (tmp_path / name for name in ("one/a.png", "two/b.png", "two/c.png"))
    named = partial(stills.painted_name, painter="removal/clips.py")
    assert named("clips", 3, [first]) == named("clips", 3, [same])
    names = {
        named("clips", 3, [first]),
        named("clips", 4, [first]),
        named("clips", 3, [other]),
        named("clips", 3, []),
        named("painted", 3, [first]),
        named("clips", 3, [first], painter="attention/pools.py"),
    }
    assert len(names) == 6
    assert all(name.startswith(("clips-", "painted-")) for name in names)


def test_stills_are_shrunk_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "wide.png"
    write_image(path, np.full((10, 2 * stills.LONGEST, 3), 90, np.uint8))
    found = stills.still(path)
    assert found.shape == (5, stills.LONGEST, 3) and (found == 90).all()
    path.unlink()
    assert stills.still(path) is found
