"""Water drops on a vertical pane: outline, height field, mesh, and random panes of them.

Pane frame: x right, y down, origin where the optical axis meets the pane, z towards the scene,
metres. A drop is a spherical-cap profile over a star-shaped outline. Contact angles of water on
ordinary glass lie between about 30 and 80 degrees and differ between the upper (receding) and
lower (advancing) rim of a drop on an upright surface (ElSherbini and Jacobi 2004,
doi:10.1016/j.jcis.2003.12.067); adherent raindrops are modelled in this way for cameras behind
glass by Halimeh and Roser 2009 (doi:10.1109/IVS.2009.5164347) and You et al. 2016
(doi:10.1109/TPAMI.2015.2491937).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import UserError

Array = NDArray[np.float64]

TABLE = 1024  # directions at which a drop's outline is tabulated
WOBBLE_ORDERS = (2, 3, 4, 5)
MAX_TAIL = 3.5  # body radii
_UNION_POWER = 12.0
_TIP = 0.6  # width of a tail's end over that of its start
CONTACT_ANGLES = (np.radians(30), np.radians(80))
RUN_SHARE = 0.1  # of the drops that are large enough to run
TOLERANCE = 0.01  # of the share of a pane that drops shall cover


@dataclass(frozen=True)
class Drop:
    """One drop on the pane. Lengths in `lobes` and `tail_*` are in radii of the drop's body.

    center, radius: metres; radius is that of the circle of the same area as the outline.
    contact_angle: radians, between water and glass at the rim (averaged over the rim if sagging).
    wobble: (amplitude, phase) of the outline's waves with 2, 3, 4, 5 periods; missing ones are 0.
    lobes: (dx, dy, r) of drops merged into this one; each must contain the centre.
    sag: in [0, 0.6]; the tangent of the rim's angle is (1 + sag) times larger at the lowest point
    and (1 - sag) times at the highest, which moves the apex down.
    tail_length, tail_width: a run left above the drop; 0 for none. tail_tilt: radians, from up.
    """

    center: tuple[float, float]
    radius: float
    contact_angle: float
    wobble: tuple[tuple[float, float], ...] = ()
    lobes: tuple[tuple[float, float, float], ...] = ()
    sag: float = 0.0
    tail_length: float = 0.0
    tail_width: float = 0.5
    tail_tilt: float = 0.0


@dataclass(frozen=True)
class _Rim:
    """Outline of a drop at TABLE equally spaced directions, metres, first entry repeated last."""

    reach: Array  # centre to rim, tail included
    core: Array  # centre to rim, tail left out
    support: Array  # centre to the tangent line of the core's rim
    body: float  # radius of the body, metres
    extent: float  # the largest reach


def _circle_exit(phi: Array, dx: float, dy: float, r: float) -> Array:
    along = dx * np.cos(phi) + dy * np.sin(phi)
    return along + np.sqrt(np.maximum(along**2 + r**2 - dx**2 - dy**2, 0.0))


def _tail_exit(phi: Array, drop: Drop) -> Array:
    """Reach of the convex hull of a circle at the centre and a narrower one at the tail's end."""
    length, width, tip = drop.tail_length, drop.tail_width, _TIP * drop.tail_width
    theta = np.abs((phi + np.pi / 2 - drop.tail_tilt + np.pi) % (2 * np.pi) - np.pi)
    gamma = np.arccos(np.clip((width - tip) / length, -1.0, 1.0))
    corner = np.arctan2(tip * np.sin(gamma), length + tip * np.cos(gamma))
    side = width / np.cos(np.minimum(np.abs(gamma - theta), 1.5))
    end = length * np.cos(theta) + np.sqrt(np.maximum(tip**2 - (length * np.sin(theta)) ** 2, 0))
    return np.where(theta >= gamma, width, np.where(theta >= corner, side, end))


def _tail_height(drop: Drop, body: float, dx: Array, dy: Array) -> Array:
    """Height of the run, metres: caps along its axis, negative outside."""
    length, width = drop.tail_length, drop.tail_width
    along = dx * np.sin(drop.tail_tilt) - dy * np.cos(drop.tail_tilt)
    across = dx * np.cos(drop.tail_tilt) + dy * np.sin(drop.tail_tilt)
    taper = (1 - _TIP) * width / length
    # Foot of the normal to the hull's straight side, which leans inwards by `taper`.
    lean = taper / np.sqrt(1 - taper**2)
    foot = np.clip(along / body - np.abs(across) / body * lean, 0.0, length)
    radius = (width - taper * foot) * body
    level = np.hypot(across, along - foot * body) / radius
    return radius * _profile(level, drop.contact_angle)


