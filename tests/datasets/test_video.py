"""Videos: what was encoded comes back in its order with its times, and files that break off are named."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import TimedFrame, open_sequence
from photo_files import write_photo
from refusals import refused

WIDTH, HEIGHT, COUNT, RATE = 64, 48, 20, 25
TURNS = {
    90: (0, -1, 1, 0),
    180: (-1, 0, 0, -1),
    270: (0, 1, -1, 0),
}
"""The upper left of the display matrix of videos that are shown turned counterclockwise, by degrees."""


def encode(path: Path, times: Sequence[int]) -> None:
    """Write a video of frames that become lighter by 12 each, with noise on the right that does not compress.

    Frame n is shown at ``times[n]`` (in units of 1 / ``RATE`` seconds).
    """
    generator = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "15"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number, time in enumerate(times):
            image = np.full((HEIGHT, WIDTH, 3), 12 * number, np.uint8)
            image[:, WIDTH // 2 :] = generator.integers(0, 255, (HEIGHT, WIDTH // 2, 3))
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = time, Fraction(1, RATE)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def copied(path: Path, to: Path, earlier: int = 0, **options: str) -> Path:
    """Copy the packets of a video into another file, shown ``earlier`` (in units of 1 / ``RATE`` seconds)."""
    with av.open(str(path)) as source, av.open(str(to), "w", options=options) as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        for packet in source.demux(stream):
            if packet.dts is not None and packet.pts is not None:
                shift = round(earlier / RATE / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, copy
                target.mux(packet)
    return to


def grey(frame: TimedFrame) -> float:
    return float(frame.frame.rgb[:, : WIDTH // 2].mean()) * 255


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty frames at a constant rate."""
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    encode(path, range(COUNT))
    return path


def test_frames_come_in_order_with_their_times(clip: Path) -> None:
    sequence = open_sequence(clip, hfov=60)
    assert len(sequence) == COUNT
    for _ in range(2):  # an iteration starts anew
        frames = list(sequence)
        assert [timed.time for timed in frames] == pytest.approx([n / RATE for n in range(COUNT)])
        assert [grey(timed) for timed in frames] == pytest.approx([12 * n for n in range(COUNT)], abs=4)
    assert frames[3].frame.name == "000003"
    assert frames[3].truth is None
    assert frames[3].frame.intrinsics == Intrinsics.from_hfov(60, WIDTH, HEIGHT)


def test_an_assumed_camera_is_approximate(clip: Path) -> None:
    camera = Intrinsics.from_focal(50, 2 * WIDTH, 2 * HEIGHT)
    for sequence, approximate in (
        (open_sequence(clip, assumed=[camera]), True),
        (open_sequence(clip, focal=25, assumed=[camera]), False),
    ):
        frame = next(iter(sequence)).frame
        assert frame.intrinsics == Intrinsics.from_focal(25, WIDTH, HEIGHT)
        assert frame.focal_is_approximate is approximate


def test_times_of_a_varying_rate(tmp_path: Path) -> None:
    """Times are those of the file, counted from the first of them."""
    varying, times = tmp_path / "varying.mkv", [n for n in range(COUNT) if n % 3]
    encode(varying, times)
    found = [timed.time for timed in open_sequence(varying, focal=50)]
    assert found == pytest.approx([(n - 1) / RATE for n in times], abs=0.0011)


def test_frames_that_were_cut_off_are_not_shown(clip: Path, tmp_path: Path) -> None:
    trimmed = copied(clip, tmp_path / "trimmed.mp4", earlier=10, avoid_negative_ts="disabled")
    sequence = open_sequence(trimmed, focal=50)
    frames = list(sequence)
    assert len(frames) == len(sequence) == COUNT - 10
    assert [timed.time for timed in frames] == pytest.approx([n / RATE for n in range(COUNT - 10)])
    assert grey(frames[0]) == pytest.approx(120, abs=4)


