"""The results of a play that a report shows: numbers to plot, pictures, and a short film.

No check depends on them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import EnvHubError, VideoError
from envhub_sandbox.play.episodes import Episode
from envhub_sandbox.play.video import can_encode, even, fps_of, frame_of, video_writer
from envhub_sandbox.vector.pictures import Frame, png, small_picture
from envhub_worker.protocol.text import printable

_SIDE = 320
"""Pixels of the longer side of a picture."""
_FRAMES = 75
_SECONDS = 1.5
_FPS = 25.0
_LASTS = 3.0
"""The least seconds of a film: with few frames, their rate is lowered."""
_STILLS = 4


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
