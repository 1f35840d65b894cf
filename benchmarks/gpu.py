"""The field on a GPU: time per step in several ways, PSNR over time, larger fields, the paper's NeRF, views.

    python -m benchmarks.gpu --pack scenes.npz data/demo         # photos and true cameras in one file
    python -m benchmarks.gpu --scenes scenes.npz --out results    # about two minutes
    python -m benchmarks.gpu --scenes scenes.npz --device cpu --tiny   # whether it runs at all

Every eighth view is held out and compared with its clean reference. Times are wall times with the GPU waited
for. Parts run in the order of their importance; what no longer fits in ``--seconds`` is left out. A part that
fails says so and the next one runs.
"""

from __future__ import annotations

import argparse
import contextlib
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import yaml

from benchmarks.field import ROOT, OutOfTime, photos_and_field
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.cuda_steps import CudaSteps
from pipeline.field.encoding import HashGrid
from pipeline.field.fit import fit
from pipeline.field.grid_field import GridField
from pipeline.field.model import build, build_around
from pipeline.field.paper_field import PaperConfig
from pipeline.field.render import render_view
from pipeline.field.steppers import steppers_of

FIELD = ("samples", "levels", "features", "table_log2", "distortion", "decay", "resolution", "seed")
SHARP = {"table_log2": 21, "levels": 8, "samples": 24, "batch_rays": 8192}
SHARPER = SHARP | {"samples": 32, "bins": 64, "resolution": 1024, "batch_rays": 16384}
WIDE = {
    "table_log2": 21,
    "levels": 10,
    "samples": 32,
    "bins": 64,
    "hidden": 128,
    "batch_rays": 8192,
}


class Shot(NamedTuple):
    """One photo of a scene; what `build_around` needs of a camera."""

    name: str
    clean: np.ndarray
    rainy: np.ndarray
    keep_mask: np.ndarray
    cam_from_world: np.ndarray
    intrinsics: tuple[float, float, float, float, float]
    near: float
    far: float

    @property
    def width(self) -> int:
        return self.clean.shape[1]

    @property
    def height(self) -> int:
        return self.clean.shape[0]