@pytest.mark.parametrize("degrees", TURNS)
def test_a_rotated_video_is_upright(clip: Path, tmp_path: Path, degrees: int) -> None:
    """The matrix by which a file says how it is shown is that of its track header."""
    content = bytearray(clip.read_bytes())
    matrix = content.index(b"tkhd") + 44
    for place, value in zip((0, 4, 12, 16), TURNS[degrees], strict=True):
        content[matrix + place : matrix + place + 4] = struct.pack(">i", value << 16)
    rotated = tmp_path / "rotated.mp4"
    rotated.write_bytes(content)
    frame = next(iter(open_sequence(rotated, hfov=60))).frame
    stored = next(iter(open_sequence(clip, hfov=60))).frame
    assert torch.equal(frame.rgb, stored.rgb.rot90(degrees // 90))
    assert (frame.intrinsics.width, frame.intrinsics.height) == frame.rgb.shape[1::-1]


def test_no_camera_is_an_error(clip: Path) -> None:
    with refused(where=clip, found="its focal length", expected="a camera: `camera` (a file)"):
        open_sequence(clip)


def test_a_video_that_breaks_off(clip: Path, tmp_path: Path) -> None:
    """The index is at the beginning, so the file opens; the frames before the break are given."""
    whole = copied(clip, tmp_path / "whole.mp4", movflags="+faststart")
    broken = tmp_path / "broken.mp4"
    content = whole.read_bytes()
    broken.write_bytes(content[: len(content) // 2])
    found = list[TimedFrame]()
    with refused(where=broken, found="breaks off", expected="a complete video file") as caught:
        found.extend(open_sequence(broken, focal=50))
    assert f"at frame {len(found)} (" in caught.error.found
    assert 0 < len(found) < COUNT


@pytest.mark.parametrize("content", [b"", b"no video", b"#EXTM3U\nhttp://127.0.0.1:9/clip.ts\n"])
def test_files_that_are_no_video(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "clip.mp4"
    file.write_bytes(content)
    with refused(where=file, found="not readable as a video", expected="a video file") as caught:
        open_sequence(file, focal=50)
    assert "Errno" not in caught.error.found


@pytest.mark.parametrize(
    ("codec", "pixels", "space"),
    [
        ("libx264", "yuv420p10le", 10),
        ("libx264", "yuv422p10le", 14),
        ("prores_ks", "yuv422p10le", 9),
    ],
)
def test_ten_bits_and_the_colour_spaces_of_hdr(codec: str, pixels: str, space: int, tmp_path: Path) -> None:
    """Colours are those of the file but for rounding, or those of the nearest colour space that FFmpeg converts."""
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    image[:, WIDTH // 2 :] = 200
    with av.open(str(tmp_path / "hdr.mov"), "w") as container:
        stream = container.add_stream(codec, rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        stream.codec_context.color_trc, stream.codec_context.color_primaries = 16, 9
        stream.codec_context.colorspace = space
        for number in range(3):
            picture = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            picture.pts, picture.time_base = number, Fraction(1, RATE)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    (tmp_path / "hdr.mov").rename(tmp_path / "hdr")  # the first bytes say what it is
    frames = [timed.frame for timed in open_sequence(tmp_path / "hdr", hfov=60)]
    assert len(frames) == 3
    left, right = frames[1].rgb[:, :20] * 255, frames[1].rgb[:, -20:] * 255
    assert 30 < float(left.mean()) < 50
    assert 190 < float(right.mean()) < 210


def test_masks_of_a_video_are_named_after_its_frames(tmp_path: Path) -> None:
    video, camera = tmp_path / "v.mp4", Intrinsics.from_focal(60, WIDTH, HEIGHT)
    encode(video, range(3))
    names = [timed.frame.name for timed in open_sequence(video, camera=camera)]
    masks = {name: tmp_path / name for name in (names[1], "other")}
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[5:] = 255
    for name, folder in masks.items():
        write_photo(folder / f"{name}.png", mask)
    hidden = [f.frame.hidden is not None for f in open_sequence(video, camera=camera, masks=masks[names[1]])]
    assert hidden == [False, True, False]
    with refused(where=masks["other"], found="no mask in it matches an image by name", expected="found other"):
        open_sequence(video, camera=camera, masks=masks["other"])
