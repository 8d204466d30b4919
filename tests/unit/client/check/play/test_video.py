"""Frames are judged before they are encoded, and a written video can be read."""

import importlib.util
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from envhub_sandbox.errors import RemoteEnvError, VideoError
from envhub_sandbox.play import video
from envhub_sandbox.vector.pictures import png, small_picture

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")


def frame(height: int = 4, width: int = 6, value: int = 7) -> Any:
    return np.full((height, width, 3), value, np.uint8)


@pytest.mark.parametrize(
    "rendered", [(frame(), frame(2, 2)), [frame()], np.stack([frame(), frame(value=9)]), frame()]
)
def test_the_first_sub_environment_is_taken(rendered: Any) -> None:
    assert np.array_equal(video.first_frame(rendered, "rgb_array"), frame())


def test_odd_sides_repeat_their_last_line() -> None:
    picture = np.arange(5 * 3 * 3, dtype=np.uint8).reshape(5, 3, 3)
    padded = video.first_frame((picture,), "rgb_array")
    assert padded.shape == (6, 4, 3)
    assert np.array_equal(padded[:5, :3], picture)
    assert np.array_equal(padded[5, :3], picture[4])


@pytest.mark.parametrize(
    ("rendered", "says"),
    [
        (np.zeros((4, 6, 3), np.float32), "float32"),
        (np.zeros((4, 6, 4), np.uint8), r"\(4, 6, 4\)"),
        (np.zeros((4, 6), np.uint8), r"\(4, 6\)"),
        (np.zeros((0, 6, 3), np.uint8), "6x0"),
        (np.broadcast_to(np.uint8(0), (2, video.MAX_SIDE + 1, 3)), f"{video.MAX_SIDE + 1}x2"),
        ("a text", "a str"),
        (np.zeros((4, 4, 3), object), "object"),
        (np.lib.stride_tricks.as_strided(np.zeros(1, np.uint8), (10**5, 10**5, 3), (0,) * 3), "x"),
    ],
    ids=range(8),
)
def test_what_is_no_frame_is_refused(rendered: Any, says: str) -> None:
    with pytest.raises(VideoError, match=says):
        video.first_frame((rendered,), "rgb_array")
    for nothing in (np.zeros((0, 4, 4, 3), np.uint8), np.array(3, np.uint8), {}):
        with pytest.raises(VideoError):
            video.first_frame(nothing, None)


@pytest.mark.parametrize("rendered", [None, (None,), ()])
def test_an_environment_that_draws_nothing_is_told_how(rendered: Any) -> None:
    with pytest.raises(VideoError, match="--env-kwargs render_mode=rgb_array"):
        video.first_frame(rendered, None)
    with pytest.raises(VideoError, match="'human'"):
        video.first_frame(rendered, "human")


@pytest.mark.parametrize(
    ("metadata", "fps"),
    [
        *(({"render_fps": 12}, 12.0), ({"render_fps": 29.97}, 29.97), ({}, 30.0), (None, 30.0)),
        *(
            ({"render_fps": one}, 30.0)
            for one in (0, 1e9, "fast", None, 10**400, -(10**400), 1e-300, -1, float("nan"))
        ),
    ],
    ids=range(13),
)
def test_fps_is_sensible_whatever_the_metadata_says(metadata: Any, fps: float) -> None:
    assert video.fps_of(metadata) == fps


@pytest.mark.parametrize("size", [(64, 48), (2, 2), (130, 6)])
def test_a_written_video_can_be_read(
    tmp_path: Path, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a file that begins with a dash is a file, and no option
    with video.video_writer(Path("-version.mp4"), 10.0) as add:
        for value in range(0, 250, 10):
            add(frame(*size, value))
    path = str(tmp_path / "-version.mp4")
    assert imageio_ffmpeg.count_frames_and_secs(path)[0] == 25
    meta = next(imageio_ffmpeg.read_frames(path))
    assert meta["size"] == size[::-1]
    assert meta["fps"] == 10.0


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    with video.video_writer(tmp_path / "out.mp4", 10.0) as add:
        add(frame(4, 6))
        with pytest.raises(VideoError, match=r"changed from \(6, 4\) to \(4, 4\)"):
            add(frame(4, 4))


@pytest.mark.parametrize("name", ["out.txt", "nowhere/out.mp4", "folder.mp4"])
def test_targets_that_cannot_work_are_refused_early(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(VideoError):
        video.check_target(tmp_path / name)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(VideoError, match=r"pip install 'envhub-sandbox\[video\]'"):
        video.check_target(tmp_path / "out.mp4")


@pytest.mark.parametrize(
    "picture",
    [
        frame(16, 16)[::-1, ::-1],
        np.broadcast_to(frame(1, 1), (16, 16, 3)),
        frame(1, 1),
        np.lib.stride_tricks.as_strided(np.zeros(3, np.uint8), (video.MAX_SIDE, 2, 3), (0, 0, 1)),
    ],
)
def test_views_of_every_kind_are_frames(tmp_path: Path, picture: Any) -> None:
    with video.video_writer(tmp_path / "x.mp4", 30.0) as add:
        add(video.first_frame((picture,), "rgb_array"))
    assert (tmp_path / "x.mp4").stat().st_size > 0


def test_an_environment_that_cannot_render_says_what_to_do() -> None:
    class Blind:
        render_mode = None

        def render(self) -> None:
            raise RemoteEnvError("NotImplementedError", "no\x1b[2J picture")

    with pytest.raises(VideoError, match="render_mode=rgb_array") as caught:
        video.frame_of(Blind())
    assert "NotImplementedError" in str(caught.value)
    assert "\x1b" not in str(caught.value)


# --- Small pictures: what is shown is what was rendered, whatever its size


def pixels(data: bytes) -> NDArray[np.uint8]:
    """Those of a PNG with eight bits of RGB, as its standard says to read it."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    found, at = {}, 8
    while at < len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", data, at + 8 + length) == (zlib.crc32(name + body),)
        found[name], at = body, at + 12 + length
    width, height, *form = struct.unpack(">IIBBBBB", found[b"IHDR"])
    assert form == [8, 2, 0, 0, 0]
    lines = np.frombuffer(zlib.decompress(found[b"IDAT"]), np.uint8).reshape(height, -1)
    assert set(lines[:, 0].tolist()) == {2}, "each line is what is added to the one above"
    summed = np.cumsum(lines[:, 1:].astype(np.int64), axis=0) % 256
    return summed.astype(np.uint8).reshape(height, width, 3)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (9, 2, 3), (30, 40, 3)])
def test_a_png_has_the_very_pixels(shape: tuple[int, ...]) -> None:
    frame = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    assert np.array_equal(pixels(png(frame)), frame)
    assert np.array_equal(pixels(png(frame[::-1, ::-1])), frame[::-1, ::-1])


def test_a_pixel_is_the_mean_of_those_that_it_stands_for() -> None:
    frame = np.zeros((4, 6, 3), np.uint8)
    frame[:2, :2, 1] = [[0, 100], [200, 255]]
    small = small_picture(frame, 3)
    assert (small.shape, small[0, 0].tolist()) == ((2, 3, 3), [0, 139, 0])
    assert not small[1:].any()
    assert small_picture(frame, 6) is frame, "nothing is enlarged"


@pytest.mark.parametrize("size", [(1, 4096), (4096, 1), (2, 321), (960, 961), (319, 4095)])
def test_no_side_is_longer_and_none_is_nothing(size: tuple[int, int]) -> None:
    small = small_picture(np.zeros((*size, 3), np.uint8), 320)
    assert min(small.shape[:2]) >= 1
    assert max(small.shape[:2]) <= 320