class Bench:
    """What every part needs: settings, scenes, the device and how much time is left."""

    def __init__(self, flags: argparse.Namespace) -> None:
        self.settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
        self.device, self.tiny = flags.device, flags.tiny
        if self.tiny:
            self.settings |= {"levels": 2, "table_log2": 10, "samples": 6, "resolution": 48}
            self.settings |= {"batch_rays": 128, "steps": 12}
        self.go, self.record = flags.go, not flags.eager
        self.end, self.out = time.perf_counter() + flags.seconds, flags.out
        self.scenes = read(flags.scenes, 8 if self.tiny else 1) if flags.scenes else {}

    def note(self, text: str) -> None:
        """Adds to profile.txt what is too long to be read at once."""
        if self.out:
            with (self.out / "profile.txt").open("a") as file:
                file.write(text + "\n")

    def left(self) -> float:
        return self.end - time.perf_counter()

    def wait(self) -> float:
        """The time, once the GPU has nothing left to do."""
        if self.device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()

    def field(self, shots: list[Shot], **change: Any) -> GridField:
        settings = self.settings | change
        more = {k: settings[k] for k in ("bins", "hidden") if k in settings}
        config = {key: settings[key] for key in FIELD} | more
        near, far = shots[0].near, shots[0].far
        precision = settings.get("precision", "auto")
        model = build_around(
            "fast", shots, near, far, device=self.device, precision=precision, **config
        )
        assert isinstance(model, GridField)
        return model

    def buffer(self, shots: list[Shot], kind: str) -> RayBuffer:
        photos = []
        for number, shot in enumerate(shots):
            keep = np.ones_like(shot.keep_mask) if kind == "clean" else shot.keep_mask
            image = shot.clean if kind == "clean" else shot.rainy
            if number % 8:
                photos.append(PosedPhoto(shot.name, image, keep, *shot[4:]))
        return RayBuffer(photos, 0, self.device)

    def view(self, model: Any, shot: Any, size: tuple[int, int]) -> np.ndarray:
        numbers = [n * size[0] / shot.clean.shape[1] for n in shot.intrinsics[:4]]
        camera = (*numbers, shot.intrinsics[4])
        seen = render_view(model, shot.cam_from_world, camera, size, shot.near, shot.far,
                           device=self.device)  # fmt: skip
        return seen.rgb

    def held_out(self, model: Any, shots: list[Shot]) -> float:
        errors = [self.view(model, s, (s.width, s.height)) - s.clean for s in shots[::8]]
        return float(np.mean([-10 * np.log10((error**2).mean()) for error in errors]))

    def fitted(
        self, shots: list[Shot], kind: str, steps: int, progress: Any = None, **change: Any
    ) -> tuple[GridField, float]:
        """The field and the seconds that its fit took, everything but the photos' reading in them."""
        settings = self.settings | change
        buffer, begin = self.buffer(shots, kind), self.wait()
        model = self.field(shots, **change)
        fit(model, buffer, steps=steps, batch_rays=settings["batch_rays"], seed=0,
            average=settings["average"], log_every=100, progress=progress, record=self.record)  # fmt: skip
        return model, self.wait() - begin

    def step_ms(self, model: Any, buffer: RayBuffer, rays: int, how: str, steps: int = 60) -> float:
        """Milliseconds of a step; tf32, graph and compile are asked for by their names in ``how``."""
        return self.timed(self.ready(model, buffer, rays, how), how, steps)

    def ready(self, model: Any, buffer: RayBuffer, rays: int, how: str) -> Callable[[int], Any]:
        """What takes a step, after a dozen of them."""
        if "compile-grid" in how:
            grid = model.grid
            grid.forward = torch.compile(partial(HashGrid.forward, grid), dynamic=False)
        elif "compile" in how:
            model.compiled = torch.compile(GridField._losses, dynamic=False)
        torch.backends.cuda.matmul.allow_tf32 = "tf32" in how
        steppers = steppers_of(model, 10_000, 1.0)
        take = CudaSteps(model, None, steppers, buffer, rays, 0, self.record and "graph" in how)
        for step in range(200, 203 if self.tiny else 212):
            take(step)
        self.wait()
        return take

    def timed(self, take: Callable[[int], Any], how: str, steps: int) -> float:
        """Milliseconds of each of ``steps`` steps."""
        steps = 2 if self.tiny else steps
        begin = self.wait()
        for step in range(212, 212 + steps):
            loss = take(step)
        took = self.wait() - begin
        torch.backends.cuda.matmul.allow_tf32 = False
        if not torch.isfinite(loss).all():
            raise ValueError(f"{how}: the loss is {loss.tolist()}")
        return 1e3 * took / steps


def read(file: Path, stride: int) -> dict[str, list[Shot]]:
    """The scenes that `pack` wrote, every ``stride``-th pixel of them."""
    data, out = np.load(file), {}
    for name in [str(n) for n in data["names"]]:
        about, shots = data[f"{name}/camera"], []
        size = int(about[1]), int(about[0])
        for number, pose in enumerate(data[f"{name}/poses"]):
            pair = []
            for kind in ("clean", "rainy"):
                raw = cv2.imdecode(data[f"{name}/{kind}/{number}"], cv2.IMREAD_COLOR)
                assert raw is not None
                pair.append(raw[::stride, ::stride, ::-1].astype(np.float32) / 255.0)
            bits = np.unpackbits(data[f"{name}/keep/{number}"], count=size[0] * size[1])
            keep = bits.reshape(size)[::stride, ::stride].astype(bool)
            fx, fy, cx, cy = (float(n) / stride for n in about[2:6])
            near, far = float(about[6]), float(about[7])
            shots.append(
                Shot(f"{number}", pair[0], pair[1], keep, pose, (fx, fy, cx, cy, 0.0), near, far)
            )
        out[name] = shots
    return out


