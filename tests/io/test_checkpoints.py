"""A training goes on from its checkpoint only while it starts and learns from the same."""

from __future__ import annotations

from pathlib import Path

from pipeline.io.checkpoints import training_key


def test_a_training_is_named_by_what_it_starts_and_learns_from(tmp_path: Path) -> None:
    weights, pictures = tmp_path / "w.safetensors", tmp_path / "pictures"
    (pictures / "rainy").mkdir(parents=True)
    weights.write_bytes(b"w")
    (pictures / "rainy/0.png").write_bytes(b"a")
    (pictures / "rainy/1.png").write_bytes(b"b")

    def key(**told: int) -> str:
        return training_key({"seed": 0} | told, weights, pictures)

    first = key()
    pictures = pictures.rename(tmp_path / "elsewhere")
    assert key() == first != key(seed=1)
    seen = {first}
    (pictures / "rainy/1.png").write_bytes(b"c")
    seen.add(key())
    (pictures / "rainy/1.png").rename(pictures / "rainy/2.png")
    seen.add(key())
    weights.write_bytes(b"x")
    seen.add(key())
    weights.unlink()
    seen.add(key())
    assert len(seen) == 5
