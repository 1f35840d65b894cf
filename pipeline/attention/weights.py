"""The detectors by name, and their weights from and to files."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.unet import DropUNet
from pipeline.errors import UserError
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.io.weights import fill, read_state

Detector = AttentiveRecurrentNet | DropUNet
DETECTORS: dict[str, type[AttentiveRecurrentNet] | type[DropUNet]] = {
    "attentive": AttentiveRecurrentNet,
    "unet": DropUNet,
}
WHOLE = "attgan"  # what a file of the attentive network and its autoencoder says that it is for


def save_network(path: Path, network: Detector) -> None:
    """Writes the weights as safetensors; the file says which network they are for."""
    state = {name: value.cpu() for name, value in network.state_dict().items()}
    numbers = {name: value for name, value in state.items() if value.is_floating_point()}
    save_tensors(path, numbers, {"model": network.model})


def load_network(
    path: Path, model: str = "attentive", named_by: str = "attention.weights"
) -> Detector:
    """The network `model` with the weights of a file, in evaluation mode on the CPU.

    The file: safetensors, npz, or a PyTorch state dict, which is read without running code from it;
    for the attentive network also that of the whole generator, the official one or one that
    train_remover made (what belongs to its autoencoder is passed over). Raises UserError for a
    missing, unreadable, unsafe or unfitting file, with the parameter that it is `named_by`.
    """
    state = read_state(path, f"Set {named_by} in params.yaml, or restore the file.")
    if path.suffix == ".safetensors":
        made_for = load_tensors(path)[1].get("model", model)
        if made_for != model and (made_for, model) != (WHOLE, "attentive"):
            raise UserError(
                f"{path} is for the detector {made_for!r}, not for {model!r}.",
                f"Change {named_by} in params.yaml, or the model beside it.",
            )
    network = DETECTORS[model]()
    fill(network, _counts(network) | state, str(path))
    return network


def first_network(path: Path | None, model: str, seed: int, named_by: str) -> Detector:
    """The network `model` to begin a training with: of a file, or with starting weights drawn."""
    if path is not None:
        return load_network(path, model, named_by)
    network = DETECTORS[model]()
    network.initialise(seed)
    return network


def load_others(
    shares: Mapping[Path, float], model: str, named_by: str = "train_detector.average"
) -> list[tuple[Detector, float]]:
    """The networks to average another one with, from their files, and the share of each.

    Raises UserError as `load_network` does, and where the shares leave nothing to that other one.
    """
    if sum(shares.values()) >= 1:
        raise UserError(
            f"The shares in {named_by} add up to 1 or more.", "Less leaves some to the trained one."
        )
    return [(load_network(path, model, named_by), share) for path, share in shares.items()]


def averaged(network: Detector, others: Sequence[tuple[Detector, float]]) -> Detector:
    """A network whose every number is the mean of those of the networks given, by shares.

    others: networks of the same kind, each with its share in [0,1]; `network` has what is left of 1.
    Where one was trained on from the other, the mean keeps most of what each has learnt. Source: Wortsman
    et al., Model soups, ICML 2022; https://doi.org/10.48550/arXiv.2203.05482.
    """
    left = 1 - sum(share for _, share in others)
    found = copy.deepcopy(network)
    states = [(each.state_dict(), share) for each, share in others]
    with torch.no_grad():
        for name, value in found.state_dict().items():
            if value.is_floating_point():
                mean = left * value.double() + sum(s * state[name].double() for state, s in states)
                value.copy_(mean)
    return found


def _counts(network: Detector) -> dict[str, Tensor]:
    """How often normalisations were trained: part of the state, but not kept in files."""
    return {k: v for k, v in network.state_dict().items() if not v.is_floating_point()}