def pack(file: Path, folders: list[Path], bounds: tuple[float, float] | None) -> None:
    """Photos, references, true masks and true cameras of scenes in one file."""
    from pipeline.io.atomic import read_json
    from pipeline.io.maps import read_depth

    out: dict[str, Any] = {"names": np.array([folder.name for folder in folders])}
    for folder in folders:
        about = read_json(folder / "truth/cameras.json")
        photos = sorted(folder.glob("*.[jp][pn]g"))
        if (folder / "truth/depth").is_dir():  # as in benchmarks.quality
            maps = [read_depth(one)[::8, ::8].ravel() for one in folder.glob("truth/depth/*.exr")]
            depth = np.concatenate(maps)
            near, far = np.quantile(depth[np.isfinite(depth) & (depth > 0)], (0.001, 0.97))
            bounds = float(0.85 * near), float(2.0 * 1.5 * far)
        assert bounds is not None, f"{folder} has no truth/depth: give --bounds"
        numbers = [about[key] for key in ("width", "height", "fx", "fy", "cx", "cy")]
        out[f"{folder.name}/camera"] = np.array([*numbers, *bounds])
        frames = [about["frames"][photo.stem]["cam_from_world"] for photo in photos]
        out[f"{folder.name}/poses"] = np.array(frames)
        for number, photo in enumerate(photos):
            clean = next((folder / "truth/clean").glob(f"{photo.stem}.*"))
            raw = cv2.imread(str(folder / f"truth/coverage/{photo.stem}.png"), cv2.IMREAD_UNCHANGED)
            assert raw is not None
            keep = raw <= 0.02 * np.iinfo(raw.dtype).max
            out[f"{folder.name}/clean/{number}"] = np.frombuffer(clean.read_bytes(), np.uint8)
            out[f"{folder.name}/rainy/{number}"] = np.frombuffer(photo.read_bytes(), np.uint8)
            out[f"{folder.name}/keep/{number}"] = np.packbits(keep)
        print(folder.name, len(photos), "photos, bounds", bounds)
    np.savez(file, **out)


def steps_part(bench: Bench) -> Iterator[str]:
    """A step in every way that needs no compiler, and where its time goes."""
    shots = next(iter(bench.scenes.values()))
    buffer = bench.buffer(shots, "clean")
    ways = ["eager fp32", "eager bf16", "graph fp32", "graph tf32", "graph bf16"]
    for rays in (bench.settings["batch_rays"], 16384, 65536):
        for how in ways if rays < 16384 else ways[-3:]:
            yield one_way(bench, shots, buffer, rays, how)
    yield profile(bench, shots, buffer)


def compile_part(bench: Bench) -> Iterator[str]:
    """The same steps compiled, the grid alone or all that is differentiated; timed when ``--go`` is there."""
    shots = next(iter(bench.scenes.values()))
    buffer, taken = bench.buffer(shots, "clean"), []
    rays = 64 if bench.tiny else bench.settings["batch_rays"]
    many = 128 if bench.tiny else 65536
    for how, count in (("compile-grid graph", rays), ("compile graph", rays), ("compile", rays),
                       ("compile graph", many), ("compile-grid graph", many)):  # fmt: skip
        if bench.go and bench.go.exists():
            yield f"{how} {count}: not begun in time"
            continue
        begin = bench.wait()
        torch._dynamo.reset()
        try:
            model = bench.field(shots, precision="bfloat16")
            taken.append((how, count, bench.ready(model, buffer, count, how)))
        except Exception:
            yield f"{how}: {traceback.format_exc()[-900:]}"
        yield f"{how} {count} rays: first steps {bench.wait() - begin:.1f} s"
    while bench.go and not bench.go.exists():
        time.sleep(0.1)
    for how, count, take in taken:
        ms = bench.timed(take, how, 60)
        yield f"{how + ' bf16':24} {count:6d} rays {ms:8.3f} ms/step {1e3 * count / ms:12,.0f} rays/s"


