"""What a play gave that people look at: numbers to plot, and pictures. No check asks for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from envhub_sandbox.check.play import video
from envhub_sandbox.check.play.episodes import Episode
from envhub_sandbox.check.play.video import even
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.vector.pictures import Frame, png, small_picture
from envhub_worker.protocol.text import printable

_SIDE = 320
"""Pixels of the longer side of a picture."""
_FRAMES = 75
_SECONDS = 1.5
_FPS = 25.0
_LASTS = 3.0
"""Seconds, where there are so few frames that at their own rate a film were over at once."""
_STILLS = 4
_SAMPLES = 10
"""How often memory is counted in a play: a server counts only so often (``CountLimit``)."""


@dataclass(frozen=True)
class Film:
    """The first steps of a play, small, encoded here of frames that were judged.

    Attributes:
        stills: PNG, the first and the last frame and some between.
        video: MP4 with H.264; empty where there is none.
        frames: How many were rendered.
        fps: How many of them the video shows in a second.
        lacks: Why there is no video, or no picture at all.
    """

    stills: tuple[bytes, ...] = ()
    video: bytes = b""
    frames: int = 0
    fps: float = 0.0
    lacks: str = ""


@dataclass
class Play:
    """What is shown of one task.

    Attributes:
        facts: Its spaces and what else it says of itself, by name. Trust: the worker's words.
        episodes: Those that ended in the first play.
        step_s: Seconds of each step of the second play, which is not observed.
        memory: Bytes that its jail held, from outside: while it was played, and then after each
            round of resets; ``played`` says how many are of the play.
        film: None where none was asked for, or it says that it renders nothing.
    """

    facts: Mapping[str, str] = field(default_factory=dict)
    episodes: list[Episode] = field(default_factory=list)
    step_s: list[float] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)
    played: int = 0
    film: Film | None = None

    def counting(self, usage: Callable[[], dict[str, int]]) -> Callable[[], dict[str, int]]:
        """The same function, of which the memory is noted each time."""

        def counted() -> dict[str, int]:
            used = usage()
            if "memory_bytes" in used:
                self.memory.append(used["memory_bytes"])
            return used

        return counted

    def sampling(self, usage: Callable[[], dict[str, int]], steps: int) -> Callable[[int], None]:
        """A function that notes the memory after some of so many steps; given its number."""
        counted, every = self.counting(usage), -(-steps // _SAMPLES)

        def seen(number: int) -> None:
            if number % every == 0:
                counted()
                self.played = len(self.memory)

        return seen


def facts_of(env: VectorEnv[Any, Any, Any]) -> dict[str, str]:
    """What an environment says of itself, printable and bounded."""
    mode = (env.metadata or {}).get("autoreset_mode")
    found = {
        "observations": env.single_observation_space,
        "actions": env.single_action_space,
        "sub-environments": env.num_envs,
        "autoreset": getattr(mode, "name", None) or "it does not say",
        "render mode": env.render_mode or "none",
    }
    return {name: printable(str(value), 1_000) for name, value in found.items()}


def film(env: VectorEnv[Any, Any, Any], *, seed: int, seconds: float = _SECONDS) -> Film:
    """Play again from the start, and look: bounded in frames and in time, encoded here.

    What fails is said in the film and is no finding: its checks have been made.
    """
    frames: list[Frame] = []
    lacks = ""
    try:
        for frame in _rendered(env, seed, monotonic() + seconds):
            frames.append(frame)
    except (EnvHubError, gym.error.Error) as error:
        lacks = printable(str(error), 300)
    fps = min(video.fps_of(env.metadata), _FPS, max(len(frames) / _LASTS, 1.0))
    chosen = np.linspace(0, len(frames) - 1, min(_STILLS, len(frames))).astype(int)
    stills = tuple(png(frames[at]) for at in chosen)
    if not frames or not video.can_encode():
        ask = "pip install 'envhub-sandbox[video]' and check it again for a film"
        return Film(stills, frames=len(frames), lacks=lacks or ask)
    try:
        return Film(stills, video.encoded(frames, fps), len(frames), fps, lacks)
    except EnvHubError as error:  # such as frames of another size each time
        return Film(stills, frames=len(frames), lacks=printable(str(error), 300))


def _rendered(env: VectorEnv[Any, Any, Any], seed: int, ends: float) -> Iterator[Frame]:
    disabled = facts_of(env)["autoreset"] == "DISABLED"
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(_FRAMES):
        yield even(small_picture(video.frame_of(env), _SIDE))
        if monotonic() >= ends:
            return
        _, _, terminations, truncations, _ = env.step(env.action_space.sample())
        ended = np.logical_or(np.asarray(terminations, bool), np.asarray(truncations, bool))
        if disabled and ended.any():
            env.reset(options={"reset_mask": ended})
