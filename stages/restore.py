"""Drops removed in the photos themselves, by the networks that the paper compares with."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from torch import nn

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.images import read_image, write_image
from pipeline.io.scene import read_images_json, write_images_json
from pipeline.io.weights import fill, read_state
from pipeline.parallel import cores, cut, map_named
from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.clean import clean_attgan, clean_quan, clean_wen_run, too_large, windows_of
from pipeline.removal.precision import in_half, keep_exact
from pipeline.removal.quan import QuanNet, from_tensorflow
from pipeline.removal.record import check_edges
from pipeline.removal.wen import WenNet
from pipeline.stage import Job, Section, run

Networks = tuple[nn.Module, ...]
Which = tuple[str, Path, str, str]  # what networks_of takes
LONGEST = 8  # photos of a run of `wen`, which looks at four more beside it
OWN = "weights/removers/{}.safetensors"  # where train_remover writes them


class Params(Section):
    """Section `restore`."""

    method: Literal["attgan", "quan", "wen"]
    weights: Annotated[str, Field(description="official; empty: those that train_remover makes")]
    published_edges: Annotated[bool, Field(description="quan: edges as released, or as meant")]
    keep_clear: Annotated[bool, Field(description="wen: what its map calls clear stays the photo")]
    precision: Literal["auto", "float32", "bfloat16"]


def main(job: Job, params: Params) -> str:
    """Makes `restored/` from the images: dry photos of the same names."""
    weights = job.resolve(params.weights or OWN.format(params.method))
    if not params.weights and not weights.is_file():
        raise UserError(
            f"{weights} does not exist: weights of these networks are not shipped.",
            f"Make them: python -m stages.train_remover --scene {job.scene} --method {params.method}; "
            "or set restore.weights to the released ones (docs/removers.md).",
        )
    digest = hashlib.sha256(weights.read_bytes()).hexdigest() if weights.is_file() else ""
    which = (params.method, weights, digest, job.device)
    networks_of(*which)  # what is wrong with them is told once
    if params.method == "quan":
        check_edges(weights, params.published_edges)
    records = read_images_json(job.paths.images)
    names = [record.name for record in records]
    half = in_half(params.precision, job.device)
    photos = [job.paths.images / name for name in names]
    with publish_dir(job.paths.restored) as fresh:
        tasks, counts = {}, {}
        for run_of in cut(len(names), LONGEST if params.method == "wen" else 1, cores()):
            label = " to ".join(dict.fromkeys((names[run_of[0]], names[run_of[-1]])))
            tasks[label] = (params, half, which, windows_of(photos, run_of), fresh)
            counts[label] = len(run_of)
        map_named(clean_run, tasks, counts=counts, job_label="restore", scheduler=job.scheduler)
        about = {"method": params.method, "weights_sha256": digest, "bfloat16": half}
        write_json(fresh / "restored.json", {**about, "images": names})
        write_images_json(fresh, records)  # so that a fit can take these photos instead
    return f"{len(names)} photos restored by {params.method} in {job.paths.restored}"


def clean_run(
    params: Params, half: bool, which: Which, windows: list[tuple[list[Path], int]], out: Path
) -> None:
    """Writes a run of dry photos; windows: the frames around each, for `wen`, and which of them it is."""
    nets: Any = networks_of(*which)
    photos = [window[place] for window, place in windows]
    if params.method == "wen":
        how = {"keep_clear": params.keep_clear, "half": half}
        done = clean_wen_run(nets[0], windows, read_image, **how)
    elif params.method == "quan":
        how = {"published": params.published_edges, "half": half}
        done = (clean_quan(nets[0], read_image(photo), **how) for photo in photos)
    else:
        attention, autoencoder = nets
        done = (
            clean_attgan(autoencoder, read_image(photo), lambda bgr: attention(bgr)[-1], half=half)
            for photo in photos
        )
    for photo in photos:
        try:
            write_image(out / photo.name, next(done))
        except (MemoryError, RuntimeError) as error:  # the run has a name of its own
            raise too_large(error, photo.name) or RuntimeError(f"{photo.name}: {error}") from error


@lru_cache(maxsize=1)
def networks_of(method: str, weights: Path, digest: str, device: str) -> Networks:
    """The networks of a method with their weights; the digest makes changed weights different ones."""
    state = read_state(weights, "Set restore.weights in params.yaml.")
    if any(name.startswith("g_net/") for name in state):
        state = from_tensorflow(state)
    kinds: dict[str, Networks] = {
        "attgan": (AttentiveRecurrentNet(), ContextualAutoencoder()),
        "quan": (QuanNet(),),
        "wen": (WenNet(),),
    }
    for network in kinds[method]:
        fill(network, state, str(weights))
        network.to(device)
        keep_exact(network, method)
    return kinds[method]


if __name__ == "__main__":
    run("restore", Params, main)
