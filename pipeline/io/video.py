"""Video that plays in every browser: H.264, yuv420p, even sides."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np

from pipeline.io.atomic import disk_faults
from pipeline.io.images import as_bytes


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    """Writes (H, W, 3) float RGB frames in [0, 1] as mp4; odd sides lose their last row or column."""
    with disk_faults(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.parent / f".{path.stem}.tmp-{os.getpid()}.mp4"
        try:
            _encode(fresh, frames, fps)
            fresh.replace(path)
        finally:
            fresh.unlink(missing_ok=True)


def _encode(path: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    # The index first (faststart), so that a browser plays before it has everything.
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        # x264's vector code lets what lay in memory into small pictures; without it, same bytes.
        how = {"crf": "20", "threads": "1", "x264-params": "asm=0"}
        stream = container.add_stream("libx264", rate=fps, options=how)
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            pixels = as_bytes(frame)
            height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
            if number == 0:
                stream.height, stream.width = height, width
            even = np.ascontiguousarray(pixels[:height, :width])
            for packet in stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
