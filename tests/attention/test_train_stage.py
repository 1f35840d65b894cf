"""The stage train_detector: weights and curve, the same when it was interrupted."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline.attention import pools
from pipeline.attention.weights import DETECTORS, load_network, save_network
from pipeline.errors import UserError
from pipeline.io.images import write_image
from pipeline.stage import Job
from stages import train_detector
from stages.train_detector import Params, PhaseParams, main

PHASES = [PhaseParams(steps=1, iterations=n, batch=2, crop=32, rate=0.01) for n in (3, 1)]
PARAMS = Params(
    model="unet",
    weights="w/unet.safetensors",
    start="",
    target="coverage",
    seed=5,
    photos="photos",
    painted=100,
    veils=100,
    films=0,
    rendered=["rendered"],
    photo_pairs=["pairs"],
    shares=(0.5, 0.5, 0.5),
    clean_share=0.1,
    lures=0.5,
    validation=2,
    validation_photos="",
    validation_rendered=["rendered"],
    validate_every=2,
    bfloat16=False,
    on_device=False,
    phases=PHASES,
    average={},
)


def _disc(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    clean = rng.integers(60, 200, (48, 64, 3), dtype=np.uint8)
    cover = np.zeros((48, 64), np.uint8)
    cv2.circle(cover, (30, 20), 9, 255, -1)
    return np.where(cover[..., None] > 0, 255 - clean, clean).astype(np.uint8), clean, cover


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folders of every kind of picture; painting makes four small ones instead of a hundred."""
    rng = np.random.default_rng(1)
    write_image(tmp_path / "photos/a.png", rng.integers(0, 256, (80, 90, 3), dtype=np.uint8))
    for k in range(2):
        wet, dry, cover = _disc(rng)
        for kind, picture in (("rainy", wet), ("clean", dry), ("coverage", np.dstack([cover] * 3))):
            write_image(tmp_path / f"rendered/{kind}/{k}.png", picture)
        write_image(tmp_path / f"pairs/data/{k}_rain.png", wet)
        write_image(tmp_path / f"pairs/gt/{k}_clean.png", dry)
    monkeypatch.setattr(pools, "CHUNK", 4)
    monkeypatch.setattr(pools, "SIZE", 48)
    return tmp_path


def _result(root: Path) -> tuple[bytes, str]:
    weights = root / "w/unet.safetensors"
    return weights.read_bytes(), weights.with_suffix(".csv").read_text()


def test_weights_and_curve_and_the_same_after_an_interruption(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job(root, "made", None, "cpu", None, False)
    fit = train_detector.fit

    def stopped(trainer, every, validation, on_score):
        def once(*found):
            on_score(*found)
            raise KeyboardInterrupt

        return fit(trainer, every, validation, once)

    monkeypatch.setattr(train_detector, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        main(job, PARAMS)
    assert not (root / "w").exists()
    monkeypatch.setattr(train_detector, "fit", fit)
    main(job, PARAMS)
    resumed = _result(root)
    for checkpoint in job.paths.work("train_detector").glob("*.pt"):
        checkpoint.unlink()
    closing = main(job, PARAMS)
    assert _result(root) == resumed

    rows = list(csv.DictReader(resumed[1].splitlines()))
    assert [(row["iteration"], row["set"]) for row in rows] == [
        (done, name) for done in ("2", "3", "4") for name in ("rendered", "painted")
    ]
    assert (
        closing
        == f"unet.safetensors: best F1 {float(rows[-1]['f1'])} on painted pictures it was not trained on"
    )
    assert load_network(root / "w/unet.safetensors", "unet").reach() > 0

    write_image(root / "rendered/rainy/0.png", np.full((48, 64, 3), 90, np.uint8))
    monkeypatch.setattr(train_detector, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        main(job, PARAMS)  # other pictures: from the start, not from the training that has ended


def test_trained_weights_are_averaged_with_others_and_scored_anew(root: Path) -> None:
    job = Job(root, "made", None, "cpu", None, False)
    main(job, PARAMS)
    trained = load_network(root / "w/unet.safetensors", "unet").state_dict()
    other = DETECTORS["unet"]()
    other.initialise(9)
    save_network(root / "other.safetensors", other)
    closing = main(job, PARAMS.model_copy(update={"average": {"other.safetensors": 0.25}}))
    mixed = load_network(root / "w/unet.safetensors", "unet").state_dict()
    for name, value in other.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(mixed[name], 0.75 * trained[name] + 0.25 * value)
    rows = list(csv.DictReader((root / "w/unet.csv").read_text().splitlines()))
    assert [row["loss"] for row in rows[-2:]] == ["nan", "nan"]  # of no step, but scored
    assert f"F1 {float(rows[-1]['f1'])} " in closing
    for shares in (
        {"other.safetensors": 0.5, "w/unet.safetensors": 0.5},
        {"gone.safetensors": 0.1},
    ):
        with pytest.raises(UserError, match=r"train_detector\.average|gone"):
            main(job, PARAMS.model_copy(update={"average": shares}))


def test_validation_sets_of_one_name_are_told(root: Path) -> None:
    """The curve would show one of them."""
    job = Job(root, "made", None, "cpu", None, False)
    for folders, name in ((["rendered", "other/rendered"], "rendered"), (["painted"], "painted")):
        with pytest.raises(UserError, match=f"Two validation sets are called {name}"):
            train_detector._validation(
                job, PARAMS.model_copy(update={"validation_rendered": folders})
            )


def test_painting_is_kept_and_depends_on_the_photos(root: Path) -> None:
    photos = pools.list_pictures(root / "photos")
    assert pools.painted_name(5, photos) != pools.painted_name(5, photos, kind="veils")
    chunk = root / "0.npy"
    pools.paint_chunk(chunk, 5, 0, photos)
    written = chunk.read_bytes()
    pools.paint_chunk(chunk, 6, 0, photos)
    assert chunk.read_bytes() == written
    rainy, clean, coverage = pools.read_chunk(chunk)
    assert len(rainy) == 4 and rainy[0].shape == (48, 48, 3) and coverage[0].shape == (48, 48)
    dry = [
        np.abs(a.astype(int) - b)[c == 0] for a, b, c in zip(rainy, clean, coverage, strict=True)
    ]
    assert np.mean(np.concatenate(dry)) < 3  # compression alone tells them apart there
    veiled = root / "1.npy"
    pools.paint_chunk(veiled, 5, 0, photos, kind="veils")
    assert not np.array_equal(np.load(veiled)[..., 6], np.load(chunk)[..., 6])
