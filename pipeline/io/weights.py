"""State dicts that users bring: safetensors or PyTorch files, read without running code from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.errors import UserError
from pipeline.io.tensors import load_tensors

WRAPPERS = ("state_dict", "model", "params", "network")


def read_state(path: Path, hint: str = "") -> dict[str, Tensor]:
    """The named tensors of a weights file, on the CPU, without a leading `module.`.

    safetensors, NumPy's npz, or a PyTorch file holding a state dict, bare or under `state_dict`,
    `model`, `params` or `network`. A PyTorch file is a pickle: it is read with torch's restricted
    unpickler, which builds tensors and containers and runs nothing. UserError for a missing,
    unreadable or unsafe file, and for tensors without names.
    """
    if not path.is_file():
        raise UserError(f"The weights {path} do not exist.", hint)
    if path.suffix == ".safetensors":
        state: Mapping[str, Any] = load_tensors(path, hint)[0]
    elif path.suffix == ".npz":
        state = _read_npz(path, hint)
    else:
        state = _read_torch(path, hint)
    named = {name.removeprefix("module."): value for name, value in state.items()}
    return {
        name: value if isinstance(value, Tensor) else _tensor(value)
        for name, value in named.items()
        if isinstance(value, Tensor)
        or (isinstance(value, np.ndarray) and value.dtype.kind in "bfiu")
    }


def _tensor(array: np.ndarray) -> Tensor:
    """The numbers as a tensor, of whatever order their bytes are."""
    return torch.as_tensor(array.astype(array.dtype.newbyteorder("="), copy=False))


def _read_npz(path: Path, hint: str) -> Mapping[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # what a damaged archive raises has no common kind
        raise UserError(f"{path} is not an npz file of plain arrays ({error}).", hint) from None


def _read_torch(path: Path, hint: str) -> Mapping[str, Any]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged pickle raises has no common kind
        told = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        raise UserError(
            f"{path} is not a PyTorch file that can be read without running code from it ({told}).",
            f"{hint} Where you trust it, convert it with safetensors.torch.save_file.".strip(),
        ) from None
    for wrapper in WRAPPERS:
        if isinstance(state, Mapping) and isinstance(state.get(wrapper), Mapping):
            state = state[wrapper]
    if not isinstance(state, Mapping):
        raise UserError(
            f"{path} holds a {type(state).__name__}, not a state dict.",
            f"{hint} Save network.state_dict(), not the network.".strip(),
        )
    strange = [key for key in state if not isinstance(key, str)]
    if strange:
        raise UserError(
            f"{path} holds tensors without names (the first key is {strange[0]!r:.40}).",
            f"{hint} Save network.state_dict().".strip(),
        )
    return state


def fill(
    network: nn.Module,
    state: Mapping[str, Tensor],
    origin: str,
    rename: Callable[[str], str] = str,
    hint: str = "",
) -> None:
    """Loads `state` into `network` and leaves it in evaluation mode; tensors not asked for are passed over.

    `rename` gives the name in `state` of a tensor of the network. UserError names every tensor that
    is missing, of another shape, or not finite, and `origin`, where they came from.
    """
    problems, taken = [], {}
    for name, own in network.state_dict().items():
        given = state.get(rename(name))
        if given is None:
            problems.append(f"{rename(name)} is missing")
        elif given.shape != own.shape:
            problems.append(f"{rename(name)} is {tuple(given.shape)}, not {tuple(own.shape)}")
        elif not bool(torch.isfinite(taking := given.to(own.dtype)).all()):
            problems.append(f"{rename(name)} holds numbers that are not finite")
        else:
            taken[name] = taking
    if problems:
        more = f"; and {len(problems) - 8} more" if len(problems) > 8 else ""
        raise UserError(
            f"{origin} does not hold the weights of {type(network).__name__}: "
            f"{'; '.join(problems[:8])}{more}.",
            hint,
        )
    network.load_state_dict(taken)
    network.eval()
