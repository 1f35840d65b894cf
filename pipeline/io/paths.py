"""Where everything lies: every folder and file name of the project, once."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UserError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class ScenePaths:
    """The folders of one scene, and of one variant of its fit.

    A variant shares images, attention, masks and poses with its scene and has a fit, views and
    metrics of its own.
    """

    root: Path
    scene: str
    variant: str | None = None

    def __post_init__(self) -> None:
        for name in (self.scene, self.variant):
            if name is not None and not NAME.fullmatch(name):
                raise UserError(
                    f"{name!r} cannot name a scene or a variant.",
                    "Use letters, digits, '.', '_' and '-', beginning with a letter or digit.",
                )

    @property
    def data(self) -> Path:
        return self.root / "data" / self.scene

    @property
    def truth(self) -> Path:
        """Clean references, true coverage and true poses, for evaluation only."""
        return self.data / "truth"

    @property
    def artifacts(self) -> Path:
        return self.root / "artifacts" / self.scene

    @property
    def images(self) -> Path:
        return self.artifacts / "images"

    @property
    def attention(self) -> Path:
        return self.artifacts / "attention"

    @property
    def masks(self) -> Path:
        return self.artifacts / "masks"

    @property
    def poses(self) -> Path:
        return self.artifacts / "poses"

    @property
    def refine(self) -> Path:
        """Masks repaired from the scene, the ones that the fit uses; a variant may have its own."""
        return self.artifacts / "refine"

    @property
    def out(self) -> Path:
        """The scene's own folder, or its variant's."""
        return self.artifacts / self.variant if self.variant else self.artifacts

    @property
    def nerf(self) -> Path:
        return self.out / "nerf"

    @property
    def views(self) -> Path:
        return self.out / "views"

    @property
    def restored(self) -> Path:
        return self.out / "restored"

    @property
    def metrics(self) -> Path:
        return self.out / "metrics.json"

    @property
    def metrics_csv(self) -> Path:
        return self.out / "metrics.csv"

    @property
    def report(self) -> Path:
        return self.artifacts / "report"

    def work(self, stage: str) -> Path:
        """Scratch of a stage, outside what is cached: logs, checkpoints, databases."""
        name = f"{self.scene}-{self.variant}" if self.variant else self.scene
        return self.root / "artifacts" / ".work" / name / stage
