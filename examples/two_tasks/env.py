"""A suite of two tasks in a small maze: walk to the goal, or fetch the key first.

Try it::

    envhub run ./examples/two_tasks --episodes 4 --n-envs 2
"""

import gymnasium as gym
from maze import Maze  # a file next to this one

TASKS = {0: "walk to the goal", 1: "fetch the key, then walk to the goal"}


def make_env(n_envs: int = 1, use_async_envs: bool = False, size: int = 6):
    """Returns ``{suite: {task_id: VectorEnv}}``."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return {
        "maze": {
            task: vector([lambda task=task: Maze(TASKS[task], task == 1, size)] * n_envs)
            for task in TASKS
        }
    }
