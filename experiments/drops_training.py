"""Ray-traced pairs (rainy, coverage, clean) for training the drop detector.

`python -m experiments.drops_training OUT --seeds 100 110 --views 8` writes
OUT/{rainy,coverage,clean}/NNN.png. Even seeds are streets, odd ones rooms. Every view has a drop
pattern, a pane and an aperture of its own, unless --shared fixes one pattern to the lens per seed. With
--arm, every second pane stays in the scene at arm's length, seen aslant, and half of all panes hold
flat drops. What was asked for stands in OUT/recipe.json: the same command goes on, another is refused.
Seeds below 100 are left to the scenes that detectors are judged on.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.drops import mitsuba_scene, places, synthesis
from pipeline.drops.shape import Drop
from pipeline.errors import UserError
from pipeline.io.atomic import read_json, write_json
from pipeline.io.images import write_image

WIDTH, HEIGHT = 400, 300
FOLDERS = ("rainy", "coverage", "clean")


def random_pane(
    rng: np.random.Generator, light: bool
) -> tuple[mitsuba_scene.Camera, float, list[Drop]]:
    """A camera, the distance of its pane and the drops on it; `light`: as on the judged scenes.

    Otherwise from sharp specks on a far window to large drops out of focus close to the lens.
    """
    focal = synthesis.focal_px(WIDTH, float(rng.uniform(45, 70)))
    while True:
        pane = 0.12 if light else float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
        blur = float(rng.choice([0.0, rng.uniform(1, 8), rng.uniform(4, 30)]))  # pixels
        aperture = 0.001 if light else blur * pane / (2 * focal)
        camera = mitsuba_scene.Camera(WIDTH, HEIGHT, focal, aperture)
        # Radii in pixels, as seen: none so small that its blur leaves nothing of it.
        small = float(np.exp(rng.uniform(np.log(2), np.log(8))) + 0.3 * blur)
        large = small * float(rng.uniform(1.3, 4.0))
        metres = pane / focal * 1000
        radii = (small * metres, large * metres)
        if light:
            small = float(rng.uniform(1.0, 2.5))
            radii = (small, float(rng.uniform(small + 1, 5.0)))
        share = float(rng.uniform(0.08, 0.18) if light else rng.uniform(0.03, 0.35))
        try:
            return camera, pane, synthesis.lens_drops(rng, camera, pane, share, radii)
        except UserError:  # too dense for these sizes: draw again
            continue


def arm_pane(rng: np.random.Generator) -> tuple[mitsuba_scene.Camera, None, list[Drop]]:
    """A camera and the drops of a pane that stays in the scene, synthesis.SCENE_PANE_M away."""
    focal = synthesis.focal_px(WIDTH, float(rng.uniform(45, 70)))
    camera = mitsuba_scene.Camera(
        WIDTH, HEIGHT, focal, float(rng.choice([0.0, 0.001, 0.003, 0.006]))
    )
    small = float(rng.uniform(4, 9))
    radii = (small, small * float(rng.uniform(1.5, 4.5)))
    return camera, None, synthesis.scene_drops(rng, camera, float(rng.uniform(0.06, 0.25)), radii)


def flattened(rng: np.random.Generator, drops: list[Drop]) -> list[Drop]:
    """The drops, in half of the cases all with smaller contact angles, as on clean glass."""
    if rng.random() < 0.5:
        return drops
    factor = float(rng.uniform(0.25, 0.8))
    return [replace(drop, contact_angle=drop.contact_angle * factor) for drop in drops]


def settle(out: Path, recipe: dict[str, object], count: int) -> None:
    """Writes down of which recipe the pictures in `out` are, `count` of them; UserError for another's.

    They are named by number, so that pictures of other seeds would pass for these. A folder of before,
    without a recipe, passes where it holds as many.
    """
    kept = out / "recipe.json"
    hint = "Name another folder, or remove this one."
    if kept.is_file():
        before = read_json(kept)
        other = [f"{key} {before.get(key)}" for key in recipe if before.get(key) != recipe[key]]
        if other:
            raise UserError(f"{out} holds pictures of another recipe: {', '.join(other)}.", hint)
        return
    missing = [not (out / "rainy" / f"{k:03d}.png").exists() for k in range(count)]
    if not any(missing):
        return
    if not all(missing):
        raise UserError(f"{out} holds some of the pictures and does not say of which recipe.", hint)
    write_json(kept, recipe)


def make(out: Path, seeds: range, views: int, spp: int, shared: bool, arm: bool) -> None:
    """Renders the pairs that `out` does not hold yet; UserError where it holds others, see `settle`."""
    settle(
        out,
        {
            "seeds": [seeds.start, seeds.stop],
            "views": views,
            "spp": spp,
            "shared": shared,
            "arm": arm,
        },
        len(seeds) * views,
    )
    for folder in FOLDERS:
        (out / folder).mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(tqdm(seeds, desc="places")):
        names = [f"{index * views + k:03d}.png" for k in range(views)]
        if all((out / "rainy" / name).exists() for name in names):
            continue
        place = places.build(("street", "room")[seed % 2], seed)
        baked = mitsuba_scene.bake_place(place, rays=96)
        rng = np.random.default_rng([seed, 3])
        poses = mitsuba_scene.trajectory(rng, views, turn_deg=5.0)
        pane = random_pane(rng, light=True)
        exposure = synthesis.place_exposure(baked, pane[0])
        for k, name in enumerate(names):
            pane_m: float | None
            camera, pane_m, drops = pane if shared else random_pane(rng, light=False)
            if arm:
                if k % 2:
                    camera, pane_m, drops = arm_pane(rng)
                drops = flattened(rng, drops)
            view = synthesis.wet_view(
                baked, camera, poses[k], drops, exposure=exposure * float(rng.uniform(0.7, 1.3)),
                spp=spp, clean_spp=spp, seed=seed * 1009 + k, pane_m=pane_m,
            )  # fmt: skip
            write_image(out / "clean" / name, view.clean)
            write_image(out / "coverage" / name, np.repeat(view.coverage[..., None], 3, 2))
            write_image(out / "rainy" / name, view.rainy)


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, required=True, metavar=("FIRST", "END"))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--shared", action="store_true", help="one drop pattern per place")
    parser.add_argument(
        "--arm", action="store_true", help="panes in the scene, and flat drops, too"
    )
    flags = parser.parse_args()
    try:
        make(flags.out, range(*flags.seeds), flags.views, flags.spp, flags.shared, flags.arm)
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
