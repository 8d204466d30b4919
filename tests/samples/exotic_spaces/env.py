"""Every space that has no fixed layout, and the odd corners of those that have one."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

OBSERVATION_SPACE = spaces.Dict(
    {
        "bits": spaces.MultiBinary((2, 3)),
        "choice": spaces.OneOf([spaces.Discrete(3), spaces.Box(-1, 1, (2,))]),
        "graph": spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(4)),
        "grid": spaces.MultiDiscrete([[3, 4], [5, 6]], dtype=np.int32),
        "list": spaces.Sequence(spaces.Box(0, 9, (2,), np.int16)),
        "offset": spaces.Discrete(4, start=-2),
        "pair": spaces.Tuple((spaces.Discrete(5), spaces.Box(-np.inf, np.inf, (3,), np.float64))),
        "scalar": spaces.Box(0, 255, (), np.uint8),
        "stack": spaces.Sequence(spaces.Discrete(7), stack=True),
        "text": spaces.Text(8, charset="héllo wörld"),
    }
)
ACTION_SPACE = spaces.Dict(
    {
        "move": spaces.Discrete(3, start=-1),
        "push": spaces.Box(-1, 1, (2,), np.float32),
        "say": spaces.Text(5),
    }
)


class Cabinet(gym.Env):
    """Shows samples of its own observation space; the reward is made of the whole action."""

    observation_space = OBSERVATION_SPACE
    action_space = ACTION_SPACE

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._left = int(self.np_random.integers(2, 6))
        return self._look(), {}

    def step(self, action):
        self._left -= 1
        reward = float(action["move"]) + float(action["push"].sum()) + len(action["say"])
        return self._look(), reward, self._left == 0, False, {"said": action["say"]}

    def _look(self):
        space = spaces.Dict(OBSERVATION_SPACE.spaces, seed=int(self.np_random.integers(2**31)))
        return space.sample()


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    if use_async_envs:  # Gymnasium cannot put these in shared memory
        return gym.vector.AsyncVectorEnv(
            [Cabinet] * n_envs, shared_memory=False, autoreset_mode=autoreset_mode
        )
    return gym.vector.SyncVectorEnv([Cabinet] * n_envs, autoreset_mode=autoreset_mode)
