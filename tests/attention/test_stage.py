"""The stage attention: a map per image and their mean, the same wherever and whenever made."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.unet import DropUNet
from pipeline.attention.weights import save_network
from pipeline.errors import UserError
from pipeline.io.images import write_image
from pipeline.io.maps import read_map
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.stage import Job, run
from stages.attention import Params, attend_image, attributes_of, main

SIZES = (37, 53)
PARAMS = Params(
    model="unet", weights="w/unet.safetensors", steps=2, scales=[1.0, 0.5], mirrored=False, tile=32
)
ATTENTIVE = PARAMS.model_copy(update={"model": "attentive", "weights": "w/attentive.safetensors"})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three small images, as the stage ingest leaves them, and drawn weights of both networks."""
    rng = np.random.default_rng(0)
    images = tmp_path / "artifacts/made/images"
    records = []
    for k in range(3):
        name = f"view_{k:02d}.png"
        write_image(images / name, rng.integers(0, 256, (*SIZES, 3), dtype=np.uint8))
        records.append(ImageRecord(name, name, "", SIZES[1], SIZES[0], None, "train", 0))
    write_images_json(images, records)
    for made in (DropUNet(), AttentiveRecurrentNet()):
        made.initialise(4)
        save_network(tmp_path / f"w/{made.model}.safetensors", made)
    return tmp_path


def _job(root: Path) -> Job:
    return Job(root, "made", None, "cpu", None, False)


def _digests(root: Path) -> dict[str, str]:
    folder = root / "artifacts/made/attention"
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir())}


MIRRORED = PARAMS.model_copy(update={"mirrored": True})


@pytest.mark.parametrize(
    "params", [PARAMS, ATTENTIVE, MIRRORED], ids=["unet", "attentive", "mirrored"]
)
def test_a_map_per_image_and_their_mean(root: Path, params: Params) -> None:
    closing = main(_job(root), params)
    folder = root / "artifacts/made/attention"
    names = ["mean.exr", "view_00.exr", "view_01.exr", "view_02.exr"]
    assert sorted(path.name for path in folder.iterdir()) == names
    maps = [read_map(folder / name) for name in names]
    for each in maps:
        assert each.shape == SIZES and each.min() >= 0 and each.max() <= 1
    # Half precision is exact to 2^-11 of the value.
    assert np.allclose(maps[0], np.mean(maps[1:], axis=0), atol=5e-4)
    assert not np.allclose(maps[1], maps[2], atol=1e-3)
    share = np.mean([(each > 0.3).mean() for each in maps[1:]])
    assert closing == f"3 maps; {share:.1%} of the pixels above 0.3"


def test_the_same_bytes_twice(root: Path) -> None:
    main(_job(root), PARAMS)
    first = _digests(root)
    main(_job(root), PARAMS)
    assert _digests(root) == first


def test_missing_weights_end_with_exit_code_2_and_a_sentence(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {**PARAMS.model_dump(), "weights": "w/none.safetensors"}
    content = {"scenes": {"made": {}}, "variants": {}, "attention": values}
    (root / "params.yaml").write_text(json.dumps(content))
    flags = ["attention", "--scene", "made", "--params", str(root / "params.yaml")]
    monkeypatch.setattr("sys.argv", flags)
    with pytest.raises(SystemExit) as left:
        run("attention", Params, main)
    assert left.value.code == 2
    told = capsys.readouterr().err
    assert "none.safetensors do not exist" in told and "Traceback" not in told


def test_threads_and_order_change_nothing(
    root: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> None:
    """What the threads of the stage wrote is what each image gives alone, last one first."""
    main(_job(root), PARAMS)
    weights = root / PARAMS.weights
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    alone = tmp_path_factory.mktemp("alone")
    folder = root / "artifacts/made/attention"
    attributes = attributes_of(PARAMS, digest)
    threads = torch.get_num_threads()
    # As each of the stage's threads has it: products made by two differ by rounding.
    torch.set_num_threads(1)
    request.addfinalizer(lambda: torch.set_num_threads(threads))
    for k in (2, 0, 1):
        image = root / f"artifacts/made/images/view_{k:02d}.png"
        attend_image(
            image, SIZES[::-1], alone / f"{k}.exr", weights, digest, "cpu", PARAMS, attributes
        )
        assert (alone / f"{k}.exr").read_bytes() == (folder / f"view_{k:02d}.exr").read_bytes()


def test_without_a_model_there_is_no_drop_and_no_need_of_weights(root: Path) -> None:
    params = PARAMS.model_copy(update={"model": "none", "weights": "nowhere"})
    assert "0.0% of the pixels" in main(_job(root), params)
    assert read_map(root / "artifacts/made/attention/view_01.exr").max() == 0
    assert read_map(root / "artifacts/made/attention/mean.exr").shape == SIZES


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"weights": "w/none.safetensors"}, "do not exist"),
        ({"model": "attentive"}, "for the detector 'unet', not for 'attentive'"),
    ],
)
def test_a_fault_of_the_weights_is_told_before_anything_is_written(
    root: Path, change: dict[str, str], told: str
) -> None:
    with pytest.raises(UserError, match=told):
        main(_job(root), PARAMS.model_copy(update=change))
    assert not (root / "artifacts/made/attention").exists()
