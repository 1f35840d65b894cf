"""What rendering and painting cost, and how clean the clean references are.

`python -m experiments.scenes.measure [SCENE...]` prints, for every scene, seconds on the clock and of
the processor for the light and for a view, the total of all its views, and the PSNR of a clean
reference against one with four times the samples and other random numbers; then the painter's 256x256
pairs per CPU second, and its posed views of 400x300.
"""

from __future__ import annotations

import argparse
import os
import time
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import yaml

from pipeline.drops import mitsuba_scene, places, storing, synthesis
from pipeline.drops.backgrounds import sample_background
from pipeline.drops.pairs import sample_pair
from pipeline.drops.pane import paint_pane
from pipeline.io.images import as_bytes

PARAMS = Path(__file__).with_name("params.yaml")


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal-to-noise ratio of 8-bit pictures in dB."""
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def recipes() -> dict[str, storing.Recipe]:
    """The section `synthesize` of every scene."""
    content = yaml.safe_load(PARAMS.read_text())
    shared = content["synthesize"]
    return {name: shared | scene["synthesize"] for name, scene in content["scenes"].items()}


@lru_cache(maxsize=1)
def baked_place(place: str, seed: int) -> tuple[mitsuba_scene.Baked, float, float]:
    """A place with its light, and the seconds on the clock and of the processor that it took."""
    clock, processor = time.perf_counter(), time.process_time()
    baked = mitsuba_scene.bake_place(places.build(place, seed))
    return baked, time.perf_counter() - clock, time.process_time() - processor


def scene_numbers(name: str, recipe: storing.Recipe) -> str:
    """One line about a scene."""
    baked, bake_clock, bake_processor = baked_place(recipe["place"], recipe["seed"])
    camera, poses, drops = storing.plan(recipe)
    exposure = synthesis.place_exposure(baked, camera)
    clock, processor = time.perf_counter(), time.process_time()
    for number in (0, 1):
        view = synthesis.wet_view(
            baked, camera, poses[number], drops, exposure=exposure, spp=recipe["spp"],
            clean_spp=recipe["clean_spp"], seed=1,
            pane_m=recipe["pane_m"] if recipe["mode"] == "lens" else None,
        )  # fmt: skip
    view_clock = (time.perf_counter() - clock) / 2
    view_processor = (time.process_time() - processor) / 2
    spp = 4 * recipe["clean_spp"]
    better = mitsuba_scene.render(baked, camera, poses[1], spp=spp, seed=99).radiance
    level = psnr(view.clean, as_bytes(mitsuba_scene.develop(better, exposure)))
    water = float((view.alpha > 0.5).mean())
    total = bake_clock + recipe["views"] * view_clock
    return (
        f"| {name} | {bake_clock:.1f} ({bake_processor:.1f}) | {view_clock:.2f} ({view_processor:.2f}) "
        f"| {total:.0f} | {level:.1f} | {len(drops)} | {water:.1%} |"
    )


def pairs_per_second(count: int = 40) -> float:
    """Training pairs of 256x256 per CPU second, their backgrounds not counted."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    backgrounds = [sample_background(rng, 256) for _ in range(8)]
    sample_pair(rng, backgrounds[0])  # the stock of shapes is made once
    start = time.process_time()
    for k in range(count):
        sample_pair(rng, backgrounds[k % 8])
    return count / (time.process_time() - start)


def posed_views_per_second(count: int = 6) -> float:
    """Posed photos of 400x300 per CPU second, wetted by the pane of street-move."""
    cv2.setNumThreads(1)
    recipe = recipes()["street-move"]
    camera, poses, drops = storing.plan(recipe)
    world_from_pane = np.eye(4)
    world_from_pane[2, 3] = synthesis.SCENE_PANE_M
    photo = np.random.default_rng(0).random((camera.height, camera.width, 3), np.float32)
    start = time.process_time()
    for pose in poses[:count]:
        paint_pane(
            photo, drops, pose @ world_from_pane, synthesis.camera_matrix(camera),
            aperture_radius=camera.aperture_m, focus_distance=camera.focus_m,
        )  # fmt: skip
    return count / (time.process_time() - start)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    chosen = parser.parse_args().scenes
    chosen = chosen or ["street", "street-move", "room", "harbour", "harbour-move"]
    print(f"on {len(os.sched_getaffinity(0))} cores; in brackets seconds of the processor")
    print(
        "| scene | light, s | one view, s | all views, s | 64 against 256 spp, dB | drops | water |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in chosen:
        print(scene_numbers(name, recipes()[name]), flush=True)
    print(f"painter: {pairs_per_second():.1f} pairs per CPU second", flush=True)
    print(f"painter, posed: {posed_views_per_second():.1f} views per CPU second", flush=True)


if __name__ == "__main__":
    main()
