"""Scores detectors where it counts: masks gathered on the glass, before any fit.

`python -m experiments.detector.gathered unet:weights/unet.safetensors demo street-move`

One line per scene: precision, recall and IoU, over all views, of what `refine` starts from when every view is
mapped by the detector, against the true coverage (> 0.05). Images, masks and poses are those in
artifacts/<scene>, the same for all detectors, so that only the maps differ. `--mirrored` maps each view twice,
as the stage does by default.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from experiments.detector.score import named_detector
from pipeline.attention.inference import attend
from pipeline.attention.samples import VISIBLE_COVERAGE
from pipeline.attention.weights import Detector
from pipeline.evaluation.masks import MaskScores, mask_counts, mask_scores
from pipeline.evaluation.references import find_references, read_reference
from pipeline.io.paths import ScenePaths
from pipeline.io.posed import read_posed_images
from pipeline.io.transforms import read_transforms
from pipeline.masking.glass import GlassCamera
from pipeline.masking.loop import repair
from stages.refine import BEYOND


def gathered(network: Detector, paths: ScenePaths, mirrored: bool) -> tuple[str, MaskScores]:
    """Which glass the maps tell, and how good the masks gathered on it are."""
    views = read_transforms(paths.poses / "transforms.json")
    images = read_posed_images(paths.images, paths.masks, views)
    records = [image.record for image in images]
    covers = find_references(paths.truth / "coverage", records)
    assert covers is not None, f"{paths.truth} holds no coverage"
    near = min(view.near for view in views.values())
    done = repair(
        lambda drop_masks, found: [],  # without rounds nothing is looked at
        [attend(network, np.asarray(image.rgb, np.float32), mirrored=mirrored) for image in images],
        [
            GlassCamera(i.view.cam_from_world, i.view.intrinsics, i.view.width, i.view.height)
            for i in images
        ],
        [~image.keep_mask for image in images],
        BEYOND * near,
        rounds=0,
    )
    counts = [
        mask_counts(
            drops,
            read_reference(covers[r.name], r, paths.data / r.source)[..., 0],
            VISIBLE_COVERAGE,
        )
        for r, drops in zip(records, done.rounds[0].drop_masks, strict=True)
    ]
    return done.rounds[0].found.mode, mask_scores(counts)


def main() -> None:
    """Reads the command line and prints the lines."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("detector", help="MODEL:FILE")
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--mirrored", action="store_true", help="averaged with the mirror image's")
    parser.add_argument("--root", type=Path, default=Path(), help="folder of data/ and artifacts/")
    flags = parser.parse_args()
    network = named_detector(flags.detector)
    print(f"{flags.detector}\n{'scene':14s} glass     P     R   IoU")
    for scene in flags.scenes:
        mode, scores = gathered(network, ScenePaths(flags.root.resolve(), scene), flags.mirrored)
        figures = f"{scores.precision:.3f} {scores.recall:.3f} {scores.iou:.4f}"
        print(f"{scene:14s} {mode:5s} {figures}", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
