"""The stage train_remover: weights that restore loads, and a curve; the same when it was interrupted."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipeline.attention import pools
from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.weights import save_network
from pipeline.io.images import write_image
from pipeline.io.tensors import load_tensors
from pipeline.removal.recipes import Added
from pipeline.removal.training import Phase, Plan
from pipeline.stage import Job
from stages import restore, train_remover
from stages.train_remover import Params, main

PLAN = Plan((0.9, 0.99), 0.0, 1e-4, [Phase("pairs", n, 1, 32, 1e-3, None) for n in (2, 1)])
PARAMS = Params(
    folder="w",
    seed=5,
    photos="photos",
    painted=4,
    clips=2,
    rendered=["rendered"],
    photo_pairs=["pairs"],
    shares=(0.5, 0.5, 0.5),
    validation=2,
    validation_photos="",
    validate_every=2,
    bfloat16=False,
    on_device=False,
    perceptual="",
    attention="attention.safetensors",
    train_attention=False,
    attention_steps=1,
    published_edges=True,
    single_share=0.1,
    added=Added(),
    attgan=PLAN,
    quan=PLAN,
    wen=PLAN,
)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folders of every kind of picture; painting makes four small ones instead of a hundred."""
    rng = np.random.default_rng(1)
    write_image(tmp_path / "photos/a.png", rng.integers(0, 256, (80, 90, 3), dtype=np.uint8))
    dry = rng.integers(60, 200, (48, 64, 3), dtype=np.uint8)
    cover = np.zeros((48, 64, 3), np.uint8)
    cover[10:30, 20:40] = 255
    wet = np.where(cover > 0, 255 - dry, dry).astype(np.uint8)
    for kind, picture in (("rainy", wet), ("clean", dry), ("coverage", cover)):
        write_image(tmp_path / f"rendered/{kind}/0.png", picture)
    write_image(tmp_path / "pairs/data/0_rain.png", wet)
    write_image(tmp_path / "pairs/gt/0_clean.png", dry)
    attention = AttentiveRecurrentNet()
    attention.initialise(0)
    save_network(tmp_path / "attention.safetensors", attention)
    monkeypatch.setattr(pools, "CHUNK", 4)
    monkeypatch.setattr(pools, "SIZE", 48)
    return tmp_path


def test_variants_share_what_was_painted(root: Path) -> None:
    """Each would paint thousands of the same pictures again."""
    for variant in (None, "gpu"):
        job = Job(root, "made", variant, "cpu", None, False)
        train_remover._painted(job, pools, "photos", 5, 4)
    assert len(list(root.rglob("*.npy"))) == 1


def test_weights_and_curve_and_the_same_after_an_interruption(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job(root, "made", None, "cpu", None, False)
    train = partial(main, {"method": "attgan"}, job, PARAMS)
    fit = train_remover.fit

    def stopped(trainer, every, validation, on_score):
        def once(*found):
            on_score(*found)
            raise KeyboardInterrupt

        return fit(trainer, every, validation, once)

    monkeypatch.setattr(train_remover, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        train()
    assert not (root / "w").exists()
    monkeypatch.setattr(train_remover, "fit", fit)
    train()
    target = root / "w/attgan.safetensors"
    resumed = target.read_bytes(), target.with_suffix(".csv").read_text()
    for checkpoint in job.paths.work("train_remover").glob("*.pt"):
        checkpoint.unlink()
    closing = train()
    assert (target.read_bytes(), target.with_suffix(".csv").read_text()) == resumed

    rows = list(csv.DictReader(resumed[1].splitlines()))
    assert [(row["iteration"], row["set"]) for row in rows] == [("2", "painted"), ("3", "painted")]
    assert closing.startswith(f"attgan.safetensors: {float(rows[-1]['psnr_rainy'])} -> ")
    assert {value.dtype for value in load_tensors(target)[0].values()} == {np.dtype(np.float16)}
    attention, autoencoder = restore.networks_of("attgan", target, "", "cpu")
    count = [sum(value.numel() for value in part.parameters()) for part in (attention, autoencoder)]
    assert sum(count) == 6_244_362

    write_image(root / "pairs/data/0_rain.png", np.full((48, 64, 3), 90, np.uint8))
    monkeypatch.setattr(train_remover, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        train()  # other pictures: from the start, not from the training that has ended
