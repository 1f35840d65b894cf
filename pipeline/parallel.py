"""One function over many named things: threads on this machine, or a running Dask cluster."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import dask
from dask import threaded
from dask.callbacks import Callback
from dask.delayed import Delayed, delayed
from tqdm import tqdm

from pipeline.errors import UserError

ANSWER_WITHIN = "10s"
STREAM_BYTES = 2**30


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_named(
    function: Callable[..., Any],
    items: Mapping[str, tuple[Any, ...]],
    *,
    job_label: str,
    scheduler: str | None = None,
    workers: int | None = None,
    counts: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """`function(*items[name])` for every name, in the order of the names.

    `function` lives in a module, takes paths and small values and returns small values; it runs
    single-threaded, `workers` at a time (default: one per core). With `scheduler` (tcp://host:port) the
    calls run on that Dask cluster, whose workers need the project installed and see the same folders.
    The results do not depend on where they were computed. A failure names the item. `counts`: how many
    images an item stands for, where it is a run of them; the bar counts these.
    """
    # A cluster takes tasks of one name for one task, whoever sent them: two scenes have a frame_0000.png each.
    mine = secrets.token_hex(8)
    tasks = {
        name: delayed(_call, pure=False)(
            job_label, name, function, args, dask_key_name=f"{job_label}-{name}-{mine}"
        )
        for name, args in sorted(items.items())
    }
    sizes = {task.key: (counts or {}).get(name, 1) for name, task in tasks.items()}
    compute = _on_cluster if scheduler else _on_threads
    return compute(tasks, sizes, job_label, scheduler or "", workers or cores())


def stream_named(
    function: Callable[..., Any], items: Mapping[str, tuple[Any, ...]], each: int, **how: Any
) -> Iterator[Any]:
    """As :func:`map_named`, one result after the other in the order of the names, each of `each` bytes.

    No more are held at a time than STREAM_BYTES.
    """
    names = sorted(items)
    for run in cut(len(names), max(1, STREAM_BYTES // max(1, each)), 1):
        yield from map_named(function, {names[i]: items[names[i]] for i in run}, **how).values()


def cut(count: int, longest: int, workers: int) -> list[range]:
    """Runs of consecutive numbers below `count`, none longer than `longest`, so that all workers are busy.

    As many as workers, or a multiple; their lengths differ by one at most. None below 1.
    """
    if count < 1:
        return []
    runs = min(count, -(-count // (longest * workers)) * workers)
    ends = [count * k // runs for k in range(runs + 1)]
    return [range(first, last) for first, last in pairwise(ends)]


def _call(label: str, name: str, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    cv2.setNumThreads(1)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    try:
        return function(*args)
    except UserError as error:
        # A photo is IMG_1.png inside and IMG_1.jpg where it came from.
        if name in error.what or f"{Path(name).stem}." in error.what:
            raise
        raise UserError(f"{name}: {error.what}", error.hint) from error
    except Exception as error:
        raise RuntimeError(f"{label} failed on {name}: {error!r}") from error


def _on_threads(
    tasks: dict[str, Delayed], sizes: dict[str, int], label: str, _: str, workers: int
) -> dict[str, Any]:
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch is not None else 0
    try:
        bar = tqdm(total=sum(sizes.values()), desc=label, unit="image", leave=False)
        step = Callback(posttask=lambda key, *_: bar.update(sizes.get(key, 0)))
        # A pool of our own: leaving it waits for what still runs when a task fails, so that nothing
        # is written into a folder that has been given up.
        with ThreadPoolExecutor(workers) as pool, bar, step:
            # By its function: by its name, dask would load its cluster's library first.
            how = {"scheduler": threaded.get, "num_workers": workers, "pool": pool}
            results = dask.compute(*tasks.values(), optimize_graph=False, **how)
    finally:
        if torch is not None:
            torch.set_num_threads(threads)
    return dict(zip(tasks, results, strict=True))


def _on_cluster(
    tasks: dict[str, Delayed], sizes: dict[str, int], label: str, address: str, _: int
) -> dict[str, Any]:
    # Late: the cluster's library takes a second to load, and few runs use it.
    from distributed import Client, KilledWorker, as_completed

    try:
        client = Client(address, timeout=ANSWER_WITHIN)
    except (OSError, ValueError) as error:
        raise UserError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}).",
            "Start one with `dask scheduler`, or leave the flag away.",
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=30)
        except TimeoutError:
            raise UserError(
                f"--scheduler {address}: the cluster has no workers.",
                "Start `dask worker` with its address.",
            ) from None
        futures = client.compute(list(tasks.values()), retries=2)
        try:
            with tqdm(total=sum(sizes.values()), desc=label, unit="image", leave=False) as bar:
                for future in as_completed(futures):
                    future.result()
                    bar.update(sizes[future.key])
        except KilledWorker as error:
            name = next(n for n, f in zip(tasks, futures, strict=True) if f is future)
            raise UserError(
                f"{label}: the workers died on {name} ({error}).",
                "Most often they ran out of memory: give them more, or fewer threads each.",
            ) from None
        except BaseException:
            _wait_for_running(client, futures)
            raise
        return dict(zip(tasks, client.gather(futures), strict=True))


def _wait_for_running(client: Any, futures: list[Any]) -> None:
    """Calls off what waits, then waits for what runs: it may still write into the caller's folder."""
    from distributed import wait

    running = {key for keys in client.processing().values() for key in keys}
    client.cancel([one for one in futures if not one.done() and one.key not in running])
    wait([one for one in futures if not one.cancelled()])
