"""Images in, one attention map per image out: where the detector sees drops."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field

from pipeline.attention.inference import attend
from pipeline.attention.weights import Detector, load_network
from pipeline.io.atomic import publish_dir
from pipeline.io.images import read_image
from pipeline.io.maps import read_map, write_map
from pipeline.io.scene import read_images_json
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run


class Params(Section):
    """Section `attention`."""

    model: Literal["unet", "attentive", "none"]
    weights: Annotated[str, Field(min_length=1)]
    steps: Annotated[int, Field(ge=1, le=16)]
    scales: Annotated[list[Annotated[float, Field(gt=0, le=4)]], Field(min_length=1, max_length=8)]
    mirrored: bool
    tile: Annotated[int, Field(ge=32, le=8192)]


def main(job: Job, params: Params) -> str:
    """Makes `artifacts/<scene>/attention/`: a map per image, and the mean of all maps."""
    records = read_images_json(job.paths.images)
    weights, digest = job.resolve(params.weights), ""
    if params.model != "none":
        load_network(weights, params.model)  # what is wrong is told once, before any work
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    attributes = attributes_of(params, digest)
    with publish_dir(job.paths.attention) as fresh:
        shares = map_named(
            attend_image,
            {
                record.name: (
                    job.paths.images / record.name,
                    record.size,
                    fresh / f"{Path(record.name).stem}.exr",
                    weights,
                    digest,
                    job.device,
                    params,
                    attributes,
                )
                for record in records
            },
            job_label="attention",
            scheduler=job.scheduler,
        )
        # From the files, so that the mean is that of the maps which the next stage reads.
        total: np.ndarray | None = None
        for record in records:
            found = read_map(fresh / f"{Path(record.name).stem}.exr").astype(np.float64)
            total = found if total is None else total + found
        assert total is not None  # images.json lists at least one image
        write_map(fresh / "mean.exr", (total / len(records)).astype(np.float32), attributes)
    mean_share = float(np.mean(list(shares.values())))
    return f"{len(records)} maps; {mean_share:.1%} of the pixels above 0.3"


def attributes_of(params: Params, digest: str) -> dict[str, str | float]:
    """What a map's header tells of how it was made; digest: of the weights, "" for none."""
    return {
        "derainnerf:model": params.model,
        "derainnerf:weights_sha256": digest,
        "derainnerf:steps": str(params.steps),
        "derainnerf:scales": " ".join(f"{scale:g}" for scale in params.scales),
        **({"derainnerf:mirrored": "true"} if params.mirrored else {}),
    }


def attend_image(
    image: Path,
    size: tuple[int, int],
    out: Path,
    weights: Path,
    digest: str,
    device: str,
    params: Params,
    attributes: dict[str, str | float],
) -> float:
    """Writes the map of one image (without a model: no drop anywhere); its share above 0.3."""
    pixels = read_image(image, size=size)
    found = np.zeros(pixels.shape[:2], np.float32)
    if params.model != "none":
        network = _network(weights, params.model, digest, device)
        found = attend(network, pixels, **params.model_dump(exclude={"model", "weights"}))
    write_map(out, found, attributes)
    return float((found > 0.3).mean())


@lru_cache(maxsize=1)
def _network(weights: Path, model: str, digest: str, device: str) -> Detector:
    """The network, once per process; the digest makes changed weights a different one."""
    return load_network(weights, model).for_inference().to(torch.device(device))


if __name__ == "__main__":
    run("attention", Params, main)
