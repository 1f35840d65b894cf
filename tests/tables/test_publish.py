"""The tables in docs/results.md are those that the comparison wrote."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.tables.publish import filled, narrowed, refreshed, table_under

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = """# Tables

## One

|  | a PSNR↑ | a SSIM↑ | b PSNR↑ | b SSIM↑ |
| --- | ---: | ---: | ---: | ---: |
| ours | **20.0 ± 0.1** | 0.9 | – | 0.8 ± 0.000 |

Bold: the best.

## Two

|  | x |
| --- | ---: |
| ours | 1 |
"""


def test_rows_and_columns_by_heading() -> None:
    rows = table_under(PAGE, "One")
    assert narrowed(rows, "PSNR↑") == [["", "a", "b"], ["ours", "**20.0 ± 0.1**", "–"]]
    assert narrowed(rows, "SSIM↑") == [["", "a", "b"], ["ours", "0.9", "0.8"]]
    two = table_under(PAGE, "Two")
    assert two == narrowed(two, "") == [["", "x"], ["ours", "1"]]


def test_a_table_takes_its_own_place_and_touches_nothing_else() -> None:
    page = "before\n<!-- table one -->\nold\n<!-- end -->\nbetween\n<!-- table two -->\nold\n<!-- end -->\n"
    new = filled(page, "one", [["", "x"], ["a\\b", "1"]])
    assert new == page.replace("old", "|  | x |\n|---|---:|\n| a\\b | 1 |", 1)
    with pytest.raises(ValueError, match="0 places for the table three"):
        filled(page, "three", [["", "x"]])


def test_the_documents_hold_the_tables_that_they_name() -> None:
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    assert refreshed(page, (DOCS / "results/tables.md").read_text(encoding="utf-8")) == page
