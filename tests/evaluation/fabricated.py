"""A small made-up scene on disk, complete from photos to views, whose numbers are known."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np

from pipeline.io.atomic import write_json, write_text
from pipeline.io.images import read_image, write_image
from pipeline.io.maps import write_depth, write_map
from pipeline.io.masks import write_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.io.transforms import View, write_transforms
from pipeline.io.video import write_video

NOISE = 5 / 255  # whole 8-bit steps, so that rounding takes nothing away


def clean_view(index: int, count: int, width: int, height: int) -> np.ndarray:
    """A picture (H, W, 3) of hills, a sun and posts, which shift with the view."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    shift = index / max(count - 1, 1) - 0.5
    sky = np.stack([0.55 + 0.35 * y, 0.70 + 0.15 * y, 0.92 - 0.15 * y], axis=-1)
    sun = np.exp(-((x - 0.72 + 0.02 * shift) ** 2 + (y - 0.22) ** 2 * 0.6) / 0.003)
    rgb = sky + sun[..., None] * np.array([0.4, 0.3, -0.1])
    for layer, colour in enumerate(([0.45, 0.56, 0.62], [0.33, 0.47, 0.42], [0.20, 0.33, 0.22])):
        u = x + shift * 0.15 * (layer + 1)
        edge = 0.42 + 0.15 * layer + 0.06 * np.sin(7 * u + 2 * layer) + 0.02 * np.sin(31 * u)
        grain = 0.05 * np.sin(90 * u + 40 * y) * np.sin(140 * y)
        rgb = np.where((y > edge)[..., None], np.array(colour) + grain[..., None], rgb)
    for post in range(5):
        near = np.abs(x + shift * 0.8 - 0.2 * post - 0.1) < 0.012
        rgb = np.where((near & (y > 0.45))[..., None], [0.75, 0.25 + 0.1 * post, 0.15], rgb)
    return np.clip(rgb, 0, 1).astype(np.float32)


