"""``np_random`` is the environment's own: draws on either side continue those on the other."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.wrappers import AddWhiteNoise, AtariPreprocessing, ObstructView, StickyAction

from envhub_sandbox import SandboxEnv, make_env
from envhub_sandbox.errors import WorkerError
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.repositories import write_repository
from tests.support.samples import make_env_of

_ENV = '''
import gymnasium as gym
import numpy as np

class Drawing(gym.Env):
    """Draws in reset, in step and in render."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"
    observation_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def _seen(self):
        return self.np_random.integers(0, 256, (8, 8, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action):
        if action == 2:
            raise ValueError(self.np_random.random())
        self.steps += 1
        over = self.steps == 12
        return self._seen(), float(self.np_random.random() + action), over, False, {}

    def render(self):
        return self._seen()

    def get_action_meanings(self):
        return ["NOOP", "FIRE", "FAIL"]

class Own(gym.vector.VectorEnv):
    """A vector environment with one generator, which is Gymnasium's."""

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}

    def __init__(self, count):
        self.num_envs = count
        self.single_observation_space = gym.spaces.Box(-9, 9, (2,))
        self.single_action_space = gym.spaces.Discrete(3)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, count)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, count)

    def _seen(self):
        return self.np_random.normal(size=(self.num_envs, 2)).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, actions):
        no = np.zeros(self.num_envs, bool)
        return self._seen(), self.np_random.random(self.num_envs), no, no, {}

