"""The page itself: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import jinja2
from markupsafe import Markup

from pipeline.report.numbers import Line

LAYERS = {
    "photo": "Photo",
    "attention": "Attention",
    "mask": "Mask",
    "clean": "Clean view",
    "composite": "Cleaned",
    "depth": "Depth",
}


@dataclass(frozen=True)
class Photo:
    """One photo's card: its pictures by kind (see LAYERS) and what is known of it."""

    name: str
    held_out: bool
    pictures: Mapping[str, str]
    notes: list[str] = field(default_factory=list)
    lost: str = ""
    ratio: float = 4 / 3


@dataclass(frozen=True)
class Page:
    """Everything that the page shows; empty pieces are left out of it."""

    scene: str
    headline: str
    tiles: list[tuple[str, str, str]]
    table: list[Line]
    compared: str
    photos: list[Photo]
    charts: dict[str, Markup]
    coverage: str
    coverage_max: float
    masks_note: str
    rounds: list[str]
    poses_note: str
    lost: list[tuple[str, str]]
    tried: list[tuple[str, str]]
    intake: list[str]
    video: str
    video_missing: str
    missing: list[tuple[str, str]]
    conventions: Mapping[str, Any]
    placing_known: bool = True  # whether poses.json was there

    @property
    def hero(self) -> Photo | None:
        """The photo on top: a placed one with a cleaned form, held out if there is one."""
        shown = [photo for photo in self.photos if "composite" in photo.pictures]
        return next((photo for photo in shown if photo.held_out), shown[0] if shown else None)

    @property
    def groups(self) -> list[list[Line]]:
        """The lines of the table under their headings, in their order."""
        return [list(lines) for _, lines in groupby(self.table, key=lambda line: line.group)]


def render(page: Page) -> str:
    """The page as HTML. All text is escaped; styles, script and pictures are inside."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pipeline.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    style, script = (
        Markup(environment.loader.get_source(environment, name)[0])  # type: ignore[union-attr]
        for name in ("page.css", "page.js")
    )
    template = environment.get_template("page.html.j2")
    return template.render(page=page, layers=LAYERS, style=style, script=script) + "\n"
