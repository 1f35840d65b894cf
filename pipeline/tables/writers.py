"""Tables as Markdown, CSV and LaTeX: mean ± spread, the best in bold, * where beyond the spread."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from itertools import groupby

from pipeline.tables.layout import Column, Line, Table, best, gaps
from pipeline.tables.statistics import mean, spread

MISSING = "–"
LEGEND = (
    "Bold: the best of its column. *: ahead of every other row by more than both spreads together. "
    "±: sample standard deviation over the seeds."
)
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "±": r"$\pm$", "≥": r"$\geq$", "–": "--", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
}  # fmt: skip


def markdown(table: Table) -> str:
    """The table under its title, with its legend, notes and what is missing."""
    heads = [" ".join(filter(None, (c.group, c.heading))) + c.arrow for c in table.columns]
    rows = [["", *heads], ["---", *("---:" for _ in heads)]]
    first = {column.key: best(table, column) for column in table.columns}
    for line in table.lines:
        cells = [_cell(table, line, column, first[column.key], "**") for column in table.columns]
        rows.append([line.label.replace("|", "\\|"), *cells])
    text = [f"## {table.title}", "", *("| " + " | ".join(row) + " |" for row in rows), ""]
    return "\n".join(text + [f"{note}\n" for note in _told(table)])


def as_csv(table: Table) -> str:
    """One line per cell: mean, spread, number of seeds, whether best and whether beyond the spread."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["row", "group", "number", "mean", "spread", "seeds", "best", "beyond_spread", "missing"]
    )
    for line in table.lines:
        for column in table.columns:
            values, top = table.values(line, column), best(table, column)
            row = [line.label, column.group, column.heading]
            if not values:
                why = table.missing.get((line.key, column.key), "not computed")
                writer.writerow([*row, "", "", 0, "", "", why])
                continue
            wide = spread(values)
            is_best = top is not None and top[0] == line.key
            beyond = (line.key, column.key) in table.marked or (is_best and bool(top and top[1]))
            numbers = [f"{mean(values):.6g}", "" if wide is None else f"{wide:.4g}", len(values)]
            writer.writerow([*row, *numbers, int(is_best), int(beyond), ""])
    return text.getvalue()


def latex(table: Table) -> str:
    """A `table*` in the paper's layout: groups above their columns, rules between them."""
    groups = [(name, list(some)) for name, some in groupby(table.columns, lambda c: c.group)]
    shape = "|".join(["l", *("c" * len(some) for _, some in groups)])
    above = [
        rf"\multicolumn{{{len(some)}}}{{c{'|' if i < len(groups) - 1 else ''}}}{{{escape(name)}}}"
        for i, (name, some) in enumerate(groups)
    ]
    heads = [escape(column.heading + column.arrow) for column in table.columns]
    body = []
    first = {column.key: best(table, column) for column in table.columns}
    for line in table.lines:
        cells = [_latex_cell(table, line, column, first[column.key]) for column in table.columns]
        body.append(" & ".join([escape(line.label), *cells]) + r" \\")
    notes = " ".join(escape(note) for note in _told(table))
    return "\n".join(
        [
            r"\begin{table*}",
            rf"  \caption{{{escape(table.title)}. {notes}}}",
            rf"  \label{{tab:{table.name}}}",
            r"  \resizebox{\linewidth}{!}{",
            rf"  \begin{{tabular}}{{{shape}}}",
            r"    \hline",
            "    & " + " & ".join(above) + r" \\",
            "    & " + " & ".join(heads) + r" \\",
            r"    \hline",
            *(f"    {row}" for row in body),
            r"    \hline",
            r"  \end{tabular}}",
            r"\end{table*}",
            "",
        ]
    )


def escape(text: str) -> str:
    """`text` with LaTeX's own characters, and those of the tables that it lacks, written for LaTeX."""
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _told(table: Table) -> Iterable[str]:
    if any(column.higher is not None for column in table.columns):
        yield LEGEND
    yield from table.notes
    for why, places in gaps(table):
        yield f"{MISSING} {'; '.join(places)}: {why}."


def _number(table: Table, line: Line, column: Column) -> str:
    values = table.values(line, column)
    if not values:
        return MISSING
    wide = spread(values)
    text = f"{mean(values):.{column.digits}f}"
    return text if wide is None else f"{text} ± {wide:.{column.digits}f}"


def _cell(table: Table, line: Line, column: Column, top: tuple[str, bool] | None, bold: str) -> str:
    text = _number(table, line, column)
    if top is not None and top[0] == line.key:
        return f"{bold}{text}{bold}" + (r"\*" if top[1] else "")
    return text + (r"\*" if (line.key, column.key) in table.marked else "")


def _latex_cell(table: Table, line: Line, column: Column, top: tuple[str, bool] | None) -> str:
    text = escape(_number(table, line, column))
    if top is not None and top[0] == line.key:
        return rf"\textbf{{{text}}}" + ("*" if top[1] else "")
    return text + ("*" if (line.key, column.key) in table.marked else "")
