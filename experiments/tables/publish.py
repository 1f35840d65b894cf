"""Takes a profile's tables over into the documents.

    python -m experiments.tables.publish quick

copies every table and strip to docs/results/, and writes anew what stands in docs/results.md between
`<!-- table psnr -->` (gains, ablation, masks) and `<!-- end -->`: rows and columns of those tables. The
sentences around them are written by hand; read them again after this.
"""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
DOCS = HERE.parents[1] / "docs"
# What docs/results.md shows: the heading of the table in tables.md, and the only column of each scene to keep.
SHOWN = {
    "psnr": ("Every method on every scene, held-out views", "PSNR↑"),
    "gains": ("Gains in PSNR, dB", ""),
    "ablation": ("The mean map (equation 5), drops on the lens", ""),
    "masks": ("Masks against the true coverage", "IoU↑"),
}


def table_under(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table below a heading of a Markdown page, row by row, without the rule."""
    below = page.split(f"\n## {heading}\n", 1)[1].lstrip("\n")
    lines = below.split("\n\n", 1)[0].strip().split("\n")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [rows[0], *rows[2:]]


def narrowed(rows: list[list[str]], number: str) -> list[list[str]]:
    """Only the columns that end in `number`, named without it; all of them when it is empty."""
    if not number:
        return rows
    kept = [0, *(i for i, name in enumerate(rows[0]) if name.endswith(f" {number}"))]
    head = [rows[0][i].removesuffix(f" {number}") for i in kept]
    return [head, *([row[i].replace(" ± 0.000", "") for i in kept] for row in rows[1:])]


def filled(page: str, name: str, rows: list[list[str]]) -> str:
    """The page with the table between `<!-- table NAME -->` and `<!-- end -->` exchanged.

    ValueError when the page has no such place, or several.
    """
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(rows[0]) - 1))
    table = "\n".join(lines)
    marks = rf"(<!-- table {name} -->\n)(.*?)(\n<!-- end -->)"
    page, count = re.subn(marks, lambda m: m[1] + table + m[3], page, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"{count} places for the table {name}")
    return page


def refreshed(page: str, tables: str) -> str:
    """The page with all of its tables taken from the page `tables`."""
    for name, (heading, number) in SHOWN.items():
        page = filled(page, name, narrowed(table_under(tables, heading), number))
    return page


def main() -> None:
    """Reads the command line and writes the documents."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("profile", choices=("quick", "full"))
    profile = parser.parse_args().profile
    tables = HERE / profile / "tables"
    if not tables.is_dir():
        parser.error(f"{tables} does not exist: run `make tables PROFILE={profile}` first")
    for file in sorted(tables.iterdir()):
        if file.suffix == ".png":
            with Image.open(file) as strip:
                strip.convert("RGB").save(DOCS / "results" / f"{file.stem}.jpg", quality=88)
        else:
            shutil.copyfile(file, DOCS / "results" / file.name)
    target = DOCS / "results.md"
    source = (tables / "tables.md").read_text(encoding="utf-8")
    target.write_text(refreshed(target.read_text(encoding="utf-8"), source), encoding="utf-8")
    print(f"{target} and {DOCS / 'results'}; the sentences around the tables are yours to check.")


if __name__ == "__main__":
    main()
