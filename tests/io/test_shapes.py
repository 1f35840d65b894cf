from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from pipeline.io.shapes import misfit


@dataclass
class Photo:
    name: str
    focal: float | None
    split: Literal["train", "test"]
    said: list[str] = field(default_factory=list)


GOOD = {"name": "a.png", "focal": None, "split": "test"}


@pytest.mark.parametrize(
    ("content", "shape"),
    [
        (3, float),  # JSON writes 3.0 as it likes
        (GOOD, Photo),
        (GOOD | {"added": "by a later version"}, Photo),
        ({"0": 1.5}, dict[int, float]),
        ({"a": {"b": [1]}}, dict[str, Any]),
        ({"mode": "lens"}, {"mode": str, "why?": str}),
        (None, float | None),
    ],
)
def test_what_fits(content: Any, shape: Any) -> None:
    assert misfit(content, shape) == ""


@pytest.mark.parametrize(
    ("content", "shape", "told"),
    [
        (True, int, "it should be a whole number"),
        (1.5, int, "it should be a whole number"),
        (float("nan"), float, "it should be a number"),
        (10**400, float, "it should be a number"),
        ([], dict[str, Any], "it should be names with values"),
        ({}, list[str], "it should be a list"),
        ({"a": [1, "2"]}, dict[str, list[int]], "a[1] should be a whole number"),
        ({"first": 1.0}, dict[int, float], "first should have a number for a name"),
        ({"": 1.0}, dict[int, float], '"" should have a number for a name'),
        ("a", Photo, "it should be names with values"),
        ({"images": [GOOD, {"name": "b"}]}, {"images": list[Photo]}, "images[1].focal is missing"),
        (GOOD | {"focal": "wide"}, Photo, "focal should be a number or null"),
        (GOOD | {"split": []}, Photo, "split should be train or test"),
        (GOOD | {"said": [None]}, Photo, "said[0] should be text"),
        ({}, {"mode": str}, "mode is missing"),
        ({"why": 1}, {"why?": str}, "why should be text"),
        ("", None, "it should be null"),
    ],
)
def test_what_does_not_fit_is_told_by_its_place(content: Any, shape: Any, told: str) -> None:
    assert misfit(content, shape) == told
