"""A table of a comparison: lines, grouped columns, a cell of seeds' values where they meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.tables.statistics import better_beyond_spread, mean

Values = tuple[float, ...]


@dataclass(frozen=True)
class Line:
    """A row: its key and label. One that does not `compete` (a limit, other views) is never the best."""

    key: str
    label: str
    competes: bool = True


@dataclass(frozen=True)
class Column:
    """A column: key, the group that it stands under, heading, digits behind the point.

    `higher`: whether more is better; None where nothing is better or worse.
    """

    key: str
    group: str
    heading: str
    digits: int
    higher: bool | None = True

    @property
    def arrow(self) -> str:
        """Which way is better: "↑", "↓" or nothing."""
        return {True: "↑", False: "↓", None: ""}[self.higher]


@dataclass(frozen=True)
class Table:
    """A table by name and title. `cells`: the values of the seeds by (line, column); `missing`: why there
    are none, or not all, by the same keys; `marked`: cells beyond the spread in their own right;
    `notes`: sentences.
    """

    name: str
    title: str
    lines: tuple[Line, ...]
    columns: tuple[Column, ...]
    cells: Mapping[tuple[str, str], Values]
    missing: Mapping[tuple[str, str], str] = field(default_factory=dict)
    marked: frozenset[tuple[str, str]] = frozenset()
    notes: tuple[str, ...] = ()

    def values(self, line: Line, column: Column) -> Values:
        """The values of a cell, empty where there are none."""
        return self.cells.get((line.key, column.key), ())


def best(table: Table, column: Column) -> tuple[str, bool] | None:
    """The key of the best competing line of a column, and whether it is ahead of every other competing
    line by more than the spreads; None where nothing competes or fewer than two lines have values.

    Lines whose means are equal when printed share no first place: the first of them has it, unclaimed.
    Nor is anything claimed beside a line with a single value that lacks others: its spread is not known.
    """
    known = [one for one in table.lines if one.competes and table.values(one, column)]
    if column.higher is None or len(known) < 2:
        return None
    sign = 1.0 if column.higher else -1.0

    def printed(line: Line) -> float:
        return sign * round(mean(table.values(line, column)), column.digits)

    first = max(known, key=printed)
    partly = [one for one in known if (one.key, column.key) in table.missing]
    ahead = all(len(table.values(one, column)) > 1 for one in partly) and all(
        printed(first) > printed(one)
        and better_beyond_spread(
            table.values(first, column), table.values(one, column), higher=column.higher
        )
        for one in known
        if one is not first
    )
    return first.key, ahead


def gaps(table: Table) -> list[tuple[str, list[str]]]:
    """Why cells are empty, or lack some of their values, each reason with its cells, as "line, group".

    A line that lacks something in every one of several groups is told once.
    """
    groups = list(dict.fromkeys(column.group for column in table.columns))
    told: dict[str, dict[str, list[str]]] = {}
    for line in table.lines:
        for column in table.columns:
            key = (line.key, column.key)
            if not table.values(line, column) or key in table.missing:
                why = table.missing.get(key, "not computed")
                some = told.setdefault(why, {}).setdefault(line.label, [])
                if column.group not in some:
                    some.append(column.group)
    return [
        (why, [place for label, some in lines.items() for place in _places(label, some, groups)])
        for why, lines in told.items()
    ]


def _places(label: str, some: list[str], groups: list[str]) -> list[str]:
    if len(groups) > 1 and some == groups:
        return [label]
    return [f"{label}, {group}" if group else label for group in some]
