"""What a play gives to look at: bounded, and never a reason to fail."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox.errors import RemoteEnvError
from envhub_sandbox.extras.judge.play import film as films
from envhub_sandbox.extras.judge.play import traces
from envhub_sandbox.extras.judge.play.film import Play, facts_of, film

pytest.importorskip("imageio_ffmpeg")
Modes = gym.vector.AutoresetMode


class Walk(gym.Env[Any, Any]):
    """Ends after three steps."""

    observation_space = gym.spaces.Box(0, 9, (1,))
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_fps": 50}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, render: Callable[[int], Any]) -> None:
        self._render, self._rendered, self._count = render, 0, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self._count += 1
        return np.zeros(1, np.float32), 2.0, self._count >= 3, False, {}

    def render(self) -> Any:
        self._rendered += 1
        return self._render(self._rendered)


def walks(
    render: Callable[[int], Any] = lambda number: np.full((8, 9, 3), number, np.uint8),
    mode: Modes = Modes.NEXT_STEP,
) -> Any:
    return gym.vector.SyncVectorEnv([lambda: Walk(render)] * 2, autoreset_mode=mode)


@pytest.mark.parametrize("mode", list(Modes))
def test_a_film_is_of_so_many_frames(mode: Modes) -> None:
    made = film(walks(mode=mode), seed=0, seconds=600)
    assert made.frames == 75
    assert len(made.stills) == 4
    assert made.video[4:8] == b"ftyp", "an MP4"
    assert made.lacks == ""
    assert 1 <= made.fps <= 25


def test_a_film_does_not_take_long() -> None:
    assert film(walks(), seed=0, seconds=0).frames == 1


def test_there_are_pictures_where_nothing_makes_a_film(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(films, "can_encode", lambda: False)
    made = film(walks(), seed=0, seconds=600)
    assert (len(made.stills), made.video) == (4, b"")
    assert "envhub-sandbox[video]" in made.lacks


def _broken(number: int) -> Any:
    if number > 2:
        raise RemoteEnvError("ValueError", "it broke\x1b[2J", "")
    return np.zeros((4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("render", "stills", "says"),
    [
        (lambda number: "no frame", 0, "a str"),
        (lambda number: np.zeros((4, 5000, 3), np.uint8), 0, "5000x4"),
        (lambda number: np.zeros((2 * number, 4, 3), np.uint8), 4, "the size of frames changed"),
        (_broken, 2, "it broke\\x1b[2J"),
    ],
)
def test_bad_frames_fail_nothing(render: Callable[[int], Any], stills: int, says: str) -> None:
    made = film(walks(render), seed=0, seconds=600)
    assert (len(made.stills), says in made.lacks) == (stills, True), made.lacks


def test_what_an_environment_says_is_printable_and_bounded() -> None:
    env = walks()
    env.single_observation_space = gym.spaces.Dict({"\u202e" * 5_000: gym.spaces.Discrete(2)})
    told = facts_of(env)
    assert (told["actions"], told["autoreset"]) == ("Discrete(2)", "NEXT_STEP")
    assert all(len(value) < 8_000 and value.isascii() for value in told.values())


def test_memory_is_noted_where_a_server_counts_it() -> None:
    play = Play()
    for used in ({"memory_bytes": 3}, {}):
        assert play.count(used) is used
    assert play.memory == [3]


def test_a_play_counts_episodes_until_rewards_cannot_be_counted() -> None:
    """As ``envhub run`` does: resets are no steps. What odd rewards mean is for the checks."""
    env = walks()
    trace = traces.play(env, "NextStep", seed=0, steps=8)
    assert [(one.returns, one.length) for one in trace.counted] == [((6.0,), 3)] * 4
    assert len(trace.spent) == 8
    step, odd = env.step, [np.zeros(2), np.zeros(2), np.zeros(2), np.zeros((2, 3))]

    def stepped(actions: Any) -> Any:
        observations, _, *rest = step(actions)
        return observations, odd.pop(0) if odd else np.zeros(2), *rest

    env.step = stepped
    trace = traces.play(env, "NextStep", seed=0, steps=8)
    assert len(trace.steps) == 9
    assert [one.length for one in trace.counted] == [3, 3], "those before"
