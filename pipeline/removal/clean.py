"""Wet photos in, dry photos out: one function per network, any image size."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from pipeline.removal import autoencoder, quan, wen
from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.quan import QuanNet
from pipeline.removal.wen import WenNet


def clean_attgan(
    network: ContextualAutoencoder, image: np.ndarray, attend: Callable[[Tensor], Tensor]
) -> np.ndarray:
    """The photo without its drops, RGB (H,W,3) float32 in [0,1], from one of the same shape and range.

    `attend` gives the map (1,1,H,W) of a picture (1,3,H,W), blue first: the attention network's
    last raw map, or a map of the user's own.
    """
    device = next(network.parameters()).device
    bgr = _planes(image[..., ::-1], device)
    with torch.inference_mode():
        padded = _padded(bgr, autoencoder.MULTIPLE)
        full = network(padded, attend(padded)).full
    return _picture(full[..., : bgr.shape[-2], : bgr.shape[-1]])[..., ::-1].copy()


def clean_quan(network: QuanNet, image: np.ndarray, *, published: bool = True) -> np.ndarray:
    """As :func:`clean_attgan`; `published` keeps the released code's edges (`oriented_edges`)."""
    device = next(network.parameters()).device
    rgb = _planes(image, device)
    with torch.inference_mode():
        full = network(_padded(rgb, quan.MULTIPLE, "replicate"), published=published)
    return _picture(full[..., : rgb.shape[-2], : rgb.shape[-1]])


def clean_wen(
    network: WenNet, window: Sequence[np.ndarray], index: int, *, keep_clear: bool = False
) -> np.ndarray:
    """Frame `index` of a window of frames (H,W,3) without its drops; five frames were trained on.

    keep_clear: where the network's map says so, the photo stays as it is (`wen.mend`).
    """
    device = next(network.parameters()).device
    rgb = torch.cat([_planes(image, device) for image in window])
    with torch.inference_mode():
        frames = _padded(rgb, wen.MULTIPLE) * 2.0 - 1.0
        found = network(frames[None])
        whole = wen.mend(frames[None], found) if keep_clear else found.full
        full = (whole[0, index : index + 1] + 1.0) / 2.0
    return _picture(full[..., : rgb.shape[-2], : rgb.shape[-1]])


def window_around(index: int, count: int, size: int = wen.FRAMES) -> tuple[range, int]:
    """The frames to look at for frame `index` of `count`, and its place among them.

    `size` frames with the frame in the middle; at either end the window stays within the sequence.
    """
    size = min(size, count)
    first = min(max(index - size // 2, 0), count - size)
    return range(first, first + size), index - first


def _planes(image: np.ndarray, device: torch.device) -> Tensor:
    planes = np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)
    return torch.from_numpy(planes)[None].to(device)


def _padded(x: Tensor, multiple: int, how: str = "reflect") -> Tensor:
    """The pictures grown to the right and below until their sides are multiples."""
    down, right = (-x.shape[-2] % multiple, -x.shape[-1] % multiple)
    if how == "reflect" and (down >= x.shape[-2] or right >= x.shape[-1]):
        how = "replicate"  # a picture smaller than its padding has nothing to mirror
    return F.pad(x, (0, right, 0, down), mode=how)


def _picture(planes: Tensor) -> np.ndarray:
    return planes[0].clamp(0.0, 1.0).permute(1, 2, 0).contiguous().cpu().numpy()
