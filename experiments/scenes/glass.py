"""What can be on the glass, in one sheet: `python -m experiments.scenes.glass OUT.jpg`.

One view of the street, rendered: few drops, many, the coverage of the many, and the same drops painted
onto the clean view; dust, dirt, smears, scratches; snow, dirt and drops together, and drops that creep,
in the first photo and in the 24th; a pane that stays in the scene, rendered and painted from one place
and from another.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np

from experiments.command import picture, write_picture
from experiments.scenes.measure import recipes
from pipeline.drops import mitsuba_scene, places, synthesis
from pipeline.drops.creep import crept
from pipeline.drops.pane import paint_pane
from pipeline.drops.shape import Drop
from pipeline.drops.stains import NAMES
from pipeline.io.images import as_bytes

SIZE = (200, 150)
SEED = 7
PANE_M = 0.12


class Street:
    """The street, baked once, and its camera."""

    def __init__(self) -> None:
        self.recipe = recipes()["street"]
        self.baked = mitsuba_scene.bake_place(places.build("street", SEED))
        optics = self.recipe["field_of_view_deg"], self.recipe["aperture_mm"]
        self.camera = synthesis.camera_of(*SIZE, *optics)
        self.exposure = synthesis.place_exposure(self.baked, self.camera)

    def drops(self, coverage: float) -> list[Drop]:
        """Drops on the lens."""
        rng, radii = np.random.default_rng(SEED), self.recipe["radius_mm"]
        return synthesis.lens_drops(rng, self.camera, PANE_M, coverage, radii)

    def view(
        self,
        water: list[Drop],
        pose: np.ndarray | None = None,
        stains: dict[str, float] | None = None,
    ) -> synthesis.WetView:
        """One view; with a pose, through the pane that stays in the scene."""
        half = synthesis.stained_half(self.camera, PANE_M)
        focal = self.camera.focal_px
        return synthesis.wet_view(
            self.baked, self.camera, np.eye(4) if pose is None else pose, water, seed=1, spp=49,
            exposure=self.exposure, clean_spp=64, pane_m=PANE_M if pose is None else None,
            stains=synthesis.pane_stains(SEED, focal, stains or {}, PANE_M, half),
        )  # fmt: skip

    def painted(
        self, view: synthesis.WetView, water: list[Drop], cam_from_pane: np.ndarray
    ) -> np.ndarray:
        """The same drops painted onto the view's clean picture; prints how far coverage agrees."""
        rainy, alpha = paint_pane(
            view.clean.astype(np.float32) / np.float32(255), water, cam_from_pane,
            synthesis.camera_matrix(self.camera),
            aperture_radius=self.camera.aperture_m, focus_distance=self.camera.focus_m,
        )  # fmt: skip
        both, either = np.minimum(alpha, view.alpha).sum(), np.maximum(alpha, view.alpha).sum()
        print(f"painted against rendered coverage: IoU {both / either:.3f}", flush=True)
        return as_bytes(rainy)


def ahead(distance: float) -> np.ndarray:
    """A pane square to the axes, `distance` metres from the origin."""
    pose = np.eye(4)
    pose[2, 3] = distance
    return pose


def panels() -> list[np.ndarray]:
    """The sheet's pictures (H, W, 3) uint8, row by row."""
    street = Street()
    many = street.view(street.drops(0.4))
    print(f"40 % asked for: {(many.alpha > 0.5).mean():.1%} of the pixels under water", flush=True)
    out = [
        street.view(street.drops(0.1)).rainy,
        many.rainy,
        np.repeat(many.coverage[..., None], 3, 2),
        street.painted(many, street.drops(0.4), ahead(PANE_M)),
    ]
    out += [street.view([], stains={kind: 0.12}).rainy for kind in NAMES]
    out.append(street.view(street.drops(0.1), stains={"dirt": 0.06}).rainy)
    out += [street.view(crept(street.drops(0.12), 0.4e-3 * k)).rainy for k in (0, 23)]
    move = recipes()["street-move"]
    rng = np.random.default_rng(SEED)
    water = synthesis.scene_drops(rng, street.camera, move["coverage"], move["radius_mm"])
    poses = mitsuba_scene.trajectory(rng, 24)
    for pose in (poses[0], poses[-1]):
        view = street.view(water, pose)
        cam_from_pane = pose @ ahead(synthesis.SCENE_PANE_M)
        out += [view.rainy, street.painted(view, water, cam_from_pane)]
    return out


def main() -> None:
    """Writes the sheet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=picture)
    out = parser.parse_args().out
    parts = panels()
    rows = [np.hstack(parts[k : k + 4]) for k in range(0, len(parts), 4)]
    sheet = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    write_picture(out, sheet, 78)


if __name__ == "__main__":
    main()
