"""The results of a play for people: numbers to plot, pictures, and videos by imageio's ffmpeg.

No check depends on them. Frames come from the worker, so they are checked before they are encoded.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import EnvHubError, RemoteEnvError, VideoError
from envhub_sandbox.play.episodes import Episode
from envhub_sandbox.vector.pictures import Frame, png, small_picture
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.text import printable

_SIDE = 320
"""Pixels of the longer side of a picture."""
_FRAMES = 75
_SECONDS = 1.5
_FPS = 25.0
_LASTS = 3.0
"""The least seconds of a film: with few frames, their rate is lowered."""
_STILLS = 4
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


def encoded(frames: Sequence[Frame], fps: float) -> bytes:
    """Encode frames of one size, as ``first_frame`` returns them, as MP4 with H.264.
    Raises ``VideoError``: the video cannot be written.
    """
    try:
        with TemporaryDirectory(prefix="envhub-film-") as folder:
            path = Path(folder) / "film.mp4"
            with video_writer(path, fps) as add:
                for frame in frames:
                    add(frame)
            return path.read_bytes()
    except OSError as error:
        raise VideoError(f"no video can be written: {error.strerror}") from error


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


@dataclass(frozen=True)
class Film:
    """The first steps of a play as small pictures and a video, encoded from checked frames.

    Attributes:
        stills: The first and the last frame and some between, as PNG.
        video: The video, MP4 with H.264; empty if there is none.
        frames: The number of rendered frames.
        fps: The frames per second of the video.
        lacks: Why the video or all pictures are missing.
    """

    stills: tuple[bytes, ...] = ()
    video: bytes = b""
    frames: int = 0
    fps: float = 0.0
    lacks: str = ""


@dataclass
class Play:
    """The data about one task that a report shows.

    Attributes:
        facts: Its spaces and its other facts, by name. Trust: values from the worker.
        episodes: The episodes that ended in the first play.
        step_s: The seconds of each step of the second play, which is not observed.
        memory: The bytes of its jail, measured from outside: during the play, and then after each
            round of resets; ``played`` is the number of values from the play.
        film: The film, or None if none was wanted or the environment renders nothing.
    """

    facts: Mapping[str, str] = field(default_factory=dict)
    episodes: list[Episode] = field(default_factory=list)
    step_s: list[float] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)
    played: int = 0
    film: Film | None = None

    def count(self, used: dict[str, int]) -> dict[str, int]:
        """Append ``memory_bytes`` to the series, and return ``used``."""
        if "memory_bytes" in used:
            self.memory.append(used["memory_bytes"])
        return used


def facts_of(env: VectorEnv[Any, Any, Any]) -> dict[str, str]:
    """The facts that an environment states about itself, printable and bounded."""
    mode = (env.metadata or {}).get("autoreset_mode")
    facts = {
        "observations": env.single_observation_space,
        "actions": env.single_action_space,
        "sub-environments": env.num_envs,
        "autoreset": getattr(mode, "name", None) or "it does not say",
        "render mode": env.render_mode or "none",
    }
    return {name: printable(str(value), 1_000) for name, value in facts.items()}


def film(env: VectorEnv[Any, Any, Any], *, seed: int, seconds: float = _SECONDS) -> Film:
    """Play again and render, bounded in frames and time; a failure is in ``Film.lacks``."""
    frames: list[Frame] = []
    lacks = ""
    try:
        for frame in _rendered(env, seed, monotonic() + seconds):
            frames.append(frame)
    except (EnvHubError, gym.error.Error) as error:
        lacks = printable(str(error), 300)
    fps = min(fps_of(env.metadata), _FPS, max(len(frames) / _LASTS, 1.0))
    chosen = np.linspace(0, len(frames) - 1, min(_STILLS, len(frames))).astype(int)
    stills = tuple(png(frames[at]) for at in chosen)
    if not frames or not can_encode():
        ask = "pip install 'envhub-sandbox[video]' and check it again for a film"
        return Film(stills, frames=len(frames), lacks=lacks or ask)
    try:
        return Film(stills, encoded(frames, fps), len(frames), fps, lacks)
    except EnvHubError as error:  # for instance because the size of frames changes
        return Film(stills, frames=len(frames), lacks=printable(str(error), 300))


def _rendered(env: VectorEnv[Any, Any, Any], seed: int, ends: float) -> Iterator[Frame]:
    disabled = facts_of(env)["autoreset"] == "DISABLED"
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(_FRAMES):
        yield even(small_picture(frame_of(env), _SIDE))
        if monotonic() >= ends:
            return
        _, _, terminations, truncations, _ = env.step(env.action_space.sample())
        ended = np.logical_or(np.asarray(terminations, bool), np.asarray(truncations, bool))
        if disabled and ended.any():
            env.reset(options={"reset_mask": ended})