def _profile(level: Array, contact_angle: float) -> Array:
    """Cap of unit base radius: height over the distance from its axis, negative beyond 1."""
    inverse = 1 / np.sin(contact_angle) ** 2
    return np.sqrt(np.maximum(inverse - level**2, 0.0)) - np.sqrt(inverse - 1)


def _rim(drop: Drop) -> _Rim:
    """Outline of the drop; the tables of its shape at unit radius are kept."""
    if not 0 < drop.contact_angle < np.pi / 2:
        raise ValueError(f"contact angle {drop.contact_angle} rad is not within (0, pi/2)")
    unit = _unit_rim(replace(drop, center=(0.0, 0.0), radius=1.0, contact_angle=1.0, sag=0.0))
    r = drop.radius
    return _Rim(unit.reach * r, unit.core * r, unit.support * r, unit.body * r, unit.extent * r)


@lru_cache(maxsize=4096)
def _unit_rim(drop: Drop) -> _Rim:
    if drop.tail_length > MAX_TAIL:
        raise ValueError(f"tail of {drop.tail_length} body radii is longer than {MAX_TAIL}")
    phi = np.linspace(0.0, 2 * np.pi, TABLE, endpoint=False)
    parts = [np.ones_like(phi)]
    for dx, dy, r in drop.lobes:
        if dx * dx + dy * dy >= r * r:
            raise ValueError(f"lobe at ({dx}, {dy}) of radius {r} does not contain the centre")
        parts.append(_circle_exit(phi, dx, dy, r))
    core = np.sum([part**_UNION_POWER for part in parts], axis=0) ** (1 / _UNION_POWER)
    wave = np.ones_like(phi)
    for order, (amplitude, phase) in zip(WOBBLE_ORDERS, drop.wobble, strict=False):
        wave += amplitude * np.cos(order * phi + phase)
    core = core * np.maximum(wave, 0.3)
    full = core
    if drop.tail_length > 0:
        full = np.maximum(core, _tail_exit(phi, drop))
    body = 1.0 / np.sqrt(np.mean(full**2))
    slope = (np.roll(core, -1) - np.roll(core, 1)) / (4 * np.pi / TABLE)
    support = core**2 / np.sqrt(core**2 + slope**2)
    full, core, support = (np.append(table, table[0]) * body for table in (full, core, support))
    return _Rim(full, core, support, float(body), float(full.max()))


def _lookup(table: Array, phi: Array) -> Array:
    position = (phi % (2 * np.pi)) * (TABLE / (2 * np.pi))
    low = np.minimum(position.astype(np.intp), TABLE - 1)
    part = position - low
    return table[low] * (1 - part) + table[low + 1] * part


def reach(drop: Drop) -> float:
    """Largest distance from the drop's centre to its outline, metres."""
    return _rim(drop).extent


def outline(drop: Drop, n: int = 64) -> Array:
    """Outline of the drop as (n, 2) pane points, metres, evenly spaced along its length.

    Angles run from +x towards +y (clockwise as seen by the camera, since y is down).
    """
    rim = _rim(drop).reach
    phi = np.linspace(0.0, 2 * np.pi, TABLE + 1)
    points = np.stack([rim * np.cos(phi), rim * np.sin(phi)], axis=1)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    chosen = np.interp(np.linspace(0.0, length[-1], n, endpoint=False), length, phi)
    chosen_reach = _lookup(rim, chosen)
    around = np.stack([np.cos(chosen), np.sin(chosen)], axis=1)
    return np.asarray(drop.center) + chosen_reach[:, None] * around


def height(drop: Drop, x: NDArray, y: NDArray) -> Array:
    """Thickness of the water at pane points (x, y), metres; 0 outside. x and y are broadcast.

    The profile is that of a spherical cap, stretched to the outline: circles near the centre, the
    outline at the rim. Its slope at the rim is tan(contact_angle) times 1 + sag * sin(direction),
    except where lobes reach much further than the body, where it is lower.
    """
    return np.maximum(extended_height(drop, x, y), 0.0)


