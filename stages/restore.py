"""Drops removed in the photos themselves, by the networks that the paper compares with."""

from __future__ import annotations

import hashlib
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from torch import Tensor, nn

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.images import read_image, write_image
from pipeline.io.scene import read_images_json, write_images_json
from pipeline.io.weights import fill, read_state
from pipeline.parallel import map_named
from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.clean import clean_attgan, clean_quan, clean_wen, window_around
from pipeline.removal.quan import QuanNet, from_tensorflow
from pipeline.removal.wen import WenNet
from pipeline.stage import Job, Section, run

Networks = tuple[nn.Module, ...]
OWN = "weights/removers/{}.safetensors"  # where train_remover writes them


class Params(Section):
    """Section `restore`."""

    method: Literal["attgan", "quan", "wen"]
    weights: Annotated[
        str, Field(description="official weights; empty: those that train_remover makes")
    ]
    published_edges: Annotated[
        bool, Field(description="quan: two empty edge channels, as released")
    ]
    keep_clear: Annotated[bool, Field(description="wen: what its map calls clear stays the photo")]


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
    networks_of(params.method, weights, digest, job.device)  # what is wrong with them is told once
    records = read_images_json(job.paths.images)
    names = [record.name for record in records]
    with publish_dir(job.paths.restored) as fresh:
        tasks = {}
        for index, name in enumerate(names):
            window, place = window_around(index, len(names))
            files = [job.paths.images / names[k] for k in window]
            tasks[name] = (params, weights, digest, job.device, files, place, fresh / name)
        map_named(clean_one, tasks, job_label="restore", scheduler=job.scheduler)
        about = {"method": params.method, "weights_sha256": digest, "images": names}
        write_json(fresh / "restored.json", about)
        write_images_json(fresh, records)  # so that a fit can take these photos instead
    return f"{len(names)} photos restored by {params.method} in {job.paths.restored}"


def clean_one(
    params: Params,
    weights: Path,
    digest: str,
    device: str,
    window: list[Path],
    place: int,
    out: Path,
) -> None:
    """Writes one dry photo; `window` holds the frames around it, which only `wen` looks at."""
    networks = networks_of(params.method, weights, digest, device)
    if params.method == "wen":
        frames = [read_image(path) for path in window]
        write_image(out, clean_wen(networks[0], frames, place, keep_clear=params.keep_clear))  # type: ignore[arg-type]
        return
    image = read_image(window[place])
    if params.method == "quan":
        done = clean_quan(networks[0], image, published=params.published_edges)  # type: ignore[arg-type]
    else:
        done = clean_attgan(networks[1], image, partial(_last_map, networks[0]))  # type: ignore[arg-type]
    write_image(out, done)


def _last_map(network: nn.Module, bgr: Tensor) -> Tensor:
    return network(bgr)[-1]


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
    return kinds[method]


if __name__ == "__main__":
    run("restore", Params, main)
