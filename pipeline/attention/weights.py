"""The detectors by name, and their weights from and to files."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.unet import DropUNet
from pipeline.errors import UserError
from pipeline.io.tensors import load_tensors, save_tensors

Detector = AttentiveRecurrentNet | DropUNet
DETECTORS: dict[str, type[AttentiveRecurrentNet] | type[DropUNet]] = {
    "attentive": AttentiveRecurrentNet,
    "unet": DropUNet,
}


def network_from_state(
    state: Mapping[str, object], origin: str, model: str = "attentive"
) -> Detector:
    """The network `model` with the given weights, in evaluation mode on the CPU.

    state: a state dict of this network; for the attentive one also of the whole official generator
    (what belongs to its autoencoder is ignored). origin: where it came from, for the error.
    Raises UserError naming every tensor that is missing, of another shape, or not finite.
    """
    network = DETECTORS[model]()
    wanted = _numbers(network)
    problems, taken = [], {}
    for name, own in wanted.items():
        given = state.get(name, state.get(f"module.{name}"))
        if not isinstance(given, Tensor | np.ndarray):
            problems.append(f"{name} is missing")
            continue
        tensor = torch.as_tensor(given).to(own.dtype)
        if tensor.shape != own.shape:
            problems.append(f"{name} is {tuple(tensor.shape)}, not {tuple(own.shape)}")
        elif not bool(torch.isfinite(tensor).all()):
            problems.append(f"{name} holds numbers that are not finite")
        taken[name] = tensor
    if problems:
        told = "; ".join(problems[:20]) + (
            f"; and {len(problems) - 20} more" * (len(problems) > 20)
        )
        raise UserError(
            f"{origin} does not hold the weights of the drop detector {model!r}: {told}.",
            hint=f"attention.model says which network the file is for: {', '.join(DETECTORS)}.",
        )
    network.load_state_dict(taken, strict=False)
    return network.eval()


def save_network(path: Path, network: Detector) -> None:
    """Writes the weights as safetensors; the file says which network they are for."""
    save_tensors(path, _numbers(network), {"model": network.model})


def _numbers(network: Detector) -> dict[str, Tensor]:
    """All that the network computes with, on the CPU: its state but for the counts of batches."""
    state = network.state_dict()
    return {name: value.cpu() for name, value in state.items() if value.is_floating_point()}


def load_network(path: Path, model: str = "attentive") -> Detector:
    """The network `model` with the weights of a file: safetensors, or a PyTorch state dict.

    A PyTorch file is a pickle, so it is read with torch's restricted unpickler, which builds
    tensors and containers and runs nothing; whatever needs more is refused.
    Raises UserError for a missing, unreadable, unsafe or unfitting file.
    """
    if not path.is_file():
        raise UserError(
            f"The detector's weights {path} do not exist.",
            hint="Set attention.weights in params.yaml, or restore the file from the repository.",
        )
    if path.suffix == ".safetensors":
        tensors, metadata = load_tensors(path)
        if metadata.get("model", model) != model:
            raise UserError(
                f"{path} is for the detector {metadata['model']!r}, not for {model!r}.",
                hint="Change attention.model, or attention.weights, in params.yaml.",
            )
        return network_from_state(tensors, str(path), model)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError, KeyError, OSError) as error:
        raise UserError(
            f"{path} is not a PyTorch file that can be read without running code from it"
            f" ({_first_line(error)}).",
            hint="Where you trust it, convert it with safetensors.torch.save_file.",
        ) from error
    for wrapper in ("state_dict", "model"):
        if isinstance(state, Mapping) and isinstance(state.get(wrapper), Mapping):
            state = state[wrapper]
    if not isinstance(state, Mapping):
        raise UserError(
            f"{path} holds a {type(state).__name__}, not a state dict.",
            hint="Save network.state_dict(), not the network.",
        )
    return network_from_state(state, str(path), model)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
