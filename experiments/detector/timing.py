"""Seconds and memory per photo: `python -m experiments.detector.timing unet:weights/unet.safetensors`.

One photo at a time with as many threads as the machine has cores, and as the stage does it: one
photo per core, one thread each. The median of some repetitions.
"""

from __future__ import annotations

import argparse
import resource
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from experiments.detector.score import named_detector
from pipeline.attention.inference import attend
from pipeline.attention.weights import Detector
from pipeline.parallel import cores

SIZES = ((480, 360), (1920, 1080))


def main() -> None:
    """Reads the command line and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("detectors", nargs="+", help="MODEL:FILE")
    parser.add_argument("--steps", type=int, default=4)
    flags = parser.parse_args()
    for detector in flags.detectors:
        network = named_detector(detector)
        for width, height in SIZES:
            photo = np.random.default_rng(0).random((height, width, 3), np.float32)

            def once(_: int = 0, photo: np.ndarray = photo, network: Detector = network) -> float:
                start = time.perf_counter()
                attend(network, photo, steps=flags.steps)
                return time.perf_counter() - start

            torch.set_num_threads(cores())
            alone = float(np.median([once() for _ in range(3)]))
            torch.set_num_threads(1)
            start = time.perf_counter()
            with ThreadPoolExecutor(cores()) as pool:
                list(pool.map(once, range(2 * cores())))
            each = (time.perf_counter() - start) / (2 * cores())
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{detector} {width}x{height}: {alone:.2f} s alone with {cores()} threads, "
                  f"{each:.2f} s each of many, peak {peak:.0f} MB so far")  # fmt: skip


if __name__ == "__main__":
    main()