def extended_height(drop: Drop, x: NDArray, y: NDArray) -> Array:
    """As `height`, but falling below 0 just outside the rim, so that its slope can be measured."""
    rim = _rim(drop)
    dx = np.asarray(x, dtype=np.float64) - drop.center[0]
    dy = np.asarray(y, dtype=np.float64) - drop.center[1]
    distance = np.hypot(dx, dy)
    phi = np.arctan2(dy, dx)
    edge = _lookup(rim.core, phi)
    rho = np.minimum(distance / edge, 1.0)
    # Zero slope of the blend at the rim keeps the slope of the profile there.
    blend = rho * rho * (3 - 2 * rho)
    level_radius = rim.body + (edge - rim.body) * blend
    rim_scale = np.minimum(_lookup(rim.support, phi), 1.25 * rim.body)
    scale = rim.body + (rim_scale - rim.body) * blend
    lean = 1 + drop.sag * dy / np.maximum(level_radius, distance)
    core = scale * lean * _profile(distance / level_radius, drop.contact_angle)
    if drop.tail_length <= 0:
        return core
    tail = _tail_height(drop, rim.body, dx, dy)
    # A fillet where the run leaves the drop, inside both so that the outline stays.
    fillet = 0.3 * np.maximum(np.minimum(core, tail), 0.0)
    return np.maximum(core, tail) + fillet


def mesh(drop: Drop, n_phi: int = 48, n_rho: int = 14) -> tuple[Array, NDArray[np.int64]]:
    """Closed surface of the drop: vertices (V, 3) in the pane frame, metres, and faces (F, 3).

    Flat base on the pane (z = 0, facing the camera), cap towards the scene (z > 0). Faces are
    wound so that (b - a) x (c - a) points out of the water.
    """
    rim_points = outline(drop, n_phi) - np.asarray(drop.center)
    rho = np.sin(np.pi / 2 * np.arange(1, n_rho + 1) / n_rho)  # denser where the cap is steep
    plane = (rho[:, None, None] * rim_points).reshape(-1, 2) + np.asarray(drop.center)
    z = height(drop, plane[:, 0], plane[:, 1])
    z[-n_phi:] = 0.0
    centre = np.asarray(drop.center)
    top = height(drop, centre[:1], centre[1:])
    vertices = np.concatenate(
        [[[*centre, top[0]]], np.column_stack([plane, z]), [[*centre, 0.0]]], axis=0
    )
    here = np.arange(n_phi)
    after = (here + 1) % n_phi
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + after], axis=1)]
    for ring in range(n_rho - 1):
        inner, outer = 1 + ring * n_phi, 1 + (ring + 1) * n_phi
        faces.append(np.stack([inner + here, outer + here, outer + after], axis=1))
        faces.append(np.stack([inner + here, outer + after, inner + after], axis=1))
    last = 1 + (n_rho - 1) * n_phi
    base = np.full_like(here, len(vertices) - 1)
    faces.append(np.stack([base, last + after, last + here], axis=1))
    return vertices, np.concatenate(faces).astype(np.int64)


def sample_drop(
    rng: np.random.Generator,
    center: tuple[float, float],
    radius: float,
    *,
    merged_share: float = 0.3,
    run_share: float = RUN_SHARE,
    irregularity: float = 1.0,
) -> Drop:
    """One random drop of the given place and size.

    merged_share, run_share: probability of merged lobes and of a run above the drop;
    irregularity scales the outline's waves (0: round).
    """
    falloff = np.array([0.09, 0.05, 0.03, 0.02]) * irregularity
    amplitude = falloff * rng.uniform(0.0, 1.0, 4)
    phase = rng.uniform(0.0, 2 * np.pi, 4)
    lobes = []
    if rng.random() < merged_share:
        for _ in range(int(rng.integers(1, 3))):
            r = rng.uniform(0.6, 1.0)
            away, toward = rng.uniform(0.4, 0.85) * r, rng.uniform(0.0, 2 * np.pi)
            lobes.append((float(away * np.cos(toward)), float(away * np.sin(toward)), float(r)))
    runs = rng.random() < run_share
    return Drop(
        center=(float(center[0]), float(center[1])),
        radius=float(radius),
        contact_angle=float(rng.uniform(*CONTACT_ANGLES)),
        wobble=tuple((float(a), float(p)) for a, p in zip(amplitude, phase, strict=True)),
        lobes=tuple(lobes),
        sag=float(rng.uniform(0.0, 0.35)),
        tail_length=float(rng.uniform(1.3, MAX_TAIL)) if runs else 0.0,
        tail_width=float(rng.uniform(0.25, 0.7)),
        tail_tilt=float(rng.normal(0.0, 0.08)),
    )


def _window(drop: Drop, shape: tuple[int, int], pitch: float) -> tuple[slice, slice]:
    """Rows and columns of a raster, pane origin at its centre, that the drop can touch."""
    extent = reach(drop) + pitch
    column, row = np.asarray(drop.center) / pitch + np.array([shape[1], shape[0]]) / 2
    half = extent / pitch
    return (
        slice(max(int(row - half), 0), max(min(int(row + half) + 1, shape[0]), 0)),
        slice(max(int(column - half), 0), max(min(int(column + half) + 1, shape[1]), 0)),
    )


