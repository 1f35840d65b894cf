from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io import frames
from pipeline.io.frames import choose, pick_frames, read_frames, save_frames
from pipeline.io.images import image_size
from pipeline.io.video import write_video

# The display matrix of a track: 16.16 fixed point, the last column 2.30.
UPRIGHT = "00010000 00000000 00000000 00000000 00010000 00000000 00000000 00000000 40000000"
QUARTER = "00000000 00010000 00000000 ffff0000 00000000 00000000 00000000 00000000 40000000"


def _pan() -> tuple[list[int], list[np.ndarray]]:
    """A camera that rests, pans, rests, pans; every second frame is blurred. Places and frames."""
    rng = np.random.default_rng(0)
    wide = cv2.resize(
        rng.random((60, 160, 3)).astype(np.float32), (1600, 600), interpolation=cv2.INTER_CUBIC
    ).clip(0, 1)
    places = [0] * 15 + list(range(0, 300, 12)) + [300] * 15 + list(range(300, 600, 12))
    frames = []
    for number, x in enumerate(places):
        frame = wide[:240, x : x + 320]
        frames.append(cv2.GaussianBlur(frame, (0, 0), 3) if number % 2 else frame)
    return places, frames


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "pan.mp4"
    write_video(path, _pan()[1], 24)
    return path


def test_frames_are_sharp_and_spread_over_the_way_not_over_time(video: Path) -> None:
    places, _ = _pan()
    chosen = pick_frames(video, 6).frames
    assert [frame.index % 2 for frame in chosen] == [0] * 6, "the blurred ones are odd"
    where = np.array([places[frame.index] for frame in chosen])
    assert (np.diff(where) > 40).all() and (np.diff(where) < 160).all()
    assert chosen[0].seconds == pytest.approx(chosen[0].index / 24, abs=2e-3)


def test_the_sharpest_frame_in_the_middle_of_each_stretch() -> None:
    # Two stretches of a way of 10: [0, 5) and [5, 10); middles [1, 4] and [6, 9].
    way = np.array([0.0, 1.0, 2.0, 4.5, 5.0, 6.2, 8.0, 9.5, 10.0])
    sharpness = np.array([9.0, 1.0, 2.0, 9.0, 9.0, 3.0, 2.0, 9.0, 9.0])
    assert choose(way, sharpness, 2) == [2, 5]
    assert choose(np.array([0.0, 0.0, 10.0]), np.ones(3), 2) == [0, 2], "a jump: what there is"


def test_a_phone_held_upright_gives_upright_frames(video: Path, tmp_path: Path) -> None:
    data = video.read_bytes()
    place = data.index(bytes.fromhex(UPRIGHT), data.index(b"tkhd"))
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(data[:place] + bytes.fromhex(QUARTER) + data[place + 36 :])
    frame, pixels = next(read_frames(turned, pick_frames(turned, 3).frames))
    # The matrix takes x (right) to y (down): a quarter clockwise.
    expected = np.rot90(_pan()[1][frame.index], -1) * 255
    assert pixels.shape == expected.shape
    assert np.abs(pixels - expected).mean() < 10


@pytest.mark.parametrize("width, height", [(90, 160), (120, 160), (160, 160)])
def test_videos_stored_upright_are_read(tmp_path: Path, width: int, height: int) -> None:
    pictures = [np.ascontiguousarray(frame[:height, :width]) for frame in _pan()[1]]
    tall = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0)), "reflect") for p in pictures]
    write_video(tmp_path / "tall.mp4", tall, 25)
    picked = pick_frames(tmp_path / "tall.mp4", 5).frames
    assert len(picked) == 5


def test_saved_frames_are_numbered_and_tell_their_time(video: Path, tmp_path: Path) -> None:
    records, said = save_frames(video, tmp_path, 5, 160)
    assert said == []
    assert [record.name for record in records] == [f"frame_{i:04d}.png" for i in range(5)]
    assert {image_size(tmp_path / record.name) for record in records} == {(160, 120)}
    assert records[0].source.startswith("pan.mp4 at ")


def test_a_video_of_too_few_places_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    write_video(tmp_path / "short.mp4", _pan()[1][20:22], 24)
    with pytest.raises(UserError, match=r"short\.mp4 shows only \d different places.*at least 9"):
        save_frames(tmp_path / "short.mp4", tmp_path / "out", 40, 0, at_least=9)
    assert not (tmp_path / "out").exists()


