"""Counts, ends after a random number of steps, and puts every kind of value into its infos."""

import enum

import gymnasium as gym
import numpy as np


class Mode(enum.Enum):
    """Something that is no plain value."""

    SLOW = "slow"
    FAST = "fast"


class Counter(gym.Env):
    """Observation: ``[steps in this episode, episodes so far, a random number]``."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Discrete(3)
    render_mode = "rgb_array"

    def __init__(self, index: int) -> None:
        self.index = index
        self.gain = 1.0
        self.episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        self.episode += 1
        self.length = int(self.np_random.integers(2, 7))
        return self._observe(), {"started": self.episode, "options": repr(options)}

    def step(self, action):
        self.count += 1
        # Gymnasium takes any number for a reward
        reward = (int(action), float(action) / 3, np.float32(0.1))[self.count % 3]
        over = self.count >= self.length
        terminated = np.bool_(over and self.episode % 2 == 0)
        info = self._info(over)
        if self.gain != 1:  # in float64, whatever numpy makes of a float32 and a number
            reward = float(reward) * self.gain
        return self._observe(), reward, terminated, over and not terminated, info

    def render(self):
        return np.full((4, 6, 3), self.count, np.uint8)

    def add(self, a: int, b: int = 10) -> int:
        """A method to be called from outside."""
        return self.index * 100 + a + b

    def fail(self) -> None:
        """A method that does what its name says."""
        raise ValueError(f"counter {self.index} failed")

    def not_here(self) -> None:
        """A method that this environment leaves out."""
        raise NotImplementedError

    def _observe(self):
        return np.array([self.count, self.episode, self.np_random.random()], np.float32)

    def _info(self, over: bool):
        info = {
            "count": self.count,
            "ratio": self.count / 3,
            "even": self.count % 2 == 0,
            "small": np.int8(self.count),
            "single": np.float32(self.count / 3),
            "phase": np.complex64(1j**self.count),
            "flag": np.bool_(self.count % 2),
            "text": f"step {self.count}\n\x1b[31mé",
            "nothing": None,
            "items": [self.count, "two", 3.0, None],
            "pair": (self.count, (1, 2)),
            "raw": bytes([0, 255, self.count]),
            "z": complex(self.count, -1),
            "big": [2**80, -(2**63)],
            "mode": Mode.FAST if self.count % 2 else Mode.SLOW,
            "array": np.arange(3, dtype=np.int16) * self.count,
            "zero_d": np.array(self.count / 7),
            "words": np.array(["ab", "cde"]),
            "nested": {"a": {"b": self.count, "c": "deep"}, "empty": {}, "array": np.ones((2, 2))},
        }
        if self.count % 2 == self.index % 2:
            info["sometimes"] = self.count
            info["nested"]["sometimes"] = [self.count]
        if over:
            info["is_success"] = self.episode % 3 == 0
        return info


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    autoreset_mode: str | None = "NextStep",
    subclass: bool = False,
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    if subclass:
        vector = type("Own", (vector,), {})
    envs = [lambda index=index: Counter(index) for index in range(n_envs)]
    # releases before 1.1 have no mode to choose
    return vector(envs, **({} if autoreset_mode is None else {"autoreset_mode": autoreset_mode}))