def _stamp(
    drop: Drop, window: tuple[slice, slice], shape: tuple[int, int], pitch: float, gap: float = 0.0
) -> NDArray[np.bool_]:
    """Pixels of the window whose centres lie within `gap` of the drop (along its radii)."""
    rows, columns = window
    dy = (np.arange(rows.start, rows.stop) + 0.5 - shape[0] / 2) * pitch - drop.center[1]
    dx = (np.arange(columns.start, columns.stop) + 0.5 - shape[1] / 2) * pitch - drop.center[0]
    distance = np.hypot(dx[None, :], dy[:, None])
    edge = _lookup(_rim(drop).reach, np.arctan2(dy[:, None], dx[None, :]))
    return distance < edge + gap


def coverage_raster(
    drops: list[Drop], half_width: float, half_height: float, metres_per_pixel: float
) -> NDArray[np.bool_]:
    """Which pixel centres of the pane rectangle lie inside any drop: (height, width) bool."""
    shape = (round(2 * half_height / metres_per_pixel), round(2 * half_width / metres_per_pixel))
    raster = np.zeros(shape, np.bool_)
    for drop in drops:
        window = _window(drop, shape, metres_per_pixel)
        raster[window] |= _stamp(drop, window, shape, metres_per_pixel)
    return raster


def sample_drops(
    rng: np.random.Generator,
    half_width: float,
    half_height: float,
    coverage: float,
    radius_range: tuple[float, float],
    *,
    resolution: int = 512,
    max_tries: int = 100000,
) -> list[Drop]:
    """Random drops, none overlapping another, that cover `coverage` of the pane rectangle.

    The share is measured on a raster with `resolution` pixels along the longer side and reached
    within TOLERANCE. half_width, half_height, radius_range: metres; the logarithms of the radii are
    uniform. Only drops beyond a fifth of the largest radius leave runs. Raises UserError if the share
    cannot be reached with drops of these sizes.
    """
    low, high = radius_range
    pitch = 2 * max(half_width, half_height) / resolution
    pad = int(np.ceil(4 * high / pitch)) + 4
    rows, columns = round(2 * half_height / pitch), round(2 * half_width / pitch)
    taken = np.zeros((rows + 2 * pad, columns + 2 * pad), np.bool_)
    inside = (slice(pad, pad + rows), slice(pad, pad + columns))
    drops: list[Drop] = []
    covered = 0.0
    for _ in range(max_tries):
        if covered >= coverage - 0.5 * TOLERANCE:
            return drops
        radius = float(low * (high / low) ** rng.random())
        center = (
            float(rng.uniform(-half_width - radius, half_width + radius)),
            float(rng.uniform(-half_height - radius, half_height + radius)),
        )
        row, column = (int(center[k] / pitch + taken.shape[1 - k] / 2) for k in (1, 0))
        if taken[row, column]:
            continue
        run_share = RUN_SHARE if radius > 0.2 * high else 0.0
        drop = sample_drop(rng, center, radius, run_share=run_share)
        added = _place(taken, inside, drop, pitch, coverage + 0.8 * TOLERANCE - covered)
        if added > 0:
            covered += added
            drops.append(drop)
    raise UserError(
        f"drops of radius {low:.4g}-{high:.4g} m cover only "
        f"{covered:.3f} of the pane, not {coverage:.3f}",
        hint="Lower synthesize.coverage, or the smaller of synthesize.radius_mm.",
    )


def _place(
    taken: NDArray[np.bool_],
    inside: tuple[slice, slice],
    drop: Drop,
    pitch: float,
    room: float,
) -> float:
    """The share of the inside that the drop covers, once it is marked on `taken`.

    0, and nothing is marked, where the drop touches another, adds more than `room`, or lies outside.
    """
    window = _window(drop, taken.shape, pitch)
    if np.any(taken[window] & _stamp(drop, window, taken.shape, pitch, pitch)):
        return 0.0
    stamp = _stamp(drop, window, taken.shape, pitch)
    pixels = np.count_nonzero(stamp)
    rows, columns = (
        slice(max(full.start - part.start, 0), max(full.stop - part.start, 0))
        for full, part in zip(inside, window, strict=True)
    )
    # The outline's exact area, cut down by the raster: small drops are smaller than a pixel.
    part_inside = np.count_nonzero(stamp[rows, columns]) / pixels if pixels else 1.0
    pane = (inside[0].stop - inside[0].start) * (inside[1].stop - inside[1].start) * pitch**2
    added = part_inside * np.pi * drop.radius**2 / pane
    if added > room:
        return 0.0
    taken[window] |= stamp
    return float(added)