def one_way(bench: Bench, shots: list[Shot], buffer: RayBuffer, rays: int, how: str) -> str:
    """One line: how, rays, milliseconds, rays per second, what it took to begin, memory."""
    rays = 64 if bench.tiny else rays
    precision = "bfloat16" if "bf16" in how else "float32"
    begin = bench.wait()
    take = bench.ready(bench.field(shots, precision=precision), buffer, rays, how)
    start = bench.wait() - begin
    ms = bench.timed(take, how, 60)
    memory = 0.0
    if bench.device != "cpu":
        memory = torch.cuda.max_memory_allocated() / 2**30
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    return (f"{how:24} {rays:6d} rays {ms:8.3f} ms/step {1e3 * rays / ms:12,.0f} rays/s; "
            f"first steps {start:5.1f} s; {memory:.1f} GB")  # fmt: skip


def profile(bench: Bench, shots: list[Shot], buffer: RayBuffer) -> str:
    """The kernels of ten unrecorded steps that take longest."""
    model = bench.field(shots)
    steppers = steppers_of(model, 10_000, 1.0)
    take = CudaSteps(model, None, steppers, buffer, bench.settings["batch_rays"], 0, False)
    for step in range(200, 204):
        take(step)
    with torch.profiler.profile() as seen:
        for step in range(204, 214):
            take(step)
        bench.wait()
    rows = [
        (getattr(e, "self_device_time_total", 0.0) / 10.0, e.count / 10, e.key)
        for e in seen.key_averages()
    ]
    rows = sorted((row for row in rows if row[0] > 0), reverse=True)
    kernels = [row for row in rows if not row[2].startswith(("aten::", "autograd::", "_"))]
    lines = [f"  {us:8.1f} us {count:6.1f} times  {key[:150]}" for us, count, key in rows[:60]]
    bench.note("\n".join(["profile of a step (eager, bf16, defaults):", *lines]))
    total = sum(us for us, _, _ in rows if us)
    short = "\n".join(f"  {us:7.1f} us {n:5.1f}x {key[:88]}" for us, n, key in kernels[:14])
    return f"profile: {total:.0f} us in {sum(row[1] for row in rows):.0f} pieces\n{short}"


def fits_part(bench: Bench) -> Iterator[str]:
    """The defaults: seconds and held-out PSNR, clean photos and wet ones behind true masks."""
    steps = bench.settings["steps"]
    strip: list[np.ndarray] = []
    for name, shots in list(bench.scenes.items())[:2]:
        for kind in ("clean", "rainy"):
            model, took = bench.fitted(shots, kind, steps)
            psnr = bench.held_out(model, shots)
            yield f"fit {name:13} {kind:5} {steps} steps {took:6.2f} s  {psnr:6.2f} dB"
            if name == next(iter(bench.scenes)):
                size = (shots[0].width, shots[0].height)
                strip.append(bench.view(model, shots[8 % len(shots)], size))
        if len(strip) == 2 and bench.out:
            picture = np.concatenate([shots[8 % len(shots)].clean, *strip], 1)
            flat = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
            cv2.imwrite(str(bench.out / "field.png"), flat[..., ::-1])
            strip = []


def time_part(bench: Bench) -> Iterator[str]:
    """PSNR after so many seconds, the schedule cut to fit; and in the course of the last of these fits."""
    name, shots = next(iter(bench.scenes.items()))
    buffer = bench.buffer(shots, "clean")
    ms = bench.step_ms(bench.field(shots), buffer, bench.settings["batch_rays"], "graph")
    for seconds in (1.0, 2.0, 4.0):
        steps = 5 if bench.tiny else max(100, int(1e3 * (seconds - 0.4) / ms))
        model, took = bench.fitted(shots, "clean", steps)
        yield (f"{name} clean, {steps} steps in {took:5.2f} s: "
               f"{bench.held_out(model, shots):6.2f} dB")  # fmt: skip


