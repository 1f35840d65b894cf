"""Mean absolute gradients of Quan's layers on one batch: which of them learn, and which are cut off.

`python -m experiments.removers.gradients CHUNK.npy [--weights weights/removers/quan.safetensors]`

CHUNK.npy: a hundred painted pictures, artifacts/.work/<scene>/train_remover/painted-*/0000.npy. Without
weights: those that training starts from. The loss is the published one; silent: channels that are zero in
all of the batch. Edges are those that the weights say, or the published ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from torch.nn import functional as F

from pipeline.attention import pools
from pipeline.io.weights import fill, read_state
from pipeline.removal import starts
from pipeline.removal.quan import QuanNet
from pipeline.removal.record import edges_of
from pipeline.removal.samples import Pairs, draw_batch

LAYERS = ("enc1_1", "enc1_3.conv1_2", "enc2_1", "enc2_3.conv1_1", "enc3_1", "enc3_3.conv1_1", "dec3_2.conv1_2",
          "dec2_4", "dec2_2.conv1_1", "dec1_4", "dec1_2.conv1_1", "dec1_0")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("chunk", type=Path)
    parser.add_argument("--weights", type=Path)
    flags = parser.parse_args()
    network = QuanNet()
    starts.start_quan(network, 0)
    if flags.weights:
        fill(network, read_state(flags.weights, ""), str(flags.weights))
    pool = Pairs(*pools.read_chunk(flags.chunk))
    rainy, clean, _ = (part[:, 0] for part in draw_batch([pool], np.random.default_rng(3), 4, 64))
    published = not flags.weights or edges_of(flags.weights) is not False
    last = network.decoded(rainy, published=published)[-1]
    F.l1_loss(network.dec1_0(last), clean).backward()
    print(f"silent channels before the last layer: {int((last.amax((0, 2, 3)) == 0).sum())} of 32")
    for name in LAYERS:
        gradient = network.get_submodule(name).weight.grad
        print(f"{name:16} {float(gradient.abs().mean()):.0e}")  # type: ignore[union-attr,operator]


if __name__ == "__main__":
    main()
