"""Frames of a video that serve as photos: sharp ones, evenly spread over the camera's way."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import resized, turn, write_image
from pipeline.io.photos import file_sha256, final_size
from pipeline.io.scene import ImageRecord

GLANCE_PX = 160  # longest side of the small picture in which motion is measured
LOOK_PX = 480  # longest side of the picture in which sharpness is measured
SHORT, SHORT_SECONDS = 0.05, 0.5  # share of a video, and seconds, that may be missing at its end
STILL_PX = 0.05  # less motion than this between two small pictures is noise
SQUARE, WIDEST = 0.005, 4  # pixels nearer to squares than this are squares; wider ones are a slip
MIDDLE = 0.6  # share of its stretch of the way in which a frame is looked for


@dataclass(frozen=True)
class Frame:
    """A chosen frame: its number in the stream, its time in seconds, its turn to be upright (ccw)."""

    index: int
    seconds: float
    upright_turn: int


@dataclass(frozen=True)
class Picked:
    """The frames chosen of a video, until when its last picture is shown, and how long it says that it is.

    `told` is 0 where the file does not say. Both in seconds.
    """

    frames: list[Frame]
    shown: float
    told: float

    def said(self, path: Path) -> list[str]:
        """A sentence when the pictures end well before the file says; none when all is there.

        Of a copy that broke off some formats (Matroska, AVI) play what is there and tell no fault.
        """
        if self.told - self.shown <= max(SHORT_SECONDS, SHORT * self.told):
            return []
        return [
            f"{path.name} says that it lasts {self.told:.1f} s, but its pictures end after "
            f"{self.shown:.1f} s: was the copy cut short? the frames are of what is there"
        ]


def pick_frames(path: Path, count: int) -> Picked:
    """At most `count` frames of the video at `path`, in order: the sharpest of each stretch of motion.

    The way of the camera is the sum of the median optical flow between neighbouring frames; it is cut
    into `count` stretches of equal length, so that a camera at rest gives no frames twice. Sharpness is
    the variance of the Laplacian. One frame is held at a time. UserError when the file is no video or
    the camera never moves.
    """
    frames: list[Frame] = []
    motion, sharpness = [], []
    last, lasting = None, 0.0
    for index, frame in enumerate(_decoded(path)):
        glance = _grey(frame, GLANCE_PX)
        motion.append(0.0 if last is None else _median_flow(last, glance))
        sharpness.append(float(cv2.Laplacian(_grey(frame, LOOK_PX), cv2.CV_32F).var()))
        turned = round(frame.rotation / 90) * 90 % 360
        frames.append(Frame(index, round(float(frame.time or 0.0), 3), turned))
        last, lasting = glance, float((frame.duration or 0) * (frame.time_base or 0))
    if not frames:
        raise UserError(
            f"{path} holds no frames.", "Copy it again, or save frames of it as photos."
        )
    way = np.cumsum(motion)
    if way[-1] < GLANCE_PX / 100:
        raise UserError(
            f"{path}: the camera hardly moves.", "A scene needs a video from different places."
        )
    chosen = choose(way, np.array(sharpness), count)
    # Of one picture a second the last counts much; where it does not say how long, as the one before.
    end = frames[-1].seconds + (lasting or frames[-1].seconds - frames[-2].seconds)
    return Picked([frames[index] for index in chosen], end, _told_seconds(path))


def choose(way: np.ndarray, sharpness: np.ndarray, count: int) -> list[int]:
    """Indices, ascending and distinct: the sharpest frame in the middle of each of `count` stretches.

    way (N,) is the distance covered at each frame, never falling; sharpness (N,). A stretch that no
    frame lies in gives none.
    """
    place = way / way[-1] * count
    chosen = []
    for stretch in range(count):
        off = np.abs(place - (stretch + 0.5))
        inside = np.flatnonzero(off <= MIDDLE / 2)
        if not len(inside):
            inside = np.flatnonzero(off <= 0.5)
        if len(inside):
            chosen.append(int(inside[np.argmax(sharpness[inside])]))
    return sorted(set(chosen))


def read_frames(path: Path, chosen: list[Frame]) -> Iterator[tuple[Frame, np.ndarray]]:
    """The chosen frames, one at a time, upright: (H, W, 3) uint8 RGB."""
    wanted = {frame.index: frame for frame in chosen}
    for index, frame in enumerate(_decoded(path)):
        if index in wanted:
            pixels = frame.to_ndarray(format="rgb24")
            yield wanted[index], turn(pixels, wanted[index].upright_turn)
        if index >= max(wanted):
            return


def save_frames(
    path: Path, folder: Path, count: int, longest_side: int, *, at_least: int = 1
) -> tuple[list[ImageRecord], list[str]]:
    """Writes at most `count` frames of the video into `folder`, no side above `longest_side` (0: any).

    Pixels that are shown wider than high become squares: poses are found with one focal length.
    Returns their records (`source` tells the video and the time, the checksum is the video's) and what
    the user should hear, as sentences. UserError when there are fewer than `at_least`.
    """
    picked, digest = pick_frames(path, count), file_sha256(path)
    chosen = picked.frames
    if len(chosen) < at_least:
        raise UserError(
            f"{path} shows only {len(chosen)} different places; a scene needs at least {at_least}.",
            "Film for longer, walking; 20 to 60 seconds are plenty.",
        )
    records: list[ImageRecord] = []
    wide = _pixel_width(path)
    for frame, pixels in read_frames(path, chosen):
        across, down = (1.0, wide) if frame.upright_turn % 180 else (wide, 1.0)
        shown = (round(pixels.shape[1] * across), round(pixels.shape[0] * down))
        size = final_size(shown, longest_side)
        name = f"frame_{len(records):04d}.png"
        write_image(folder / name, resized(pixels, size))
        source = f"{path.name} at {frame.seconds:.3f} s"
        records.append(ImageRecord(name, source, digest, *size, None, "train", 0))
    return records, picked.said(path)


def _decoded(path: Path) -> Iterator[av.VideoFrame]:
    shown, size = None, None
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path} has no pictures, only sound.")
            container.streams.video[0].thread_type = "AUTO"
            for frame in container.decode(container.streams.video[0]):
                shown = float(frame.time or 0.0)
                size = size or (frame.width, frame.height)
                if (frame.width, frame.height) != size:
                    raise UserError(
                        f"{path} changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} "
                        f"pixels after {shown:.1f} s.",
                        "Convert it to one size, or save frames of one size as photos.",
                    )
                yield frame
    except (av.FFmpegError, UnicodeDecodeError) as error:  # the latter: names in a damaged header
        why = getattr(error, "strerror", None) or "its header is damaged"
        told = f"{path} is not a video that can be read ({why})."
        if shown is not None:
            told = f"{path} is damaged after {shown:.1f} s ({why})."
        raise UserError(told, "Copy it again, or convert it to MP4.") from None


def _pixel_width(path: Path) -> float:
    """How wide a pixel is shown, in heights: 4/3 of much tape and of some cameras' cards, mostly 1."""
    with av.open(str(path)) as container:
        ratio = float(container.streams.video[0].sample_aspect_ratio or 1.0)
    square = abs(ratio - 1) < SQUARE or not 1 / WIDEST <= ratio <= WIDEST
    return 1.0 if square else ratio


def _told_seconds(path: Path) -> float:
    """How long the pictures of a video last by what the file says of them, else of all that it holds."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if stream.duration and stream.time_base:
            lasting = float(stream.duration * stream.time_base)  # of an AVI: guessed by its bytes
            return max(lasting, float(stream.frames / (stream.average_rate or 1e9)))
        tag = re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", stream.metadata.get("DURATION", ""))
        if tag:  # Matroska's
            return 3600 * float(tag[1]) + 60 * float(tag[2]) + float(tag[3])
        return (container.duration or 0) / av.time_base


def _grey(frame: av.VideoFrame, longest: int) -> np.ndarray:
    factor = min(1.0, longest / max(frame.width, frame.height))
    width, height = (max(2, round(side * factor)) for side in (frame.width, frame.height))
    picture = frame.reformat(width=width, height=height, format="gray").to_ndarray()
    return np.ascontiguousarray(picture)  # a view of padded rows where the width asks for padding


def _median_flow(last: np.ndarray, now: np.ndarray) -> float:
    """The median length of the flow: drops that stay on the lens are a minority, it ignores them."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(last, now, None)
    length = float(np.median(np.linalg.norm(flow, axis=2)))
    return length if length >= STILL_PX else 0.0
