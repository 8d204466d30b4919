"""Looks at rendered frames, and writes videos with imageio's bundled ffmpeg.

Frames come from the worker, so they are judged before they go to an encoder.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Generator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from envhub_sandbox.errors import EnvHubError, RemoteEnvError
from envhub_sandbox.vector.pictures import Frame
from envhub_worker.protocol.codec.inert import one_line

MAX_SIDE = 4096
"""Pixels: H.264 encoders stop there, and a frame stays below 50 MB."""
DEFAULT_FPS = 30.0
MIN_FPS = 0.1
"""Below, the times of frames are more than some containers can write."""
MAX_FPS = 240.0
SUFFIXES = (".mp4", ".mkv", ".mov")


class VideoError(EnvHubError):
    """No video can be written: of these frames, to this place, or with what is installed."""


def check_target(path: Path) -> None:
    """Refuse a target that cannot work, before anything is run. Raises ``VideoError``."""
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
    """Whether what writes videos is installed."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def encoded(frames: Sequence[Frame], fps: float) -> bytes:
    """The bytes of an MP4 with H.264, of frames of one size as ``first_frame`` gives them.
    Raises ``VideoError``: it cannot be written.
    """
    try:
        with TemporaryDirectory(prefix="envhub-film-") as folder:
            path = Path(folder) / "film.mp4"
            with VideoWriter(path, fps) as writer:
                for frame in frames:
                    writer.add(frame)
            return path.read_bytes()
    except OSError as error:
        raise VideoError(f"no video can be written: {error.strerror}") from error


def fps_of(metadata: Any) -> float:
    """``render_fps`` of an environment's metadata if it is a sensible number, else 30."""
    fps = metadata.get("render_fps") if isinstance(metadata, dict) else None
    # compared first: an integer from the wire may be too large for a float
    if isinstance(fps, (int, float)) and MIN_FPS <= fps <= MAX_FPS:
        return float(fps)
    return DEFAULT_FPS


def frame_of(env: Any) -> Frame:
    """What the first sub-environment renders; raises as ``first_frame`` does."""
    try:
        rendered = env.render()
    except RemoteEnvError as error:
        reason = one_line(f"{error.type_name}: {error.message}", 300)
        raise VideoError(f"render() failed: {reason}. {_advice(env.render_mode)}") from error
    return first_frame(rendered, env.render_mode)


def first_frame(rendered: Any, render_mode: str | None) -> Frame:
    """The first sub-environment's frame: uint8 ``(height, width, 3)``, both sides even.

    Args:
        rendered: What a vector environment's ``render`` returned.
        render_mode: To explain what came instead of a frame.

    Raises:
        VideoError: There is no such frame. Trust: input from the worker.
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


class VideoWriter:
    """Writes one file. A context manager; what was written when it ends can be played.

    Args:
        path: The file; see ``check_target``.
        fps: Frames per second.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path = path
        self.frames = 0
        self._fps = fps
        self._size: tuple[int, int] | None = None
        self._encoder: Generator[None, Any, None] | None = None

    def add(self, frame: Frame) -> None:
        """Append a frame as ``first_frame`` gives it. Raises ``VideoError``."""
        size = (frame.shape[1], frame.shape[0])
        if self._encoder is None:
            self._size, self._encoder = size, self._open(size)
        if size != self._size:
            raise VideoError(f"the size of frames changed from {self._size} to {size} pixels")
        try:
            self._encoder.send(np.ascontiguousarray(frame))
        except OSError as error:
            raise VideoError(f"{self.path}: ffmpeg ended after {self.frames} frames") from error
        self.frames += 1

    def _open(self, size: tuple[int, int]) -> Generator[None, Any, None]:
        import imageio_ffmpeg  # type: ignore[import-untyped]

        # absolute, so that ffmpeg can take no name for an option or a protocol
        encoder: Generator[None, Any, None] = imageio_ffmpeg.write_frames(
            os.path.abspath(self.path),
            size,
            fps=self._fps,
            macro_block_size=2,
            ffmpeg_log_level="error",
        )
        try:
            encoder.send(None)
        except (OSError, RuntimeError) as error:
            raise VideoError(f"ffmpeg does not start: {error}") from error
        return encoder

    def close(self) -> None:
        """Finish the file. Idempotent."""
        if self._encoder is not None:
            self._encoder.close()
            self._encoder = None

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def even(frame: Frame) -> Frame:
    """A frame with even sides, as encoders need them: an odd one repeats its last row or column."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
