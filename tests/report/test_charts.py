from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET

import numpy as np

from pipeline.report.charts import bars, camera_map, curves

SIZE = (400, 200)


def test_a_curve_goes_from_its_first_to_its_last_point():
    drawing = curves({"a": [(0, 1.0), (10, 3.0)]}, title="x", unit="dB", size=SIZE)
    ET.fromstring(drawing)
    points = re.search(r'points="([^"]+)"', drawing).group(1).split()
    (x0, y0), (x1, y1) = (tuple(map(float, point.split(","))) for point in points)
    assert x0 == 46 and x1 == 386
    assert y0 > y1, "larger values are higher up"


def test_points_that_cannot_be_drawn_are_left_out():
    curve = [(0, 1.0), (1, math.nan), (2, math.inf), (4, 0.1)]
    drawing = curves({"a": curve}, title="x", unit="", size=SIZE)
    assert len(re.search(r'points="([^"]+)"', drawing).group(1).split()) == 2
    assert "nan" not in drawing and "inf" not in drawing
    assert curves({"a": [(0, math.nan)]}, title="x", unit="", size=SIZE) == ""


def test_an_axis_has_numbers_within_it_whatever_its_range() -> None:
    for low, high in ((20.0, 20.3), (0.0055, 0.0095), (3.0, 4000.0), (5.0, 5.0)):
        drawing = curves({"a": [(0, low), (1, high)]}, title="x", unit="", size=SIZE)
        ticks = [float(t) for t in re.findall(r'text-anchor="end"[^>]*>([\d.]+)<', drawing)]
        pad = 0.06 * (high - low) or 0.5
        assert len(ticks) >= 2 and all(low - pad <= tick <= high + pad for tick in ticks)


def test_ahead_is_marked_where_the_cameras_look_one_way() -> None:
    one_way, around = {}, {}
    for n in range(8):
        one_way[f"{n}"], around[f"{n}"] = np.eye(4), np.eye(4)
        one_way[f"{n}"][0, 3] = n
        turn = 2 * np.pi * n / 8
        around[f"{n}"][[0, 0, 2, 2], [0, 2, 0, 2]] = (
            np.cos(turn),
            -np.sin(turn),
            np.sin(turn),
            np.cos(turn),
        )
        around[f"{n}"][2, 3] = 3.0
    assert "ahead" in camera_map(one_way, set(), size=SIZE, side=True)
    assert "ahead" not in camera_map(one_way, set(), size=SIZE)
    assert "ahead" not in camera_map(around, set(), size=SIZE, side=True)


def test_long_curves_are_thinned_and_keep_their_end():
    drawing = curves({"a": [(i, float(i)) for i in range(5000)]}, title="x", unit="", size=SIZE)
    points = re.search(r'points="([^"]+)"', drawing).group(1).split()
    assert len(points) <= 301
    assert points[-1].startswith("386.0,")


def test_bars_grow_with_their_values_and_names_are_escaped():
    values = {"a<b>.png": 10.0, "c.png": 20.0, "d.png": math.inf}
    drawing = bars({"one": values}, title="x", unit="dB", size=SIZE)
    ET.fromstring(drawing)
    heights = [float(h) for h in re.findall(r'<rect[^>]*height="([\d.]+)"', drawing)]
    assert len(heights) == 2 and math.isclose(heights[1], 2 * heights[0], abs_tol=0.11)
    assert "a&lt;b&gt;.png" in drawing and "<b>" not in drawing
    assert bars({"one": {}}, title="x", unit="", size=SIZE) == ""


def test_cameras_stand_as_seen_from_above():
    """Two cameras side by side looking ahead: left is left, and they look up the page."""
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = 1.0, -1.0  # cam_from_world: centres at x = -1 and x = +1
    drawing = camera_map({"left": left, "right": right}, {"right"}, size=SIZE)
    ET.fromstring(drawing)
    found = re.findall(
        r'class="camera (s\d)"><polygon points="([\d.]+),([\d.]+) ([\d.]+),([\d.]+) [^"]*"/>'
        r"<circle[^>]*/><title>(\w+)",
        drawing,
    )
    places = {name: (kind, float(x), float(y), float(tip)) for kind, x, y, _, tip, name in found}
    assert places["left"][1] < places["right"][1]
    assert places["left"][3] < places["left"][2], "ahead is up the page"
    assert (places["left"][0], places["right"][0]) == ("s0", "s1")
    assert camera_map({}, set(), size=SIZE) == ""


def test_from_the_side_up_is_up() -> None:
    """Two cameras, one a metre above the other (y points down): its dot is drawn higher."""
    low, high = np.eye(4), np.eye(4)
    high[1, 3] = 1.0  # its centre lies at y = -1
    drawn = camera_map({"low": low, "high": high}, set(), size=(300, 200), side=True)
    heights = [float(y) for y in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)"', drawn)]
    assert heights[1] < heights[0]
