"""What a JSON file must hold, told as a type, and where one holds something else."""

from __future__ import annotations

import dataclasses
import functools
import sys
import types
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

Shape = Any  # a type, or a mapping of names to shapes: mypy cannot tell more

_CALLED: Mapping[Any, str] = {
    bool: "true or false", int: "a whole number", float: "a number", str: "text", types.NoneType: "null",
    list: "a list", tuple: "a list", dict: "names with values",
}  # fmt: skip


def misfit(content: Any, shape: Shape, where: str = "") -> str:
    """Where in `content` something else stands than `shape` says, and what should; "" where all fits.

    `shape` is a type as annotations write it: bool, int, float (finite), str, None, Any, a union, a
    Literal, list[...], tuple[..., ...], dict[str, ...], dict[int, ...] (names that are numbers, as JSON has
    them), a dataclass; or a mapping of names to such types, where "name?" may be absent. Further names do
    no harm.
    """
    origin: Any = get_origin(shape)
    inside = get_args(shape)
    named = isinstance(shape, Mapping) or dataclasses.is_dataclass(shape)
    if shape is Any:
        fits = True
    elif origin in (Union, types.UnionType):
        fits = any(not misfit(content, one) for one in inside)
    elif origin is Literal:
        fits = isinstance(content, str | int) and content in inside
    elif origin in (list, tuple) and isinstance(content, list):
        return _first((value, inside[0], f"{where}[{i}]") for i, value in enumerate(content))
    elif origin is dict and isinstance(content, dict):
        odd = [] if inside[0] is str else [name for name in content if not name.isdecimal()]
        parts = ((value, inside[1], _at(where, name)) for name, value in content.items())
        return f"{_at(where, odd[0])} should have a number for a name" if odd else _first(parts)
    elif named and isinstance(content, dict):
        return _members(content, shape, where)
    else:
        fits = not named and origin is None and _plain(content, shape)
    return "" if fits else f"{where or 'it'} should be {_called(shape)}"


def _members(content: dict[str, Any], shape: Shape, where: str) -> str:
    kinds = {name.rstrip("?"): kind for name, kind in _kinds(shape).items()}
    absent = next((name for name in _needed(shape) if name not in content), "")
    if absent:
        return f"{_at(where, absent)} is missing"
    present = (name for name in kinds if name in content)
    return _first((content[name], kinds[name], _at(where, name)) for name in present)


def _kinds(shape: Shape) -> Mapping[str, Any]:
    return shape if isinstance(shape, Mapping) else _hints(shape)


@functools.cache  # evaluating annotations costs more than all else, and lists hold hundreds of one kind
def _hints(shape: type) -> Mapping[str, Any]:
    return get_type_hints(shape)


def _needed(shape: Shape) -> list[str]:
    if isinstance(shape, Mapping):
        return [name for name in shape if not name.endswith("?")]
    absent = dataclasses.MISSING
    return [
        field.name
        for field in dataclasses.fields(shape)
        if field.default is absent and field.default_factory is absent
    ]


def _plain(content: Any, kind: Any) -> bool:
    if isinstance(content, bool):
        return kind is bool
    if kind is float:
        return isinstance(content, int | float) and abs(content) <= sys.float_info.max
    return isinstance(content, types.NoneType if kind is None else kind)


def _first(parts: Iterable[tuple[Any, Any, str]]) -> str:
    return next((fault for part in parts if (fault := misfit(*part))), "")


def _at(where: str, name: str) -> str:
    name = name or '""'
    return f"{where}.{name}" if where else name


def _called(shape: Shape) -> str:
    origin: Any = get_origin(shape)
    if origin in (Union, types.UnionType):
        return " or ".join(_called(one) for one in get_args(shape))
    if origin is Literal:
        return " or ".join(str(one) for one in get_args(shape))
    if isinstance(shape, Mapping) or dataclasses.is_dataclass(shape):
        return _CALLED[dict]
    return _CALLED[origin or (types.NoneType if shape is None else shape)]
