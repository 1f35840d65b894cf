from __future__ import annotations

import csv
import io

from pipeline.tables.layout import Column, Line, Table, best, gaps
from pipeline.tables.writers import as_csv, escape, latex, markdown

PSNR, FLIP = Column("psnr", "street", "PSNR", 2), Column("flip", "street", "FLIP", 3, False)
TABLE = Table(
    "made",
    "Made up",
    (Line("a", "A & B"), Line("c", "C_1"), Line("d", "D"), Line("top", "limit", competes=False)),
    (PSNR, FLIP),
    {
        ("a", "psnr"): (20.0, 21.0, 22.0),
        ("c", "psnr"): (25.0, 26.0, 27.0),
        ("d", "psnr"): (19.0,),
        ("top", "psnr"): (40.0,),
        ("a", "flip"): (0.2, 0.3),
        ("c", "flip"): (0.21, 0.31),
        ("top", "flip"): (0.01,),
    },
    {("d", "flip"): "no FLIP here"},
    notes=("A note.",),
)


def test_the_best_is_the_highest_or_the_lowest_of_those_that_compete() -> None:
    """C is 5 dB ahead of A with spreads of 1 each; A's FLIP is 0.01 lower with spreads of 0.07."""
    assert best(TABLE, PSNR) == ("c", True)
    assert best(TABLE, FLIP) == ("a", False)


def test_nothing_is_best_of_one_or_where_nothing_is_better() -> None:
    alone = Table("t", "t", TABLE.lines, (PSNR,), {("a", "psnr"): (1.0,), ("top", "psnr"): (2.0,)})
    assert best(alone, PSNR) is None
    assert best(TABLE, Column("psnr", "", "PSNR", 2, None)) is None


def test_the_best_is_bold_and_starred_only_beyond_the_spread() -> None:
    rows = markdown(TABLE).splitlines()
    assert rows[2] == "|  | street PSNR↑ | street FLIP↓ |"
    assert rows[4] == "| A & B | 21.00 ± 1.00 | **0.250 ± 0.071** |"
    assert rows[5] == r"| C_1 | **26.00 ± 1.00**\* | 0.260 ± 0.071 |"
    assert rows[6] == "| D | 19.00 | – |"
    assert rows[7] == "| limit | 40.00 | 0.010 |"


def test_what_is_missing_is_said_with_its_reason() -> None:
    assert gaps(TABLE) == [("no FLIP here", ["D, street"])]
    assert "– D, street: no FLIP here." in markdown(TABLE)
    some = Table(
        "t", "t", TABLE.lines[:1], (PSNR,), {("a", "psnr"): (1.0,)}, {("a", "psnr"): "one seed"}
    )
    assert gaps(some) == [("one seed", ["A & B, street"])]
    unsaid = Table("t", "t", TABLE.lines[:1], (PSNR,), {})
    assert gaps(unsaid) == [("not computed", ["A & B, street"])]


def test_latex_has_the_papers_layout_and_escapes() -> None:
    text = latex(TABLE)
    assert r"\begin{tabular}{l|cc}" in text
    assert r"& \multicolumn{2}{c}{street} \\" in text
    assert r"& PSNR$\uparrow$ & FLIP$\downarrow$ \\" in text
    assert r"A \& B & 21.00 $\pm$ 1.00 & \textbf{0.250 $\pm$ 0.071} \\" in text
    assert r"C\_1 & \textbf{26.00 $\pm$ 1.00}* & 0.260 $\pm$ 0.071 \\" in text
    assert escape("50% of {x}~y^2 #1 $ \\") == (
        r"50\% of \{x\}\textasciitilde{}y\textasciicircum{}2 \#1 \$ \textbackslash{}"
    )


def test_csv_has_a_line_per_cell() -> None:
    rows = list(csv.DictReader(io.StringIO(as_csv(TABLE))))
    assert len(rows) == 8
    c = next(row for row in rows if row["row"] == "C_1" and row["number"] == "PSNR")
    assert (c["mean"], c["spread"], c["seeds"]) == ("26", "1", "3")
    assert (c["best"], c["beyond_spread"]) == ("1", "1")
    d = next(row for row in rows if row["row"] == "D" and row["number"] == "FLIP")
    assert (d["mean"], d["seeds"], d["missing"]) == ("", "0", "no FLIP here")


def test_a_marked_cell_is_starred_without_being_best() -> None:
    gain = Column("g", "here", "street", 2, None)
    table = Table(
        "t", "t", (Line("x", "x"),), (gain,), {("x", "g"): (-1.5,)}, marked=frozenset({("x", "g")})
    )
    assert r"| x | -1.50\* |" in markdown(table)
    assert "x & -1.50* " in latex(table)
