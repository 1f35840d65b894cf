"""Wet photos in, dry photos out: one function per network, any image size."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from pipeline.errors import UserError
from pipeline.io.memory import is_out_of_memory
from pipeline.removal import autoencoder, quan, wen
from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.precision import products
from pipeline.removal.quan import QuanNet
from pipeline.removal.wen import WenNet

Key = TypeVar("Key", bound=Hashable)


def clean_attgan(
    network: ContextualAutoencoder,
    image: np.ndarray,
    attend: Callable[[Tensor], Tensor],
    *,
    half: bool = False,
) -> np.ndarray:
    """The photo without its drops, RGB (H,W,3) float32 in [0,1], from one of the same shape and range.

    `attend` gives the map (1,1,H,W) of a picture (1,3,H,W), blue first: the attention network's
    last raw map, or a map of the user's own. half: products of the network in bfloat16, all but those
    that `precision.keep_exact` keeps, and but `attend`.
    """
    device = next(network.parameters()).device
    bgr = _planes(image[..., ::-1], device)
    with torch.inference_mode():
        padded = _padded(bgr, autoencoder.MULTIPLE)
        found = attend(padded)
        with products(device, half):
            full = network(padded, found).full
    return _picture(full[..., : bgr.shape[-2], : bgr.shape[-1]])[..., ::-1].copy()


def clean_quan(
    network: QuanNet, image: np.ndarray, *, published: bool = True, half: bool = False
) -> np.ndarray:
    """As :func:`clean_attgan`; `published`: the released code's edges (`oriented_edges`)."""
    device = next(network.parameters()).device
    rgb = _planes(image, device)
    with torch.inference_mode(), products(device, half):
        full = network(_padded(rgb, quan.MULTIPLE, "replicate"), published=published)
    return _picture(full[..., : rgb.shape[-2], : rgb.shape[-1]])


def clean_wen(
    network: WenNet,
    window: Sequence[np.ndarray],
    index: int,
    *,
    keep_clear: bool = False,
    half: bool = False,
) -> np.ndarray:
    """Frame `index` of a window of frames (H,W,3) without its drops; five frames were trained on.

    keep_clear: where the network's map says so, the photo stays as it is (`wen.mend`).
    """
    windows = [(range(len(window)), index)]
    how = {"keep_clear": keep_clear, "half": half}
    return next(clean_wen_run(network, windows, window.__getitem__, **how))


def clean_wen_run(
    network: WenNet,
    windows: Iterable[tuple[Sequence[Key], int]],
    read: Callable[[Key], np.ndarray],
    *,
    keep_clear: bool = False,
    half: bool = False,
) -> Iterator[np.ndarray]:
    """What `clean_wen` gives for one window after the other, each (frames, which of them).

    read: the photo of a frame. What depends on a frame alone is computed once, for one frame at a time,
    and kept while windows hold the frame: 80 bytes a pixel. So the pictures are the same bytes however
    the windows of a sequence are shared out among runs.
    """
    kept: dict[Key, _Frame] = {}
    before: Sequence[Key] = ()
    fused = torch.zeros(0)
    for window, place in windows:
        kept = {key: frame for key, frame in kept.items() if key in window}
        for key in window:
            if key not in kept:
                kept[key] = _frame(network, read(key), half)
        if window != before:  # at either end of a sequence several frames share one
            before, fused = window, _fused(network, [kept[key] for key in window], half)
        yield _dry(network, kept[window[place]], fused, place, keep_clear, half)


class _Frame(NamedTuple):
    """A padded photo (1,3,H,W) in [-1,1], its features, and its height and width."""

    pixels: Tensor
    seen: wen.Features
    size: tuple[int, int]


def _frame(network: WenNet, image: np.ndarray, half: bool) -> _Frame:
    device = next(network.parameters()).device
    with torch.inference_mode(), products(device, half):
        pixels = _padded(_planes(image, device), wen.MULTIPLE) * 2.0 - 1.0
        return _Frame(pixels, network.features(pixels), (image.shape[0], image.shape[1]))


def _fused(network: WenNet, frames: Sequence[_Frame], half: bool) -> Tensor:
    x = torch.cat([frame.seen.x for frame in frames])
    with torch.inference_mode(), products(x.device, half):
        return network.fused(x, 1)


def _dry(
    network: WenNet, frame: _Frame, fused: Tensor, place: int, keep_clear: bool, half: bool
) -> np.ndarray:
    with torch.inference_mode():
        with products(fused.device, half):
            found = network.picture(fused, place)
        full = found.float()
        if keep_clear:
            full = wen.mend(frame.pixels, full, frame.seen.clear.float())
        height, width = frame.size
        return _picture(((full + 1.0) / 2.0)[..., :height, :width])


def window_around(index: int, count: int, size: int = wen.FRAMES) -> tuple[range, int]:
    """The frames to look at for frame `index` of `count`, and its place among them.

    `size` frames with the frame in the middle; at either end the window stays within the sequence.
    """
    size = min(size, count)
    first = min(max(index - size // 2, 0), count - size)
    return range(first, first + size), index - first


def windows_of(frames: Sequence[Key], run: range) -> list[tuple[list[Key], int]]:
    """`window_around` each frame of a run of all `frames`, with the frames themselves."""
    around = (window_around(index, len(frames)) for index in run)
    return [([frames[k] for k in window], place) for window, place in around]


def too_large(error: BaseException, name: str) -> UserError | None:
    """What to tell when there was no memory for the photo `name`; None when `error` is another fault."""
    if not is_out_of_memory(error):
        return None
    return UserError(
        f"{name} is too large to be restored with the memory that is free.",
        "Scale the photos down (ingest.max_size) and start from ingest, or end other programs.",
    )


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
    return planes[0].float().clamp(0.0, 1.0).permute(1, 2, 0).contiguous().cpu().numpy()
