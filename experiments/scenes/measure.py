"""What rendering and painting cost, and how clean the clean references are.

`python -m experiments.scenes.measure` prints, for every place, CPU seconds per view and the PSNR of
a clean reference against one with four times the samples and other random numbers; then the
painter's 256x256 pairs per CPU second.
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import yaml

from pipeline.drops import mitsuba_scene, places, storing, synthesis
from pipeline.drops.backgrounds import sample_background
from pipeline.drops.pairs import sample_pair

PARAMS = Path(__file__).with_name("params.yaml")


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal-to-noise ratio of 8-bit pictures in dB."""
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def recipes() -> dict[str, storing.Recipe]:
    """The section `synthesize` of every scene."""
    content = yaml.safe_load(PARAMS.read_text())
    shared = content["synthesize"]
    return {name: shared | scene["synthesize"] for name, scene in content["scenes"].items()}


def place_numbers(name: str, recipe: storing.Recipe) -> str:
    """One line about a scene."""
    start = time.process_time()
    baked = mitsuba_scene.bake_place(places.build(recipe["place"], recipe["seed"]))
    camera, poses, drops = storing.plan(recipe)
    exposure = synthesis.place_exposure(baked, camera)
    baking, start = time.process_time() - start, time.process_time()
    view = synthesis.wet_view(
        baked, camera, poses[0], drops, exposure=exposure, spp=recipe["spp"],
        clean_spp=recipe["clean_spp"], seed=1,
        pane_m=recipe["pane_m"] if recipe["mode"] == "lens" else None,
    )  # fmt: skip
    one_view = time.process_time() - start
    spp = 4 * recipe["clean_spp"]
    better = mitsuba_scene.render(baked, camera, poses[0], spp=spp, seed=99).radiance
    level = psnr(view.clean, synthesis.to_bytes(mitsuba_scene.develop(better, exposure)))
    water = float((view.alpha > 0.5).mean())
    return f"| {name} | {baking:.1f} | {one_view:.2f} | {level:.1f} | {len(drops)} | {water:.1%} |"


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


def main() -> None:
    """Prints the tables."""
    print(f"painter: {pairs_per_second():.1f} pairs per CPU second", flush=True)
    print("| scene | bake, CPU s | one view, CPU s | 64 against 256 spp, dB | drops | water |")
    print("|---|---|---|---|---|---|")
    for name, recipe in recipes().items():
        print(place_numbers(name, recipe), flush=True)


if __name__ == "__main__":
    main()
