"""Videos of what an environment renders, by imageio's ffmpeg.

Frames come from the worker, so they are checked before they are encoded.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteEnvError, VideoError
from envhub_sandbox.vector.pictures import Frame
from envhub_worker.protocol.codec.inert import one_line

MAX_SIDE = 4096
"""The most pixels of a side: the limit of H.264 encoders, so that a frame has less than 50 MB."""
DEFAULT_FPS = 30.0
MIN_FPS = 0.1
"""Below this rate some video containers cannot write the times of frames."""
MAX_FPS = 240.0
SUFFIXES = (".mp4", ".mkv", ".mov")


def check_target(path: Path) -> None:
    """Raise ``VideoError`` if a target cannot be written, before anything runs."""
    if not can_encode():
        raise VideoError(
            "writing a video needs imageio's ffmpeg, which is not installed; install it with: pip "
            "install 'envhub-sandbox[video]'"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise VideoError(f"{path}: a video is written as {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise VideoError(f"{path}: there is no folder {path.parent}")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise VideoError(f"{path} cannot be written: permission denied, or it is a folder")


def can_encode() -> bool:
    """Whether the package that writes videos is installed."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def fps_of(metadata: Any) -> float:
    """``render_fps`` of an environment's metadata if it is a sensible number, else 30."""
    fps = metadata.get("render_fps") if isinstance(metadata, dict) else None
    # compared before float(): an integer from the worker may be too large for a float
    if isinstance(fps, (int, float)) and MIN_FPS <= fps <= MAX_FPS:
        return float(fps)
    return DEFAULT_FPS


def frame_of(env: Any) -> Frame:
    """Render, and return the first sub-environment's frame; raises as ``first_frame`` does."""
    try:
        rendered = env.render()
    except RemoteEnvError as error:
        reason = one_line(f"{error.type_name}: {error.message}", 300)
        raise VideoError(f"render() failed: {reason}. {_advice(env.render_mode)}") from error
    return first_frame(rendered, env.render_mode)


def first_frame(rendered: Any, render_mode: str | None) -> Frame:
    """The first sub-environment's frame: uint8 ``(height, width, 3)``, both sides even.
    Raises ``VideoError``: this is not such a frame. Trust: input from the worker.
    """
    frame = rendered
    batched = isinstance(rendered, (tuple, list)) or getattr(rendered, "ndim", 0) == 4
    if batched and len(rendered):
        frame = rendered[0]
    if not isinstance(frame, np.ndarray):
        gave = "None" if frame is None else f"a {type(frame).__name__}"
        raise VideoError(f"render() gave {gave}, which is not a frame. {_advice(render_mode)}")
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise VideoError(
            f"render() gave {frame.dtype} of shape {frame.shape}; a video takes uint8 of shape "
            "(height, width, 3)"
        )
    height, width, _ = frame.shape
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise VideoError(f"a frame is {width}x{height} pixels; a video takes up to {MAX_SIDE}")
    return even(frame)


def _advice(render_mode: str | None) -> str:
    if render_mode is not None:
        return f"Its render_mode is {render_mode[:40]!r}, and a video needs 'rgb_array'."
    return (
        "Its render_mode is None, and a video needs 'rgb_array'. If the repository's make_env "
        "takes it as an argument, try: --env-kwargs render_mode=rgb_array"
    )


@contextlib.contextmanager
def video_writer(path: Path, fps: float) -> Iterator[Callable[[Frame], None]]:
    """Write a video, complete at the end of this context; yields a function that appends a frame of
    ``first_frame``, or raises ``VideoError``.
    """
    import imageio_ffmpeg  # type: ignore[import-untyped]

    encoder: Generator[None, Any, None] | None = None
    size, count = (0, 0), 0

    def add(frame: Frame) -> None:
        nonlocal encoder, size, count
        frame_size = (frame.shape[1], frame.shape[0])
        try:
            if encoder is None:
                size = frame_size
                # absolute, so that ffmpeg takes no file name for an option or a protocol
                encoder = imageio_ffmpeg.write_frames(
                    os.path.abspath(path),
                    size,
                    fps=fps,
                    macro_block_size=2,
                    ffmpeg_log_level="error",
                )
                encoder.send(None)
        except (OSError, RuntimeError) as error:
            raise VideoError(f"ffmpeg does not start: {error}") from error
        if frame_size != size:
            raise VideoError(f"the size of frames changed from {size} to {frame_size} pixels")
        try:
            encoder.send(np.ascontiguousarray(frame))
        except OSError as error:
            raise VideoError(f"{path}: ffmpeg ended after {count} frames") from error
        count += 1

    try:
        yield add
    finally:
        if encoder is not None:
            encoder.close()


def even(frame: Frame) -> Frame:
    """Make both sides of a frame even, as encoders need, by repeating its last row or column."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
