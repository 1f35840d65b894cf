"""A training goes on from its checkpoint only while it starts and learns from the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.io.checkpoints import load_checkpoint, save_checkpoint, training_key


def test_a_training_is_named_by_what_it_starts_and_learns_from(tmp_path: Path) -> None:
    weights, pictures = tmp_path / "w.safetensors", tmp_path / "pictures"
    (pictures / "rainy").mkdir(parents=True)
    weights.write_bytes(b"w")
    (pictures / "rainy/0.png").write_bytes(b"a")
    (pictures / "rainy/1.png").write_bytes(b"b")

    def key(code: str = "drops", **told: int) -> str:
        return training_key({"seed": 0} | told, [weights, pictures], code)

    first = key()
    pictures = pictures.rename(tmp_path / "elsewhere")
    assert key() == first != key(seed=1)
    seen = {first, key(code="attention")}
    (pictures / "rainy/1.png").write_bytes(b"c")
    seen.add(key())
    (pictures / "rainy/1.png").rename(pictures / "rainy/2.png")
    seen.add(key())
    weights.write_bytes(b"x")
    seen.add(key())
    weights.unlink()
    seen.add(key())
    assert len(seen) == 6


class _Counter:
    """A training that counts its steps."""

    done = 0

    def state(self) -> dict[str, Any]:
        return {"done": self.done}

    def restore(self, state: dict[str, Any]) -> None:
        self.done = state["done"]


def test_a_damaged_checkpoint_counts_as_none(tmp_path: Path) -> None:
    file, trainer = tmp_path / "c.pt", _Counter()
    trainer.done = 7
    save_checkpoint(file, trainer, [["a", 1.0]])
    whole = file.read_bytes()
    assert load_checkpoint(file, again := _Counter()) == [["a", 1.0]] and again.done == 7
    for content in (whole[: len(whole) // 2], b"", b"rain", whole.replace(b"trainer", b"drainer")):
        file.write_bytes(content)
        assert load_checkpoint(file, again := _Counter()) == [] and again.done == 0
