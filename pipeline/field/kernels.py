"""Loops over rays and table rows, compiled by numba: the fast field's inner work on a CPU.

Each does in one pass what takes many tensor operations, lets other threads run meanwhile, and works in a
fixed order: the same bytes every time. Arrays in, arrays filled; shapes as the callers in
:mod:`pipeline.field.fused` make them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry.compiled import compiled as machine_code
from pipeline.geometry.spaces import EPS

# Reordering sums lets them run in vectors; infinities and NaN must survive, or a broken fit goes unseen.
_FLAGS = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: Any, inline: str = "never") -> Any:
    """As :func:`pipeline.geometry.compiled.compiled`, with sums in any order."""
    return machine_code(function, fastmath=_FLAGS, inline=inline)


def inlined(function: Any) -> Any:
    """As :func:`compiled`, within the functions that call it."""
    return compiled(function, "always")


P1, P2 = np.int32(2654435761 - 2**32), np.int32(805459861)


@inlined
def _warped(ndc, x, y, z, near, low, scale, axis):  # type: ignore[no-untyped-def]
    """One unit-cube coordinate of a point in the space's own frame."""
    if ndc:
        inverse = np.float32(1.0) / max(z, np.float32(EPS))
        mapped = np.float32(1.0) - near * inverse
        if axis == 0:
            mapped = x * inverse
        elif axis == 1:
            mapped = y * inverse
    else:
        norm = max(np.sqrt(x * x + y * y + z * z), np.float32(1.0))
        factor = (np.float32(2.0) - np.float32(1.0) / norm) / norm
        mapped = z * factor
        if axis == 0:
            mapped = x * factor
        elif axis == 1:
            mapped = y * factor
    return min(max((mapped - low[axis]) * scale[axis], np.float32(0.0)), np.float32(1.0))


@compiled
def walk(o, d, near, far, s, ndc, space_near, low, scale, out):  # type: ignore[no-untyped-def]
    """Fills ``out`` (3, R, K) with unit-cube positions at normalised depths ``s`` (R or 1, K).

    ``o`` and ``d`` (3, R) are rays in the space's own frame.
    """
    rays, count = out.shape[1], out.shape[2]
    one = np.float32(1.0)
    for r in range(rays):
        row = r if s.shape[0] > 1 else 0
        first = one / near[r]
        slope = one / far[r] - first
        ox, oy, oz, dx, dy, dz = o[0, r], o[1, r], o[2, r], d[0, r], d[1, r], d[2, r]
        for k in range(count):
            t = one / (first + s[row, k] * slope)
            x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
            out[0, r, k] = _warped(ndc, x, y, z, space_near, low, scale, 0)
            out[1, r, k] = _warped(ndc, x, y, z, space_near, low, scale, 1)
            out[2, r, k] = _warped(ndc, x, y, z, space_near, low, scale, 2)


@inlined
def _twist(state, first, last, ahead):  # type: ignore[no-untyped-def]
    """Renews the words ``first`` to ``last`` of a generator's state from those ``ahead`` of them."""
    one = np.uint32(1)
    for k in range(first, last):
        y = (state[k] & np.uint32(0x80000000)) | (state[k + 1] & np.uint32(0x7FFFFFFF))
        odd = np.uint32(0) - (y & one)
        state[k] = state[k + ahead] ^ (y >> one) ^ (odd & np.uint32(0x9908B0DF))


@compiled
def uniform(seed, out):  # type: ignore[no-untyped-def]
    """Fills ``out`` (N,), float32, with the first numbers in [0, 1) of torch's CPU generator.

    Matsumoto and Nishimura's twister MT19937, doi:10.1145/272991.272995, with 24 bits of each word.
    """
    size, middle = 624, 397
    state = np.empty(size + 1, np.uint32)  # the first word again at the end
    state[0] = seed
    for k in range(1, size):
        last = state[k - 1] ^ (state[k - 1] >> np.uint32(30))
        state[k] = np.uint32(1812433253) * last + np.uint32(k)
    for start in range(0, out.shape[0], size):
        _twist(state, 0, size - middle, middle)
        state[size] = state[0]
        _twist(state, size - middle, size, middle - size)
        for k in range(min(size, out.shape[0] - start)):
            y = state[k]
            y ^= y >> np.uint32(11)
            y ^= (y << np.uint32(7)) & np.uint32(0x9D2C5680)
            y ^= (y << np.uint32(15)) & np.uint32(0xEFC60000)
            y ^= y >> np.uint32(18)
            out[start + k] = np.float32(y & np.uint32(0xFFFFFF)) * np.float32(2.0**-24)


@compiled
def nearest_rows(edges, along, shake, sizes, rows, delta):  # type: ignore[no-untyped-def]
    """Fills ``rows`` (R, B) of the cells between ``edges`` (3, R, B+1) and the lengths ``delta``.

    ``along`` (R, B) in [0, 1] places a point in each interval, ``shake`` (3, R, B) moves it by as
    many cells less a half; both may be empty: the middle, unmoved.
    """
    rays, bins = rows.shape
    half, zero = np.float32(0.5), np.float32(0.0)
    random = along.size > 0
    nx, ny, nz = np.float32(sizes[0]), np.float32(sizes[1]), np.float32(sizes[2])
    for r in range(rays):
        for b in range(bins):
            x0, y0, z0 = edges[0, r, b], edges[1, r, b], edges[2, r, b]
            sx, sy, sz = edges[0, r, b + 1] - x0, edges[1, r, b + 1] - y0, edges[2, r, b + 1] - z0
            delta[r, b] = np.sqrt(sx * sx + sy * sy + sz * sz)
            share = along[r, b] if random else half
            x, y, z = (x0 + share * sx) * nx, (y0 + share * sy) * ny, (z0 + share * sz) * nz
            if random:
                x += shake[0, r, b] - half
                y += shake[1, r, b] - half
                z += shake[2, r, b] - half
            i = np.int32(min(max(x, zero), nx - np.float32(1.0)))
            j = np.int32(min(max(y, zero), ny - np.float32(1.0)))
            k = np.int32(min(max(z, zero), nz - np.float32(1.0)))
            rows[r, b] = i + sizes[0] * (j + sizes[1] * k)


