"""Repositories in the shapes that LeRobot's pages show, each served by the Hub on loopback."""

from tests.hub.olah_server import OlahServer

REACH = '''
import os

import gymnasium as gym
import numpy as np

os.environ["REACHED"] = "whoever executed this file"

class Reach(gym.Env):
    """A point that is to come to a goal: what a LeRobot policy looks for in an environment."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, task="reach"):
        box = lambda n: gym.spaces.Box(-10.0, 10.0, (n,), np.float32)
        spaces = {"agent_pos": box(2), "environment_state": box(2)}
        self.observation_space = gym.spaces.Dict(spaces)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = "rgb_array"
        self.task, self.task_description = task, f"{task} the goal"
        self._max_episode_steps = 6
        self.ready = False

    def initialize(self):
        self.ready = True

    def _seen(self):
        return {"agent_pos": self.at.copy(), "environment_state": self.goal.copy()}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(2, np.float32)
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        self.steps = 0
        return self._seen(), {"is_success": False}

    def step(self, action):
        self.steps += 1
        self.at = np.clip(self.at + 0.5 * np.asarray(action, np.float32), -10, 10)
        away = float(np.linalg.norm(self.at - self.goal))
        ends = self.steps >= self._max_episode_steps
        return self._seen(), -away, away < 0.1, ends, {"is_success": away < 0.1}

    def render(self):
        frame = np.full((32, 32, 3), 90, np.uint8)
        x, y = (np.clip(self.at + 2, 0, 3.9) * 8).astype(int)
        frame[x, y] = 255
        return frame

def make_env(n_envs=1, use_async_envs=False, cfg=None):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Reach] * n_envs)
'''

