"""Curves, bars and the map of cameras as SVG; colours come from the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup, escape

Curve = Sequence[tuple[float, float]]

_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 14, 28, 30
_MOST_POINTS = 300
ONE_WAY = (
    0.5  # length of the mean of the directions that cameras look in, from which they look one way
)


def curves(series: Mapping[str, Curve], *, title: str, unit: str, size: tuple[int, int]) -> Markup:
    """A line chart of named curves (x, y) with axes and a legend.

    size: (width, height) of the drawing in its own units; it scales with the page. Points that are
    not finite are left out.
    """
    drawn = {label: _usable(curve) for label, curve in series.items()}
    points = [point for curve in drawn.values() for point in curve]
    if not points:
        return Markup("")
    xs, ys = [x for x, _ in points], [y for _, y in points]
    low, high = min(ys), max(ys)
    pad = 0.06 * (high - low) or 0.5
    frame = _Frame(min(xs), max(xs) or 1, low - pad, high + pad, size)
    parts = [_axes(frame, unit), _legend(list(drawn))]
    for index, curve in enumerate(drawn.values()):
        path = " ".join(f"{frame.x(x):.1f},{frame.y(y):.1f}" for x, y in curve)
        parts.append(f'<polyline class="curve s{index}" points="{path}"/>')
    return _svg(parts, size, title)


def bars(
    series: Mapping[str, Mapping[str, float]], *, title: str, unit: str, size: tuple[int, int]
) -> Markup:
    """Grouped bars: for every name, one bar per series. The axis starts at 0."""
    names = sorted({name for values in series.values() for name in values})
    known = [v for values in series.values() for v in values.values() if math.isfinite(v)]
    if not known:
        return Markup("")
    frame = _Frame(0, len(names), 0, max(known) * 1.08 or 1, size)
    parts, slot = [_axes(frame, unit, numbered=False)], 0.8 / len(series)
    parts.append(_legend(list(series)))
    for index, (label, values) in enumerate(series.items()):
        for place, name in enumerate(names):
            value = values.get(name, math.nan)
            if not math.isfinite(value):
                continue
            left, right = (frame.x(place + 0.1 + slot * (index + edge)) for edge in (0, 1))
            top, bottom = frame.y(value), frame.y(0)
            parts.append(
                f'<rect class="bar s{index}" x="{left:.1f}" y="{top:.1f}" rx="1.5"'
                f' width="{max(right - left - 1, 1):.1f}" height="{max(bottom - top, 0):.1f}">'
                f"<title>{escape(name)}, {escape(label)}: {value:.3g} {escape(unit)}</title></rect>"
            )
    if len(names) * 60 <= size[0]:
        parts += [
            f'<text class="tick" text-anchor="middle" x="{frame.x(place + 0.5):.1f}"'
            f' y="{size[1] - 10}">{escape(_short(name))}</text>'
            for place, name in enumerate(names)
        ]
    return _svg(parts, size, title)


def camera_map(
    cameras: Mapping[str, np.ndarray],
    held_out: set[str],
    *,
    size: tuple[int, int],
    side: bool = False,
) -> Markup:
    """The cameras from above: where each stands and looks, held-out ones in the second colour.

    cameras: `cam_from_world` (4, 4) by name. "Above" is against the mean of the cameras' downward
    axes. `side`: seen from the right instead, up staying up; where they look one way, it is marked.
    """
    if not cameras:
        return Markup("")
    worlds = {name: np.linalg.inv(pose) for name, pose in cameras.items()}
    stack = np.stack(list(worlds.values()))
    up = -stack[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up) or 1
    ahead = stack[:, :3, 2].mean(axis=0)
    one_way = float(np.linalg.norm(ahead)) > ONE_WAY
    ahead = ahead - up * (ahead @ up)
    if np.linalg.norm(ahead) < 1e-6:  # they look all around
        ahead = np.cross(up, stack[0, :3, 0])
    ahead /= np.linalg.norm(ahead)
    # Right and, downwards in the drawing, back; from the side, ahead and down.
    plane = np.stack([ahead, -up] if side else [np.cross(ahead, up), -ahead])
    flat = {name: plane @ world[:3, 3] for name, world in worlds.items()}
    spread = np.stack(list(flat.values()))
    extent = np.maximum(np.ptp(spread, axis=0), 1e-9)
    scale = float(((np.array(size) - 80) / extent).min())
    middle = (spread.max(axis=0) + spread.min(axis=0)) / 2
    parts = []
    for name, world in worlds.items():
        x, y = (flat[name] - middle) * scale + np.array(size) / 2
        look, wide = plane @ world[:3, 2], plane @ world[:3, 1 if side else 0]
        tips = [
            (x, y),
            *((x + s[0], y + s[1]) for s in (22 * look + 9 * wide, 22 * look - 9 * wide)),
        ]
        shape = " ".join(f"{px:.1f},{py:.1f}" for px, py in tips)
        kind = "s1" if name in held_out else "s0"
        parts.append(
            f'<g class="camera {kind}"><polygon points="{shape}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2"/><title>{escape(name)}</title></g>'
        )
    if side and one_way:
        place = f'x="{size[0] - 10}" y="{size[1] - 8}"'
        parts.append(f'<text class="tick" text-anchor="end" {place}>ahead →</text>')
    return _svg(parts, size, "Cameras seen from the side" if side else "Cameras seen from above")


class _Frame:
    """From numbers to places in the drawing."""

    def __init__(
        self, left: float, right: float, low: float, high: float, size: tuple[int, int]
    ) -> None:
        self.left, self.right, self.low, self.high, self.size = left, right, low, high, size

    def x(self, value: float) -> float:
        share = (value - self.left) / ((self.right - self.left) or 1)
        return _LEFT + share * (self.size[0] - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        share = (value - self.low) / ((self.high - self.low) or 1)
        return self.size[1] - _BOTTOM - share * (self.size[1] - _TOP - _BOTTOM)


def _usable(curve: Curve) -> list[tuple[float, float]]:
    kept = [(x, y) for x, y in curve if math.isfinite(x) and math.isfinite(y)]
    stride = math.ceil(len(kept) / _MOST_POINTS) or 1
    return kept[::stride] if stride == 1 else [*kept[::stride], kept[-1]]


def _axes(frame: _Frame, unit: str, numbered: bool = True) -> str:
    width, height = frame.size
    parts = []
    for value in _round_steps(frame.low, frame.high):
        y = frame.y(value)
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{width - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text class="tick" text-anchor="end" x="{_LEFT - 6}" y="{y + 3.5:.1f}">{value:g}</text>'
        )
    if numbered:
        for value in _round_steps(frame.left, frame.right):
            parts.append(
                f'<text class="tick" text-anchor="middle" x="{frame.x(value):.1f}"'
                f' y="{height - 10}">{value:g}</text>'
            )
    if unit:
        label = f'<text class="tick" text-anchor="end" x="{_LEFT - 6}" y="12">{escape(unit)}</text>'
        parts.append(label)
    return "".join(parts)


def _round_steps(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers within [low, high], about `wanted` of them."""
    raw = (high - low) / wanted or 1
    base = 10.0 ** math.floor(math.log10(raw))
    step = next(base * m for m in (1, 2, 2.5, 5, 10) if base * m >= raw)
    first = math.ceil(low / step - 1e-9)
    return [round(i * step, 10) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _legend(labels: Sequence[str]) -> str:
    if len(labels) < 2:
        return ""
    spans = [
        f'<tspan class="s{i}" dx="{14 * (i > 0)}">{escape(text)}</tspan>'
        for i, text in enumerate(labels)
    ]
    return f'<text class="legend" x="{_LEFT + 4}" y="12">{"".join(spans)}</text>'


def _short(name: str) -> str:
    stem = name.rsplit(".", 1)[0]
    return stem if len(stem) <= 9 else "…" + stem[-8:]


def _svg(parts: Sequence[str], size: tuple[int, int], title: str) -> Markup:
    return Markup(
        f'<svg viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{escape(title)}">'
        + "".join(parts)
        + "</svg>"
    )