def test_what_is_no_video_and_what_does_not_move_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(UserError, match=r"text\.mp4 is not a video"):
        pick_frames(tmp_path / "text.mp4", 5)
    write_video(tmp_path / "still.mp4", [_pan()[1][0]] * 12, 24)
    with pytest.raises(UserError, match=r"still\.mp4: the camera hardly moves"):
        pick_frames(tmp_path / "still.mp4", 5)


@pytest.mark.parametrize("kind", ["mkv", "webm", "avi"])
def test_a_copy_that_broke_off_is_told(tmp_path: Path, kind: str) -> None:
    """These formats play what is there and tell no fault: two thirds of 3.75 s here."""
    whole = _encoded(tmp_path / f"whole.{kind}", _pan()[1])
    assert pick_frames(whole, 5).said(whole) == []
    cut = tmp_path / f"cut.{kind}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    (said,) = pick_frames(cut, 5).said(cut)
    assert said.startswith(f"cut.{kind} says that it lasts ") and "cut short" in said


@pytest.mark.parametrize("kind", ["mp4", "mkv", "webm", "avi"])
@pytest.mark.parametrize("rate", [Fraction(1), Fraction(1, 3)])
def test_the_last_of_few_pictures_is_shown_for_as_long_as_it_lasts(
    tmp_path: Path, kind: str, rate: Fraction
) -> None:
    """A clip with a picture every second or every third is not cut short by its last one."""
    whole = _encoded(tmp_path / f"slow.{kind}", _pan()[1][15:27], rate=rate)
    picked = pick_frames(whole, 3)
    assert picked.said(whole) == [] and picked.shown == pytest.approx(12 / rate, abs=0.01)
    if kind in ("mkv", "avi"):
        whole.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
        assert len(pick_frames(whole, 3).said(whole)) == 1


@pytest.mark.parametrize("known", [True, False])
def test_a_last_picture_that_does_not_say_how_long_lasts_as_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    whole = _encoded(tmp_path / "slow.mp4", _pan()[1][15:27], rate=Fraction(1))
    shown = list(frames._decoded(whole))
    for picture in shown[0 if known else 11 :]:
        picture.duration = 3 * picture.duration if known else 0
    monkeypatch.setattr(frames, "_decoded", lambda path: iter(shown))
    assert pick_frames(whole, 3).shown == pytest.approx(14 if known else 12)


def test_an_mp4_that_broke_off_is_told_or_refused_with_the_second(
    video: Path, tmp_path: Path
) -> None:
    """Decoders differ in whether the picture at the break is a fault to them."""
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(video.read_bytes()[: video.stat().st_size * 2 // 3])
    try:
        (said,) = pick_frames(cut, 5).said(cut)
    except UserError as error:
        said = error.what
    assert re.search(
        r"cut\.mp4 is damaged after [1-3]\.\d s|its pictures end after [1-3]\.\d s", said
    )


def _encoded(
    path: Path,
    pictures: list[np.ndarray],
    shape: tuple[int, int] = (1, 1),
    rate: Fraction | int = 24,
) -> Path:
    """A video whose pixels are shown as `shape` (width, height) says, `rate` pictures a second."""
    with av.open(str(path), "w") as container:
        codec = {".webm": "libvpx", ".avi": "mpeg4"}.get(path.suffix, "libx264")
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(*shape)
        for picture in pictures:
            pixels = np.ascontiguousarray((255 * picture).astype(np.uint8))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def test_pixels_that_are_shown_wide_become_squares(tmp_path: Path) -> None:
    """Tape's 1440x1080 are shown as 1920x1080: one focal length serves both directions only then."""
    frames = _pan()[1]
    for shape, size in (((4, 3), (427, 240)), ((1, 1), (320, 240)), ((1000, 1001), (320, 240))):
        video = _encoded(tmp_path / "wide.mp4", frames, shape)
        records, _ = save_frames(video, tmp_path, 3, 0)
        assert {record.size for record in records} == {size}
        assert image_size(tmp_path / records[0].name) == size


def test_a_video_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    """As recordings of calls do; images are of one size."""
    frames = _pan()[1]
    large = _encoded(tmp_path / "a.ts", frames[:40]).read_bytes()
    small = _encoded(tmp_path / "b.ts", [frame[::2, ::2] for frame in frames[40:]]).read_bytes()
    (tmp_path / "call.ts").write_bytes(large + small)
    with pytest.raises(UserError, match=r"call\.ts changes from 320x240 to 160x120 pixels after"):
        pick_frames(tmp_path / "call.ts", 5)
