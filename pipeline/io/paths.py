"""Where everything lies: every folder and file name of the project, once."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import UserError

# No dots: DVC follows the parameters `scenes.NAME.ingest`, and would look for the parts of the name.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
SHARED = ("images", "attention", "masks", "poses", "refine")
# What lies in a scene's folder, where its variants have their own: none of them may bear such a name.
TAKEN = (
    *SHARED,
    "nerf",
    "views",
    "report",
    "export",
    "restored",
    "small",
)


@dataclass(frozen=True)
class ScenePaths:
    """The folders of one scene, and of one variant of its fit.

    A variant shares images, attention, masks, poses and repaired masks with its scene and has a fit,
    views and metrics of its own. `folders` says which of the shared ones it finds elsewhere among the
    scene's artifacts: {"images": "attgan/restored"}.
    """

    root: Path
    scene: str
    variant: str | None = None
    folders: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (self.scene, self.variant):
            if name is not None and not NAME.fullmatch(name):
                raise UserError(
                    f"{name!r} cannot name a scene or a variant.",
                    "Use letters, digits, '_' and '-', beginning with a letter or digit.",
                )
        if self.variant in TAKEN:
            raise UserError(
                f"a variant cannot be called {self.variant}: artifacts/{self.scene}/{self.variant} is "
                "the scene's own.",
                "Give it another name under variants: in params.yaml.",
            )
        for name, place in self.folders.items():
            parts = place.split("/")
            if name not in SHARED or not all(NAME.fullmatch(part) for part in parts):
                raise UserError(
                    f"a variant cannot find its {name} in {place!r}.",
                    f"Folders may be named for {', '.join(SHARED)}, below the scene's artifacts.",
                )

    def _shared(self, name: str) -> Path:
        return self.artifacts / self.folders.get(name, name)

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
        return self._shared("images")

    @property
    def attention(self) -> Path:
        return self._shared("attention")

    @property
    def masks(self) -> Path:
        return self._shared("masks")

    @property
    def poses(self) -> Path:
        return self._shared("poses")

    @property
    def refine(self) -> Path:
        """Masks repaired from the scene, the ones that the fit uses."""
        return self._shared("refine")

    @property
    def unaveraged(self) -> Path:
        """Masks of equation 3 alone, without the mean map; for the comparison of methods."""
        return self.artifacts / "unaveraged"

    @property
    def small(self) -> Path:
        """The scene at the size of the fits of a comparison of methods."""
        return self.artifacts / "small"

    @property
    def tables(self) -> Path:
        """The tables of a comparison of methods, over all scenes."""
        return self.root / "tables"

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
        own = self.root / "artifacts" / ".work" / self.scene
        return own / "variants" / self.variant / stage if self.variant else own / stage
