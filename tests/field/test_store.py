"""What a fit leaves on disk: the fitted field, and checkpoints that only the same fit takes up."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.errors import UserError
from pipeline.field import store
from pipeline.field.buffer import PosedPhoto
from pipeline.field.grid_field import GridConfig, GridField
from pipeline.field.store import Checkpoint, fit_key, load_field, save_field
from pipeline.geometry.spaces import Space

SPACE = Space("ndc", ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0)), 1.0, (-1.0, -1.0, 0.0),
              (1.0, 1.0, 1.0))  # fmt: skip
TINY = GridConfig(levels=1, features=2, table_log2=6, coarse=(3, 3, 3), fine=(4, 4, 4), hidden=4,
                  proposal=(3, 3, 3))  # fmt: skip


def photo(**changes: object) -> PosedPhoto:
    values = {
        "name": "a", "image": np.zeros((2, 3, 3), np.float32), "keep_mask": np.ones((2, 3), bool),
        "cam_from_world": np.eye(4), "intrinsics": (1.0, 1.0, 1.5, 1.0, 0.0), "near": 1.0,
        "far": 9.0,
    }  # fmt: skip
    return PosedPhoto(**(values | changes))  # type: ignore[arg-type]


def test_a_saved_field_comes_back_and_a_newer_one_replaces_it(tmp_path: Path) -> None:
    first, second = GridField(TINY, SPACE, 1), GridField(TINY, SPACE, 2)
    for field in (first, second):
        save_field(tmp_path, field, 1.0, 9.0, {"steps": 7})
        back = load_field(tmp_path, "cpu")
        assert (back.near, back.far) == (1.0, 9.0)
        for name, value in field.state_dict().items():
            assert torch.equal(back.field.state_dict()[name], value)
    assert not torch.equal(first.shape_in.weight, second.shape_in.weight)
    assert json.loads((tmp_path / "field.json").read_text())["steps"] == 7


def test_a_field_of_no_numbers_is_told(tmp_path: Path) -> None:
    field = GridField(TINY, SPACE, 1)
    with torch.no_grad():
        field.colour_out.bias[0] = float("nan")
    save_field(tmp_path, field, 1.0, 9.0, {})
    with pytest.raises(UserError, match="its numbers are not all finite"):
        load_field(tmp_path, "cpu")


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("bounds", "near"), -1.0),
        (("bounds", "far"), float("inf")),
        (("space", "kind"), "round"),
        (("space", "near"), 0),
        (("space", "high"), [1.0, -1.0, 1.0]),
        (("space", "low"), [-1.0, float("nan"), 0.0]),
        (("space", "ref_from_world"), [[1.0, 0, 0]] * 3),
        (("config", "fine"), [4]),
        (("config", "fine"), [4.5, 4.5, 4.5]),
    ],
)
def test_a_field_of_nowhere_is_told(tmp_path: Path, where: tuple[str, str], value: object) -> None:
    """Told when it is read, not as a division by zero in the middle of a view."""
    save_field(tmp_path, GridField(TINY, SPACE, 1), 1.0, 9.0, {})
    about = json.loads((tmp_path / "field.json").read_text())
    about[where[0]][where[1]] = value
    (tmp_path / "field.json").write_text(json.dumps(about))
    with pytest.raises(UserError, match=r"cannot be read back|tells no depths"):
        load_field(tmp_path, "cpu")


def test_a_missing_field_names_the_stage(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        load_field(tmp_path, "cpu")
    assert "stages.nerf" in caught.value.hint


def test_a_checkpoint_is_taken_up_by_its_own_fit_only(tmp_path: Path) -> None:
    file = tmp_path / "checkpoint.safetensors"
    mine = Checkpoint(file, "mine")
    assert mine.load() is None
    mine.save(5, {"x": torch.arange(3.0)})
    step, state = mine.load()
    assert step == 5 and state["x"].tolist() == [0.0, 1.0, 2.0]
    assert Checkpoint(file, "another's").load() is None
    file.write_bytes(file.read_bytes()[:20])
    assert mine.load() is None
    mine.remove()
    assert not file.exists()


@pytest.mark.parametrize(
    "changed",
    [
        {"image": np.full((2, 3, 3), 0.5, np.float32)},
        {"keep_mask": np.zeros((2, 3), bool)},
        {"cam_from_world": np.diag([1.0, -1.0, -1.0, 1.0])},
        {"intrinsics": (2.0, 1.0, 1.5, 1.0, 0.0)},
        {"far": 8.0},
    ],
)
def test_anything_that_decides_the_result_changes_the_key(changed: dict[str, object]) -> None:
    field = GridField(TINY, SPACE, 0)
    settings = {"steps": 10, "seed": 0}
    key = fit_key(field, [photo()], settings, "cpu")
    assert key == fit_key(GridField(TINY, SPACE, 3), [photo()], dict(settings), "cpu")
    assert key != fit_key(field, [photo(**changed)], settings, "cpu")
    assert key != fit_key(field, [photo()], settings | {"steps": 11}, "cpu")
    assert key != fit_key(field, [photo()], settings, "cuda")


def test_what_a_kill_left_of_a_save_is_gone_when_the_fit_begins_again(tmp_path: Path) -> None:
    checkpoint = Checkpoint(tmp_path / "checkpoint.safetensors", "key")
    checkpoint.save(3, {"x": torch.ones(2)})
    torn = tmp_path / ".checkpoint.safetensors.tmp-12345"
    torn.write_bytes(b"half")
    loaded = checkpoint.load()
    assert loaded is not None and loaded[0] == 3
    assert not torn.exists()


def test_a_fit_begins_anew_when_rays_are_made_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    field = GridField(TINY, SPACE, 1)
    before = fit_key(field, [photo()], {}, "cpu")
    assert before == fit_key(field, [photo()], {}, "cpu")
    known = store.code_key
    monkeypatch.setattr(
        store, "code_key", lambda *rooms: known(*rooms) + "2" * ("geometry" in rooms)
    )
    assert before != fit_key(field, [photo()], {}, "cpu")
