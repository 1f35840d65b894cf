"""What a fit loses to drops, masks and poses: held-out PSNR of one scene under several inputs.

    python -m benchmarks.quality data/demo
    python -m benchmarks.quality data/demo --rows clean,true --steps 3000 --set samples=12
    python -m benchmarks.quality data/demo --rows true --shrink 2 --steps 1500 \\
        --set batch_rays=1024 resolution=384 table_log2=17     # half size: half a minute a row

A scene is a folder with photos and `truth/` (`clean/`, `coverage/`, `cameras.json`, perhaps
`depth/`), as `synthesize` makes it. Estimated poses and the masks of the stages `masks` and
`refine` are read from `artifacts/<scene>/` where they exist. Every eighth view is held out and
compared with its clean reference; settings are those of params.yaml. *clean-masked*: the clean photos
behind the true masks, without the rainy photos' own noise and blur between the drops. *seen*: the pixels whose
surface at least three fitted photos show without a drop, by `truth/depth` or else by the depth of the clean
fit; the oracle gap is the loss against the clean photos with the same poses.
"""

from __future__ import annotations

import argparse
import copy
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from benchmarks.flags import rows_of, settings_of
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.fit import fit
from pipeline.field.model import build_around
from pipeline.field.render import RenderedView, render_view
from pipeline.field.visibility import Witness, witness_count
from pipeline.geometry.poses import align_cameras
from pipeline.io.atomic import read_json
from pipeline.io.images import read_image
from pipeline.io.maps import read_depth
from pipeline.io.masks import read_keep_mask
from pipeline.io.transforms import View, read_transforms

ROOT = Path(__file__).resolve().parents[1]
# A faintly wet pixel hurts, a clean one thrown away costs: the true masks end where the water ends.
TRUE_COVERAGE = 0.02
SKY = 1e4  # metres: as far as a sky without a depth is taken to be
ROWS = {
    "clean": ("clean", "none", "true"),
    "clean-masked": ("clean", "true", "true"),
    "none": ("rainy", "none", "true"),
    "true": ("rainy", "true", "true"),
    "clean-sfm": ("clean", "none", "sfm"),
    "true-sfm": ("rainy", "true", "sfm"),
    "masks": ("rainy", "masks", "true"),
    "refine": ("rainy", "refine", "true"),
    "masks-sfm": ("rainy", "masks", "sfm"),
    "refine-sfm": ("rainy", "refine", "sfm"),
}
FIELD = (
    "samples",
    "levels",
    "features",
    "table_log2",
    "distortion",
    "trim",
    "decay",
    "resolution",
    "seed",
    "space",
    "precision",
)
FITTED = ("batch_rays", "seed", "rate", "exposure", "average", "shards")
USED = (*dict.fromkeys(FIELD + FITTED), "near_factor", "far_factor")


@dataclass(frozen=True)
class Scene:
    """Photos, references and cameras of a scene, by the photos' stems, in name order."""

    rainy: dict[str, np.ndarray]
    clean: dict[str, np.ndarray]
    coverage: dict[str, np.ndarray]
    drawn: dict[str, dict[str, np.ndarray]]  # keep masks of the stages `masks` and `refine`
    views: dict[str, dict[str, View]]  # poses "true" and, if there are any, "sfm"
    depth: dict[str, np.ndarray] = field(default_factory=dict)  # true, (H, W); 0: sky


class Result(NamedTuple):
    """Held-out PSNR of the whole image and of the seen pixels; renderings of every view."""

    psnr: float
    seen: float
    seconds: float
    renders: dict[str, RenderedView]