def larger_part(bench: Bench) -> Iterator[str]:
    """Larger fields and more rays, for as long as is told."""
    plan = [(0, SHARP, 7), (1, SHARP, 7), (0, SHARPER, 7), (2, SHARP, 7), (0, {}, 10)]
    yield from grown(bench, plan)


def longer_part(bench: Bench) -> Iterator[str]:
    """More of the same, if there is time."""
    yield from grown(bench, [(0, WIDE, 7), (1, SHARPER, 10), (2, {}, 7), (0, SHARPER, 25)])


def grown(bench: Bench, plan: list[tuple[int, dict[str, Any], int]]) -> Iterator[str]:
    """One line for each scene's number, settings and seconds."""
    scenes = list(bench.scenes.items())
    for which, change, seconds in plan:
        if which >= len(scenes) or bench.left() < seconds + 4:
            continue
        name, shots = scenes[which]
        if bench.tiny:
            change = change | {"table_log2": 10, "batch_rays": 64}
        rays = change.get("batch_rays", bench.settings["batch_rays"])
        buffer = bench.buffer(shots, "clean")
        ms = bench.step_ms(bench.field(shots, **change), buffer, rays, "graph", 30)
        steps = 5 if bench.tiny else int(1e3 * (seconds - 0.6) / ms)
        model, took = bench.fitted(shots, "clean", steps, **change)
        told = " ".join(f"{k}={v}" for k, v in change.items())
        yield (f"{name:13} {told}: {ms:.2f} ms/step, {steps} steps, "
               f"{steps * rays / buffer.count:.0f} turns, {took:5.1f} s "
               f"{bench.held_out(model, shots):6.2f} dB")  # fmt: skip


def paper_part(bench: Bench) -> Iterator[str]:
    """The paper's NeRF on the boxes of `benchmarks.race`: steps a second, and what it holds when."""
    size = (16, 12) if bench.tiny else (100, 75)
    train, test, made = photos_and_field("paper", bench.settings, size=size)
    buffer = RayBuffer(train, 0, bench.device)
    rays = 16 if bench.tiny else bench.settings["paper_batch_rays"]
    small: dict[str, Any] = {"width": 16, "coarse_samples": 4, "fine_samples": 4}

    def fresh(half: bool) -> Any:
        config: dict[str, Any] = {"half": half} | (small if bench.tiny else {})
        return build("paper", vars(PaperConfig()) | config, made.space, 0).to(bench.device)

    times = {}
    for how in ("eager fp32", "graph fp32", "graph tf32", "eager bf16", "graph bf16"):
        times[how] = bench.step_ms(fresh("bf16" in how), buffer, rays, how, 20)
        yield (f"paper {how:11} {times[how]:8.2f} ms/step, {1e3 * rays / times[how]:9,.0f} rays/s")
    for half, limit in ((True, 12.0), (False, 10.0)):
        if bench.left() > limit + 2:
            torch.backends.cuda.matmul.allow_tf32 = not half
            yield from paper_course(bench, fresh(half), buffer, test, rays, limit)
            torch.backends.cuda.matmul.allow_tf32 = False


def paper_course(
    bench: Bench, model: Any, buffer: RayBuffer, test: Any, rays: int, limit: float
) -> Iterator[str]:
    """The held-out view's PSNR where an hour of one core and of two would have stopped, and on."""
    looking, told = 0.0, []
    begin = bench.wait()
    kind = "bf16" if model.config.half else "tf32"
    photo = test[0]
    height, width = photo.image.shape[:2]
    marks = [470, 940, 2000, 4000, 8000, 16000]

    def look(step: int, loss: float, psnr: float) -> None:
        nonlocal looking
        now = bench.wait()
        spent = now - begin - looking
        last = spent > limit or (bench.tiny and step >= 20)
        if last or step in marks:
            seen = render_view(model, photo.cam_from_world, photo.intrinsics, (width, height),
                               photo.near, photo.far, device=bench.device)  # fmt: skip
            held = -10 * np.log10(((seen.rgb - photo.image) ** 2).mean())
            told.append(f"paper {kind}: {step} steps, {spent:.1f} s, {held:.2f} dB held out, "
                        f"{psnr:.2f} dB training")  # fmt: skip
            looking += bench.wait() - now
        if last:
            raise OutOfTime

    with contextlib.suppress(OutOfTime):
        fit(model, buffer, steps=bench.settings["paper_steps"], batch_rays=rays, seed=0,
            log_every=10, progress=look, record=bench.record)  # fmt: skip
    yield from told