# takes the next of its initial states at each reset, as LIBERO does
COUNTING = REACH.replace(
    "        self.steps = 0\n",
    "        self.resets = getattr(self, 'resets', 0) + 1\n"
    "        self.goal += self.resets\n        self.steps = 0\n",
)
assert COUNTING != REACH
SUITES = """
import gymnasium as gym
from reach import Reach

def make_env(n_envs=1, use_async_envs=False):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    made = lambda task: vector([lambda: Reach(task)] * n_envs)
    return {"near": {0: made("touch"), 1: made("push")}, "far": {0: made("throw")}}
"""
SINGLE = """
from reach import Reach

def make_env(n_envs=1, use_async_envs=False):
    return Reach()
"""
CONFIGURED = """
import gymnasium as gym
from reach import Reach

def make_env(n_envs=1, use_async_envs=False, cfg=None):
    return gym.vector.SyncVectorEnv([lambda: Reach(cfg.environment)] * n_envs)
"""
CARTPOLE = """
import gymnasium as gym

def make_env(n_envs=1, use_async_envs=False):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: gym.make("CartPole-v1")] * n_envs)
"""
PENDULUM = '''
import gymnasium as gym
import numpy as np

class AsRobot(gym.ObservationWrapper):
    """Pendulum, whose observation LeRobot takes for a robot's joints."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Dict({"agent_pos": env.observation_space})

    def observation(self, observation):
        return {"agent_pos": observation.astype(np.float32)}

def make_env(n_envs=1, use_async_envs=False):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    make = lambda: AsRobot(gym.make("Pendulum-v1", max_episode_steps=5, render_mode="rgb_array"))
    return vector([make] * n_envs)
'''
CAMERAS = """
import gymnasium as gym
import numpy as np

class Seen(gym.Env):
    def __init__(self):
        camera = gym.spaces.Box(0, 255, (24, 32, 3), np.uint8)
        spaces = gym.spaces.Dict
        self.observation_space = spaces(
            {"pixels": spaces({"top": camera, "wrist": camera}),
             "agent_pos": gym.spaces.Box(-1, 1, (6,)), "forces": gym.spaces.Box(-1, 1, (3,))}
        )
        self.action_space = gym.spaces.Box(-1, 1, (6,))

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Seen] * n_envs)
"""
LIBERO = """
import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Text

camera, vector = Box(0, 255, (24, 32, 3), np.uint8), lambda *shape: Box(-1, 1, shape, np.float64)

class Kitchen(gym.Env):
    metadata = {"render_fps": 80}
    observation_space = Dict({
        "pixels": Dict({"image": camera, "image2": camera}),
        "robot_state": Dict({
            "eef": Dict({"pos": vector(3), "quat": vector(4), "mat": vector(3, 3)}),
            "gripper": Dict({"qpos": vector(2), "qvel": vector(2)}),
            "joints": Dict({"pos": vector(7), "vel": vector(7)}),
        }),
        "scene": Text(8),
    })
    action_space = Box(-1, 1, (7,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Kitchen] * n_envs)
"""
DECLARED = LIBERO.replace(
    '{"render_fps": 80}',
    """{"render_fps": 80, "env_preprocessor": {"steps": [
        {"registry_name": "libero_processor"},
        {"registry_name": "rename_observations_processor",
         "config": {"rename_map": {"observation.images.image2": "observation.images.wrist"}}},
    ]}}""",
)
ARENA = """
import gymnasium as gym
import torch
from gymnasium.spaces import Box, Dict

camera = Box(0, 255, (16, 24, 3), "uint8")

class Arena(gym.vector.VectorEnv):
    metadata = {"render_fps": 50, "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    single_action_space = Box(-1, 1, (3,))

    def __init__(self, num_envs):
        states = Dict({"robot_joint_pos": Box(-9, 9, (4,)), "fingers": Box(-9, 9, (2, 3))})
        cameras = Dict({"robot_pov_cam_rgb": camera, "front": camera})
        self.single_observation_space = Dict({"policy": states, "camera_obs": cameras})
        self.num_envs = num_envs
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self._max_episode_steps, self.task = 3, "open the door"

    def _seen(self):
        image = (torch.arange(16 * 24 * 3) % 251).to(torch.uint8).reshape(1, 16, 24, 3)
        images = image.expand(self.num_envs, -1, -1, -1)
        at = torch.arange(4.0).expand(self.num_envs, 4) + self.steps
        return {
            "policy": {"robot_joint_pos": at, "fingers": torch.ones(self.num_envs, 2, 3)},
            "camera_obs": {"robot_pov_cam_rgb": images, "front": images},
        }

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self._seen(), {}

    def step(self, actions):
        self.steps += 1
        rewards, ends = actions.sum(axis=1).astype(float), [self.steps >= 3] * self.num_envs
        never = torch.zeros(self.num_envs, dtype=bool).numpy()
        return self._seen(), rewards, never, never | ends, {"is_success": ~never}

    def render(self):
        return [image.numpy() for image in self._seen()["camera_obs"]["front"] + self.steps]

    def call(self, name, *args, **kwargs):
        value = getattr(self, name)
        return tuple(value()) if callable(value) else (value,) * self.num_envs

def make_env(n_envs=1, use_async_envs=False, cfg=None):
    return Arena(n_envs)
"""


def publish(olah: OlahServer) -> dict[str, str]:
    """Everything that the pages load; the commits, by name."""
    commits = {}
    for name, files in {
        "reach": {"env.py": REACH, "envs/reach_task.py": REACH},
        "counting": {"env.py": COUNTING},
        "suites": {"env.py": SUITES, "reach.py": REACH},
        "single": {"env.py": SINGLE, "reach.py": REACH},
        "configured": {"env.py": CONFIGURED, "reach.py": REACH},
        "cartpole": {"env.py": CARTPOLE},
        "pendulum": {"env.py": PENDULUM},
        "cameras": {"env.py": CAMERAS},
        "libero": {"env.py": LIBERO},
        "declared": {"env.py": DECLARED},
        "misdeclared": {"env.py": DECLARED.replace("libero_processor", "os.system")},
        "arena": {"env.py": ARENA},
        "nothing": {"env.py": "def build():\n    pass\n"},
        "missing": {"env.py": "import gym_pybullet_drones_that_is_not_here\n"},
        "wrong": {"env.py": "def make_env(n_envs=1, use_async_envs=False):\n    return 7\n"},
    }.items():
        commits[name] = olah.repository(f"robots/{name}").commit(files, tag="v1.0")
    space = olah.repository("robots/uploaded", "space")
    commits["uploaded"] = space.commit({"env.py": CARTPOLE, "requirements.txt": "gymnasium\n"})
    return commits
