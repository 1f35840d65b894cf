"""Shape-driven attention: where edges close around a round thing, computed, not learned.

Source: Y. Quan et al., "Deep Learning for Seeing Through Window With Raindrops", ICCV 2019
(doi:10.1109/ICCV.2019.00255), section 3.2, and the constants of its released code.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

EDGE_STEP = 10 / 255  # a smaller difference between neighbours is no edge
KERNELS = (20, 25, 30, 35, 40)  # pixels: the sizes of drops that are looked for
# The eight neighbours as (rows, columns), axial and diagonal ones in turn, and the unit steps to them.
STEPS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
DIRECTIONS = tuple((y / math.hypot(y, x), x / math.hypot(y, x)) for y, x in STEPS)


def oriented_edges(rgb: Tensor, *, published: bool = True) -> Tensor:
    """Edges by orientation (N,8,H,W), 0 or 1, of pictures (N,3,H,W) in [0,1].

    As meant (`published` off): a pixel is an edge of orientation k when its difference to neighbour
    k is the largest of the four axial, or the four diagonal ones, above 10/255, and that neighbour's
    smallest difference points back. It points at its darker side. Outside of the picture is black.

    As released (`published`), which weights trained with that code need: rows are counted the other
    way than `torque` counts them, so that an edge whose upper side is darker points down; a diagonal
    edge asks for the largest and smallest of the axial differences, and only its height is that of
    the diagonal one; what is opposite to the third of four is never met, so that channels 4 and 5
    stay empty. Source: amitedgefinder, findGradient and myShift in utils.py of the released code
    (jackiesdd/raindropAttention), as its model calls them; its shifts are padded, so none wraps around.
    """
    grey = (rgb * rgb.new_tensor([0.299, 0.587, 0.114])[None, :, None, None]).sum(1, keepdim=True)
    return (_released_edges if published else _mended_edges)(grey).to(rgb.dtype)


def _mended_edges(grey: Tensor) -> Tensor:
    """`oriented_edges` as meant, of grey (N,1,H,W)."""
    found = [torch.zeros(0)] * 8
    for first in (0, 1):  # axial neighbours, then diagonal ones
        steps = STEPS[first::2]
        differences = torch.cat([grey - _shifted(grey, step) for step in steps], 1)
        largest, smallest = differences.argmax(1), differences.argmin(1)
        for k, step in enumerate(steps):
            edge = (largest == k) & (differences[:, k] > EDGE_STEP)
            neighbour = _shifted(smallest[:, None].to(grey.dtype) + 1, step)[:, 0]  # 0: outside
            found[2 * k + first] = edge & (neighbour == (k + 2) % 4 + 1)
    return torch.stack(found, 1)


def _released_edges(grey: Tensor) -> Tensor:
    """`oriented_edges` as released, of grey (N,1,H,W)."""
    steps = [(-rows, columns) for rows, columns in STEPS]
    axial = torch.cat([grey - _shifted(grey, step) for step in steps[::2]], 1)
    largest, smallest = axial.argmax(1), axial.argmin(1, keepdim=True).to(grey.dtype)
    found = []
    for n, step in enumerate(steps):
        k, difference = n // 2, (grey - _shifted(grey, step))[:, 0]
        back = _shifted(smallest, step)[:, 0]  # 0 outside, where no opposite is 0
        found.append((largest == k) & (difference > EDGE_STEP) & (back == (k + 1) % 4 + 1))
    return torch.stack(found, 1)


def _shifted(values: Tensor, step: tuple[int, int]) -> Tensor:
    """The value of the neighbour one step away; 0 outside the picture."""
    rows, columns = step
    padded = F.pad(values, (1, 1, 1, 1))
    height, width = values.shape[-2:]
    return padded[..., 1 + rows : 1 + rows + height, 1 + columns : 1 + columns + width]


def torque(edges: Tensor) -> Tensor:
    """How strongly edges (N,8,H,W) turn around each pixel: (N,1,H,W), 0 or more.

    The edges' directions, as a field of vectors, are correlated with a ramp through the pixel, over
    squares of 20 to 40 pixels and divided by the fourth power of their sides; the largest counts.
    """
    directions = edges.new_tensor(DIRECTIONS)
    y, x = (torch.einsum("nkhw,k->nhw", edges, directions[:, i])[:, None] for i in (0, 1))
    answers = []
    for size in KERNELS:
        ramp = torch.linspace((size - 1) / 2, (1 - size) / 2, size).to(edges)
        rows = ramp[None, None, :, None].expand(1, 1, size, size)
        before = (size - 1) // 2  # TensorFlow's SAME: the odd pixel of padding comes after
        pad = (before, size - 1 - before, before, size - 1 - before)
        answer = F.conv2d(F.pad(y, pad), rows) + F.conv2d(F.pad(x, pad), rows.transpose(2, 3))
        answers.append(answer / size**4)
    return torch.cat(answers, 1).clamp_min(0.0).amax(1, keepdim=True)


def shape_attention(rgb: Tensor, *, published: bool = True) -> Tensor:
    """The map (N,1,H,W) of closed contours in pictures (N,3,H,W) in [0,1]: `torque` of the edges."""
    return torque(oriented_edges(rgb, published=published))
