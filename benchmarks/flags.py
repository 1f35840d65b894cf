"""What the command line of a benchmark says, or why it cannot be meant: nothing is passed over."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from stages.nerf import Params

PARAMS = Path(__file__).resolve().parents[1] / "params.yaml"


def settings_of(
    parser: argparse.ArgumentParser, pairs: Iterable[str], used: Collection[str]
) -> dict[str, Any]:
    """The section `nerf` of params.yaml with the KEY=VALUE of `--set` in it.

    Refused are keys that there are not or that the benchmark does not use, and values out of range.
    """
    settings = yaml.safe_load(PARAMS.read_text(encoding="utf-8"))["nerf"]
    try:
        for pair in pairs:
            key, equals, value = pair.partition("=")
            if not equals:
                parser.error(f"--set {pair}: write KEY=VALUE")
            if key not in settings:
                parser.error(f"--set {pair}: the section nerf of params.yaml has no {key}")
            if key not in used:
                parser.error(f"--set {pair}: {key} has no effect here; of use are {_told(used)}")
            settings[key] = yaml.safe_load(value)
        return Params.model_validate(settings).model_dump()
    except ValidationError as error:
        first = error.errors()[0]
        parser.error(f"--set: nerf.{'.'.join(map(str, first['loc']))}: {first['msg']}")
    except yaml.YAMLError:
        parser.error(f"--set {pair}: {value} is no value")


def rows_of(parser: argparse.ArgumentParser, text: str, known: Iterable[str]) -> list[str]:
    """The rows that `--rows` names, between commas; one that is not known is refused."""
    rows, known = text.split(","), list(known)
    for row in rows:
        if row not in known:
            parser.error(f"--rows: there is no row {row!r}; there are {_told(known)}")
    return rows


def _told(names: Iterable[str]) -> str:
    return ", ".join(names)