@compiled
def add_single(rows, gradient, out):  # type: ignore[no-untyped-def]
    """Adds ``gradient`` (N,) into ``out`` at ``rows`` (N,)."""
    for n in range(rows.shape[0]):
        out[rows[n]] += gradient[n]


@compiled
def draw(weights, u, edges):  # type: ignore[no-untyped-def]
    """Fills ``edges`` (R, S+1) of intervals around the places whose cumulative weight is ``u`` (R, S).

    As ``intervals_around(invert_histogram(weights, u))``; ``weights`` (R, B).
    """
    rays, bins = weights.shape
    samples = u.shape[1]
    places = np.empty(samples, np.float32)
    small, one, half = np.float32(1e-6), np.float32(1.0), np.float32(0.5)
    for r in range(rays):
        total = np.float32(0.0)
        for b in range(bins):
            total += weights[r, b] + small
        b, lower, upper = 0, np.float32(0.0), (weights[r, 0] + small) / total
        for k in range(samples):
            while upper < u[r, k] and b < bins - 1:
                b += 1
                lower = upper
                upper = lower + (weights[r, b] + small) / total
            inside = (u[r, k] - lower) / max(upper - lower, np.float32(1e-12))
            places[k] = (b + min(max(inside, np.float32(0.0)), one)) / np.float32(bins)
        last = samples - 1
        for k in range(last):
            edges[r, k + 1] = half * (places[k] + places[k + 1])
        edges[r, 0] = max(places[0] + places[0] - edges[r, 1], np.float32(0.0))
        edges[r, samples] = min(places[last] + places[last] - edges[r, last], one)


@compiled
def middles(edges, x, delta):  # type: ignore[no-untyped-def]
    """Fills ``x`` (3, R, S), the middles between ``edges`` (3, R, S+1), and lengths ``delta`` (R, S)."""
    rays, samples = delta.shape
    half = np.float32(0.5)
    for r in range(rays):
        for k in range(samples):
            total = np.float32(0.0)
            for c in range(3):
                a, b = edges[c, r, k], edges[c, r, k + 1]
                x[c, r, k] = half * (a + b)
                total += (b - a) * (b - a)
            delta[r, k] = np.sqrt(total)


@compiled
def seen(weights, shape, out):  # type: ignore[no-untyped-def]
    """Fills ``out`` (R, C-1) with the sum over samples of ``weights`` (R, S) times ``shape[..., 1:]``."""
    rays, samples = weights.shape
    width = out.shape[1]
    for r in range(rays):
        for c in range(width):
            out[r, c] = np.float32(0.0)
        for k in range(samples):
            w = weights[r, k]
            for c in range(width):
                out[r, c] += w * shape[r, k, c + 1]


@compiled
def seen_back(weights, left, tau, shape, g_seen, g_weights, out):  # type: ignore[no-untyped-def]
    """Fills ``out`` (R, S, C), the gradient of ``shape``, whose first channel is the log density.

    ``left`` (R, S) is the transmittance behind each interval, ``tau`` (R, S) density times length,
    0 where the density is at its limit; the last interval is opaque. ``g_weights`` may be empty.
    """
    rays, samples = weights.shape
    width = g_seen.shape[1]
    zero = np.float32(0.0)
    for r in range(rays):
        behind = zero
        for j in range(samples):
            k = samples - 1 - j
            w, g = weights[r, k], zero
            for c in range(width):
                g += g_seen[r, c] * shape[r, k, c + 1]
                out[r, k, c + 1] = w * g_seen[r, c]
            if g_weights.size > 0:
                g += g_weights[r, k]
            out[r, k, 0] = zero if j == 0 else (g * left[r, k] - behind) * tau[r, k]
            behind += g * w


@compiled
def weights_back(weights, left, tau, g_weights, out):  # type: ignore[no-untyped-def]
    """Fills ``out`` (R, B), the gradient of the log density, from that of the weights; as seen_back."""
    rays, bins = weights.shape
    for r in range(rays):
        behind = np.float32(0.0)
        for j in range(bins):
            k = bins - 1 - j
            g = g_weights[r, k]
            out[r, k] = np.float32(0.0) if j == 0 else (g * left[r, k] - behind) * tau[r, k]
            behind += g * weights[r, k]


@compiled
def outer_bound(edges, weights, proposed, eps, gradient):  # type: ignore[no-untyped-def]
    """The sum over rays of the proposal's loss; fills ``gradient`` (R, B) of that sum."""
    rays, samples = weights.shape
    bins = proposed.shape[1]
    loss = 0.0
    for r in range(rays):
        for b in range(bins):
            gradient[r, b] = np.float32(0.0)
        for k in range(samples):
            first = max(0, int(np.floor(edges[r, k] * np.float32(bins))))
            last = min(bins, int(np.ceil(edges[r, k + 1] * np.float32(bins))))
            bound = np.float32(0.0)
            for b in range(first, last):
                bound += proposed[r, b]
            w = weights[r, k]
            excess = w - bound
            if not excess <= np.float32(0.0):
                loss += excess * excess / (w + eps)
                slope = np.float32(-2.0) * excess / (w + eps)
                for b in range(first, last):
                    gradient[r, b] += slope
    return loss