def boxes_part(bench: Bench) -> Iterator[str]:
    """The fast field on the same boxes, for as little time as it takes to be ahead."""
    size = (16, 12) if bench.tiny else (100, 75)
    for steps in (20, 60, 300, 1000):
        train, test, model = photos_and_field("fast", bench.settings, size=size)
        model = model.to(bench.device)
        buffer, begin = RayBuffer(train, 0, bench.device), bench.wait()
        rays = bench.settings["batch_rays"]
        fit(model, buffer, steps=steps, batch_rays=rays, seed=0, record=bench.record)
        took = bench.wait() - begin
        photo = test[0]
        seen = render_view(model, photo.cam_from_world, photo.intrinsics, size, photo.near,
                           photo.far, device=bench.device)  # fmt: skip
        held = -10 * np.log10(((seen.rgb - photo.image) ** 2).mean())
        yield f"fast on the boxes: {steps} steps, {took:.2f} s, {held:.2f} dB held out"


def views_part(bench: Bench) -> Iterator[str]:
    """Milliseconds of a view."""
    shots = next(iter(bench.scenes.values()))
    model = bench.field(shots)
    for size in ((400, 300), (800, 600)):
        size = (40, 30) if bench.tiny else size
        for chunk in (2**19, 2**20, 2**22):
            import pipeline.field.render as render

            render.CUDA_SAMPLES = chunk
            bench.view(model, shots[0], size)
            begin = bench.wait()
            for _ in range(5):
                bench.view(model, shots[0], size)
            took = 1e3 * (bench.wait() - begin) / 5
            yield f"view {size[0]}x{size[1]}, {chunk:8d} samples at a time: {took:7.2f} ms"
        render.CUDA_SAMPLES = 2**20


PARTS: dict[str, Callable[[Bench], Iterator[str]]] = {
    "steps": steps_part,
    "views": views_part,
    "fits": fits_part,
    "boxes": boxes_part,
    "time": time_part,
    "paper": paper_part,
    "larger": larger_part,
    "longer": longer_part,
    "compile": compile_part,
}


def main() -> None:
    """Print the parts' lines as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", type=Path, nargs="+", metavar="PATH", help="FILE SCENE...")
    parser.add_argument("--bounds", type=float, nargs=2, help="of a scene without truth/depth")
    parser.add_argument("--scenes", type=Path, help="what --pack wrote")
    parser.add_argument("--out", type=Path, help="folder for field.png")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--tiny", action="store_true", help="sizes that only show that it runs")
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--go", type=Path, help="wait for this file between compiling and timing")
    parser.add_argument("--eager", action="store_true", help="record no step")
    parser.add_argument("--parts", default=",".join(PARTS))
    flags = parser.parse_args()
    if flags.pack:
        pack(flags.pack[0], flags.pack[1:], flags.bounds)
        return
    bench = Bench(flags)
    for name in flags.parts.split(","):
        print(f"-- {name} ({bench.left():.0f} s left)", flush=True)
        lines = PARTS[name](bench)
        while bench.left() > 0:
            try:
                line = next(lines)
            except StopIteration:
                break
            except Exception:
                print(traceback.format_exc()[-1500:], flush=True)
                break
            print(line, flush=True)


if __name__ == "__main__":
    main()