def make_env(n_envs=1, use_async_envs=False, own=False):
    if own:
        return Own(n_envs)
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls([Drawing] * n_envs)
'''


class _Screen:
    """What ``AtariPreprocessing`` asks an emulator for beside the environment."""

    def lives(self) -> int:
        return 3

    def getScreenGrayscale(self, buffer: Any) -> None:  # its name there
        buffer[:] = 7


class _Atari(AtariPreprocessing):
    ale = property(lambda self: _Screen())


_WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "StickyAction": lambda env: StickyAction(env, 0.5, (1, 3)),
    "AddWhiteNoise": lambda env: AddWhiteNoise(env, probability_of_noise_per_pixel=0.3),
    "ObstructView": lambda env: ObstructView(env, obstructed_pixels_ratio=0.3, obstruction_width=2),
    "AtariPreprocessing": lambda env: _Atari(env, frame_skip=1, noop_max=5),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("drawing"), _ENV)


@pytest.fixture(params=["auto", "frames", "async", "worker"])
def single(folder: Path, request: pytest.FixtureRequest) -> Iterator[SandboxEnv]:
    """One environment over each lane, and where its vector environment is of another kind."""
    options: dict[str, Any] = {"async": {"use_async_envs": True}, "worker": {"min_ready": 1}}.get(
        request.param, {"policy": {"lane": request.param}}
    )
    with contextlib.closing(SandboxEnv(folder, **options)) as env:
        yield env


def _here(folder: Path, **arguments: Any) -> Any:
    return make_env_of(folder)(**arguments)


def _played(env: Any) -> list[Any]:
    seen: list[Any] = []
    for episode in range(3):
        seen.append(env.reset(seed=5 if episode == 0 else None))
        for step in range(14):
            result = env.step(step % 2)
            seen += [result, env.render()]
            if result[2]:
                break
    return seen


@pytest.mark.parametrize("name", list(_WRAPPERS))
def test_wrappers_draw_as_in_one_process(folder: Path, single: SandboxEnv, name: str) -> None:
    """Also where the environment draws in between, in steps, resets and renders."""
    wrap = _WRAPPERS[name]
    expected = _played(wrap(_here(folder).envs[0]))
    assert_same(expected, _played(wrap(single)))


def _kept(env: Any) -> list[Any]:
    """Draws by what the caller has kept, put there, and set back; what an error cost."""
    env.reset(seed=3)
    kept = env.np_random
    draw, bits = kept.random, kept.bit_generator
    seen: list[Any] = []
    for _ in range(3):
        seen += [env.step(1), draw(), env.step(1), bits.random_raw(), kept.integers(9, size=3)]
    with pytest.raises(ValueError):  # noqa: PT011  # a number
        env.step(2)
    seen += [draw(), env.np_random is kept]
    state = kept.bit_generator.state
    seen.append(env.step(1))
    kept.bit_generator.state = state
    seen.append(env.step(1))
    env.reset(seed=4)
    seen += [env.np_random is kept, kept.random(), env.np_random.random(), env.step(1)]
    for bits in (np.random.PCG64(8), np.random.MT19937(8), np.random.Philox(8)):
        env.np_random = mine = np.random.Generator(bits)
        seen += [env.np_random is mine, env.unwrapped.np_random_seed, env.step(1), mine.random()]
        seen += [env.step(1), mine.random(), env.unwrapped.np_random.random()]
    return seen


def test_a_generator_that_is_kept_stays_the_environments(folder: Path, single: SandboxEnv) -> None:
    """As long as the environment has the same one: a seed gives it another."""
    assert_same(_kept(_here(folder).envs[0]), _kept(single))
    with pytest.raises(TypeError, match="PCG64"):
        single.np_random = 3


def _vectors(env: Any) -> list[Any]:
    seen = [env.reset(seed=[1, 2])]
    for _ in range(3):
        seen.append([one.random() for one in env.np_random])
        seen += [env.envs[1].np_random.random(), env.step([0, 1])]
        seen.append([one.random() for one in env.get_attr("np_random")])
    kept = env.np_random
    seen += [env.envs[1].step(0)[:2], [one.random() for one in kept], env.step([0, 1])]
    env.envs[0].np_random = mine = np.random.default_rng(7)
    return [*seen, env.step([0, 1]), mine.random(), env.envs[0].unwrapped.np_random is mine]


@pytest.mark.parametrize(
    "where", [{}, {"policy": {"lane": "frames"}}, {"sandbox": ["process", "process"]}], ids=str
)
def test_those_of_a_vector_environment_are_gymnasiums(folder: Path, where: dict[str, Any]) -> None:
    """Live in a ``SyncVectorEnv``, copies of an ``AsyncVectorEnv``, and one of a class's own."""
    with make_env(str(folder), n_envs=2, **where) as suites:
        assert_same(_vectors(_here(folder, n_envs=2)), _vectors(suites.env))
        with pytest.raises(AttributeError, match="envs"):
            suites.env.np_random = np.random.default_rng(1)
    with make_env(str(folder), n_envs=2, use_async_envs=True, **where) as suites:
        suites.env.reset(seed=1)
        first, again = (suites.env.np_random[0].random() for _ in range(2))
        assert first == again
    ours = make_env(str(folder), n_envs=2, **where, env_kwargs={"own": True})
    with ours as suites:
        played = []
        for env in (suites.env, _here(folder, n_envs=2, own=True)):
            seen = [env.reset(seed=1), env.np_random.random(), env.step([0, 1])]
            env.np_random = mine = np.random.default_rng(7)
            played.append([*seen, env.step([0, 1]), mine.random(), env.np_random is mine])
        assert_same(*played)


def test_send_and_recv_take_the_draws_along(folder: Path) -> None:
    """Those before the first ``send``; while something is in flight, nobody is asked for more. A
    worker that has died takes none; ``send_reset`` starts another."""
    seen = []
    options: dict[str, Any] = {"min_ready": 1, "policy": {"restart": "on_reset"}}
    for env in (_here(folder, n_envs=2), make_env(str(folder), n_envs=2, **options).env):
        env.reset(seed=1)
        kept = env.np_random
        drawn = [one.random() for one in kept]
        if hasattr(env, "send"):
            env.send([0, 1])
            result = env.recv(2)[:2]
        else:
            result = env.step([0, 1])[:2]
        seen.append([drawn, result, [one.random() for one in kept], env.step([0, 1])[:2]])
    assert_same(*seen)
    for pid in inside.part_pids(inside.parts(env)[0]):
        os.kill(pid, signal.SIGKILL)
    kept[0].random()
    with pytest.raises(WorkerError):
        env.step([0, 1])
    env.send_reset(seed=2)
    assert len(env.recv(min_ready=2)[-1]) == 2
    env.close()