def load(folder: Path, artifacts: Path) -> Scene:
    """The scene in ``folder``, with masks and poses from ``artifacts`` if there are any."""
    photos = {p.stem: p for p in sorted(folder.glob("*.[jp][pn]g"))}
    rainy = {stem: read_image(path) for stem, path in photos.items()}
    truth = folder / "truth"
    clean = {stem: read_image(next((truth / "clean").glob(f"{stem}.*"))) for stem in photos}
    coverage = {}
    for stem in photos:
        raw = cv2.imread(str(truth / "coverage" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        assert raw is not None, stem
        coverage[stem] = raw.astype(np.float32) / np.iinfo(raw.dtype).max
    poses = artifacts / "poses" / "transforms.json"
    sfm = {Path(n).stem: v for n, v in read_transforms(poses).items()} if poses.is_file() else {}
    drawn = {
        stage: {
            stem: read_keep_mask(artifacts / stage / f"{stem}.png")
            for stem in photos
            if (artifacts / stage / f"{stem}.png").is_file()
        }
        for stage in ("masks", "refine")
    }
    views = {"true": _true_views(truth, list(photos), sfm)} | ({"sfm": sfm} if sfm else {})
    maps = {stem: truth / "depth" / f"{stem}.exr" for stem in photos}
    known = all(path.is_file() for path in maps.values())
    depth = {stem: read_depth(path) for stem, path in maps.items()} if known else {}
    return Scene(rainy, clean, coverage, drawn, views, depth)


def shrunk(scene: Scene, parts: int) -> Scene:
    """The scene with photos ``parts`` times smaller along each side; both sides must divide.

    Colours are averaged; a pixel is as wet as the wettest, and kept if all, that it is made of.
    """

    def cut(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        return image.reshape(height // parts, parts, width // parts, parts, *image.shape[2:])

    def view(one: View) -> View:
        fx, fy, cx, cy, _ = one.intrinsics
        width, height = one.width // parts, one.height // parts
        camera = {"fx": fx / parts, "fy": fy / parts, "cx": cx / parts, "cy": cy / parts}
        return replace(one, width=width, height=height, **camera)  # type: ignore[arg-type]

    return Scene(
        {stem: cut(image).mean((1, 3)) for stem, image in scene.rainy.items()},
        {stem: cut(image).mean((1, 3)) for stem, image in scene.clean.items()},
        {stem: cut(cover).max((1, 3)) for stem, cover in scene.coverage.items()},
        {
            k: {s: np.all(cut(keep), (1, 3)) for s, keep in v.items()}
            for k, v in scene.drawn.items()
        },
        {k: {s: view(one) for s, one in v.items()} for k, v in scene.views.items()},
        {stem: depth[::parts, ::parts] for stem, depth in scene.depth.items()},
    )


def _true_views(truth: Path, stems: list[str], sfm: dict[str, View]) -> dict[str, View]:
    about = read_json(truth / "cameras.json")
    cams = {stem: np.array(about["frames"][stem]["cam_from_world"]) for stem in stems}
    if sfm:
        scale = align_cameras({s: v.cam_from_world for s, v in sfm.items()}, cams).scale
        near = scale * min(view.near for view in sfm.values())
        far = scale * max(view.far for view in sfm.values())
    else:
        maps = [read_depth(truth / "depth" / f"{stem}.exr")[::8, ::8].ravel() for stem in stems]
        depth = np.concatenate(maps)
        near, far = np.quantile(depth[np.isfinite(depth) & (depth > 0)], (0.001, 0.97))
        near, far = 0.85 * near, 1.5 * far
    camera = (about["fx"], about["fy"], about["cx"], about["cy"], 0.0)
    size = (about["width"], about["height"])
    return {s: View(s, cam, *camera, *size, float(near), float(far)) for s, cam in cams.items()}


def photos_of(
    scene: Scene, row: str, settings: dict[str, Any]
) -> tuple[list[PosedPhoto], list[str], float, float]:
    """The photos that one row fits, the stems that it holds out, and the depths that bound it."""
    kind, masks, poses = ROWS[row]
    views = scene.views[poses]
    near = min(view.near for view in views.values()) * settings["near_factor"]
    far = max(view.far for view in views.values()) * settings["far_factor"]
    stems = [stem for stem in scene.rainy if stem in views]
    held_out = [stem for i, stem in enumerate(scene.rainy) if i % 8 == 0 and stem in views]
    photos = []
    for stem in stems:
        if stem in held_out:
            continue
        image = (scene.clean if kind == "clean" else scene.rainy)[stem]
        keep_mask = np.ones(image.shape[:2], bool)
        if masks == "true":
            keep_mask = scene.coverage[stem] <= TRUE_COVERAGE
        elif masks != "none":
            keep_mask = scene.drawn[masks][stem]
        view = views[stem]
        photos.append(
            PosedPhoto(stem, image, keep_mask, view.cam_from_world, view.intrinsics, near, far)
        )
    return photos, held_out, near, far


def fit_with(
    settings: dict[str, Any], model: Any, buffer: RayBuffer, steps: int, threads: int
) -> None:
    """Fits the model in place as the section nerf says."""
    fit(model, buffer, steps=steps, threads=threads, **{key: settings[key] for key in FITTED})


def measure(
    scene: Scene,
    row: str,
    settings: dict[str, Any],
    threads: int,
    seen: dict[str, np.ndarray],
    device: str = "cpu",
) -> Result:
    """Fit one row's input and compare the held-out views; ``seen`` masks by stem, may be empty."""
    photos, held_out, near, far = photos_of(scene, row, settings)
    views = scene.views[ROWS[row][2]]
    stems = [stem for stem in scene.rainy if stem in views]
    config = {key: settings[key] for key in FIELD}
    model = build_around("fast", list(views.values()), near, far, device=device, **config)
    buffer = RayBuffer(photos, settings["seed"], device)
    # The first fit of a process compiles, or reads what was compiled; on a GPU its libraries are loaded by it.
    fit(copy.deepcopy(model), buffer, steps=2, batch_rays=64, seed=0, threads=threads)
    clock = time.process_time if device == "cpu" else time.perf_counter
    begin = clock()
    fit_with(settings, model, buffer, settings["steps"], threads)
    seconds = clock() - begin
    torch.set_num_threads(threads)
    renders = {}
    for stem in stems if not seen else held_out:
        view = views[stem]
        size = (view.width, view.height)
        renders[stem] = render_view(
            model, view.cam_from_world, view.intrinsics, size, near, far, device=device
        )
    errors = {stem: (renders[stem].rgb - scene.clean[stem]) ** 2 for stem in held_out}
    whole = np.mean([psnr(error) for error in errors.values()])
    inside = [psnr(errors[stem][seen[stem]]) for stem in held_out] if seen else [np.nan]
    return Result(float(whole), float(np.mean(inside)), seconds, renders)


def seen_pixels(
    scene: Scene, renders: dict[str, RenderedView], fewest: int = 3
) -> dict[str, np.ndarray]:
    """By stem, which pixels show a surface that at least ``fewest`` fitted photos saw uncovered.

    Where surfaces are is the truth's word, or else the renderings'.
    """
    views = scene.views["true"]

    def witness(stem: str) -> Witness:
        view, keep_mask = views[stem], scene.coverage[stem] <= TRUE_COVERAGE
        depth = scene.depth[stem] if scene.depth else renders[stem].depth
        depth = np.where(depth > 0, depth, SKY)
        return Witness(view.cam_from_world, view.intrinsics, keep_mask, depth)

    names = list(scene.rainy)
    train = [witness(stem) for i, stem in enumerate(names) if i % 8]
    out = {}
    for stem in names[::8]:
        count = witness_count(witness(stem), train)
        height, width = scene.coverage[stem].shape
        out[stem] = np.repeat(np.repeat(count >= fewest, 2, 0), 2, 1)[:height, :width]
    return out


def psnr(squares: np.ndarray) -> float:
    """In dB, of squared differences."""
    return float(-10.0 * np.log10(squares.mean()))


def main() -> None:
    """Print one table per scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="+", help="folders like data/demo")
    parser.add_argument("--artifacts", type=Path, default=ROOT / "artifacts")
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--steps", type=int, help="instead of params.yaml's")
    parser.add_argument("--shrink", type=int, default=1, help="photos so many times smaller")
    parser.add_argument("--set", nargs="*", default=[], help="other parameters, key=value")
    flags = parser.parse_args()
    settings = settings_of(parser, flags.set, (*USED, "steps"))
    rows = rows_of(parser, flags.rows, ROWS)
    settings["steps"] = flags.steps or settings["steps"]
    for folder in flags.scenes:
        scene = shrunk(load(folder, flags.artifacts / folder.name), flags.shrink)
        covered = np.mean([c > TRUE_COVERAGE for c in scene.coverage.values()])
        print(f"{folder.name}: {len(scene.rainy)} views, {covered:.1%} covered, "
              f"{settings['steps']} steps of {settings['batch_rays']} rays")  # fmt: skip
        print(f"{'photos':6} {'masks':8} {'poses':5} {'PSNR':>6} {'gap':>6} {'seen':>6} "
              f"{'gap':>6} {'cpu s' if flags.device == 'cpu' else 's':>6}", flush=True)  # fmt: skip
        seen = seen_pixels(scene, {}) if scene.depth else {}
        clean: dict[str, Result] = {}
        for row in rows:
            kind, masks, poses = ROWS[row]
            if poses not in scene.views or not scene.drawn.get(masks, True):
                continue
            result = measure(scene, row, settings, flags.threads, seen, flags.device)
            if kind == "clean" and masks == "none":
                if not seen and poses == "true":  # other poses have depths of another unit
                    seen = seen_pixels(scene, result.renders)
                    errors = {s: (result.renders[s].rgb - scene.clean[s]) ** 2 for s in seen}
                    inside = [psnr(errors[s][seen[s]]) for s in seen]
                    result = result._replace(seen=float(np.mean(inside)))
                clean[poses] = result
            best = clean.get(poses)
            gaps = (best.psnr - result.psnr, best.seen - result.seen) if best else (np.nan,) * 2
            print(f"{kind:6} {masks:8} {poses:5} {result.psnr:6.2f} {gaps[0]:6.2f} "
                  f"{result.seen:6.2f} {gaps[1]:6.2f} {result.seconds:6.1f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