def drop_coverage(width: int, height: int, seed: int = 3) -> np.ndarray:
    """Soft coverage (H, W) in [0, 1] of some drops that stay where they are on the lens."""
    random, high = np.random.default_rng(seed), np.zeros((height * 4, width * 4), np.uint8)
    for _ in range(9):
        centre = (int(random.uniform(0, width * 4)), int(random.uniform(0, height * 4)))
        axes = [int(random.uniform(0.03, 0.09) * width * 4) for _ in range(2)]
        cv2.ellipse(high, centre, axes, random.uniform(0, 180), 0, 360, 255, -1)
    soft = cv2.resize(high, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(soft, (0, 0), 1.0).astype(np.float32) / 255


def _camera(index: int, count: int) -> np.ndarray:
    angle = 0.6 * (index / max(count - 1, 1) - 0.5)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    pose = np.eye(4)
    pose[:3, :3] = turn
    place = np.array([4 * np.sin(angle), 0.1 * (index % 3), -3 * np.cos(angle)])
    pose[:3, 3] = -turn @ place
    return pose


def fabricate(
    root: Path,
    *,
    count: int = 9,
    size: tuple[int, int] = (64, 48),
    scene: str = "made",
    truth: bool = True,
    variant: str | None = "unmasked",
    video: bool = True,
    lost: int = 1,
    prefix: str = "view",
) -> ScenePaths:
    """Writes data/<scene> and artifacts/<scene> under `root`; the last `lost` have no pose."""
    width, height = size
    paths = ScenePaths(root, scene)
    coverage = drop_coverage(width, height)
    names = [f"{prefix}_{index:02d}.png" for index in range(count)]
    records, views = [], []
    for folder in (paths.images, paths.refine, paths.masks, paths.attention, paths.truth / "clean"):
        folder.mkdir(parents=True)
    (paths.truth / "coverage").mkdir()
    for index, name in enumerate(names):
        clean, stem = clean_view(index, count, width, height), Path(name).stem
        blurred = cv2.GaussianBlur(clean[::-1, ::-1], (0, 0), width / 40)
        photo = clean + coverage[..., None] * (blurred - clean)
        write_image(paths.images / name, photo)
        write_image(paths.data / name, photo)
        write_keep_mask(paths.refine / name, coverage <= 0.3)
        write_map(paths.attention / f"{stem}.exr", np.clip(coverage * 1.2 - 0.1, 0, 1))
        write_image(paths.truth / "clean" / name, clean)
        write_image(paths.truth / "coverage" / name, np.repeat(coverage[..., None], 3, axis=2))
        digest = hashlib.sha256(name.encode()).hexdigest()
        split = "test" if index % 8 == 0 else "train"
        records.append(ImageRecord(name, name, digest, width, height, None, split, 0))
        pose = _camera(index, count)
        intrinsics = (1.2 * width, 1.2 * width, width / 2, height / 2, 0.0)
        views.append(View(name, pose, *intrinsics, width, height, near=1.0, far=8.0))
    write_images_json(paths.images, records)
    write_map(paths.attention / "mean.exr", np.clip(coverage * 1.2 - 0.1, 0, 1))
    posed = views[: count - lost]
    write_transforms(paths.poses / "transforms.json", posed)
    _write_account(paths, records, {view.name for view in posed})
    frames = {Path(v.name).stem: {"cam_from_world": v.cam_from_world.tolist()} for v in views}
    write_json(paths.truth / "cameras.json", {"frames": frames, "unit": "m"})
    _write_fit(paths, records[: count - lost], coverage, NOISE, video)
    if variant:
        fit = ScenePaths(root, scene, variant)
        _write_fit(fit, records[: count - lost], coverage, 4 * NOISE, video=False)
    if not truth:
        for path in sorted(paths.truth.rglob("*"), reverse=True):
            path.unlink() if path.is_file() else path.rmdir()
        paths.truth.rmdir()
    return paths


def _write_account(paths: ScenePaths, records: list[ImageRecord], posed: set[str]) -> None:
    reason = "812 features, best match 7 with <none>, not enough"
    lost = [{"name": r.name, "reason": reason} for r in records if r.name not in posed]
    write_json(
        paths.poses / "poses.json",
        {"registered": sorted(posed), "lost": lost, "reprojection_px": 0.61, "points": 1412},
    )
    why = "the maps agree to 0.93 >= 0.3 per pixel"
    write_json(paths.masks / "masks.json", {"threshold": 0.3, "mode": "lens-fixed", "why": why})


def _write_fit(
    paths: ScenePaths, records: list[ImageRecord], coverage: np.ndarray, noise: float, video: bool
) -> None:
    """Renders that miss the clean views by `noise` everywhere; composites, depth, fit.csv."""
    steps = range(0, 2001, 50)
    losses = [0.002 + noise / 9 + 0.2 * np.exp(-step / 300) for step in steps]
    lines = [
        f"{s},{loss:.6f},{-10 * np.log10(loss):.4f}" for s, loss in zip(steps, losses, strict=True)
    ]
    paths.nerf.mkdir(parents=True)
    write_text(paths.nerf / "fit.csv", "\n".join(["step,loss,psnr", *lines]) + "\n")
    for folder in ("test", "input", "composite", "depth"):
        (paths.views / folder).mkdir(parents=True)
    truth = ScenePaths(paths.root, paths.scene).truth
    frames = []
    for record in records:
        clean = read_image(truth / "clean" / record.name)
        photo = read_image(paths.images / record.name)
        view = clean + np.where(clean > 0.5, -noise, noise).astype(np.float32)
        inside = (coverage > 0.3)[..., None]
        held_out = record.split == "test"
        write_image(paths.views / ("test" if held_out else "input") / record.name, view)
        write_image(paths.views / "composite" / record.name, np.where(inside, view, photo))
        rows, columns = np.indices(clean.shape[:2])
        depth = (8 - 6 * rows / record.height + 0.3 * np.sin(columns / 9)).astype(np.float32)
        write_depth(paths.views / "depth" / f"{record.stem}.exr", depth)
        frames.append(view)
    seen = {record.name: {"never": 0.004, "fewer_than_3": 0.02} for record in records}
    write_json(paths.views / "seen.json", seen)
    if video:
        write_video(paths.views / "path.mp4", frames, 12)
