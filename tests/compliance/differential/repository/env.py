"""Sub-environments that share something of their process, or do not."""

import functools
import itertools
import os
import random

import gymnasium as gym
import numpy as np

TOTAL = 0
SEEN = []
NUMBERS = itertools.count()
GENERATOR = np.random.default_rng(5)
LEGACY = np.random.RandomState(5)


def module(env):
    global TOTAL
    TOTAL += 1
    return TOTAL


def of_class(env):
    type(env).steps += 1
    return type(env).steps


def first_of_class(env):
    if type(env).scale is None:
        type(env).scale = env.index + 1
    return type(env).scale


def appended(env):
    SEEN.append(env.index)
    return len(SEEN)


def default(env, seen={}):  # noqa: B006
    seen[env.index] = seen.get(env.index, 0) + 1
    return len(seen)


@functools.cache
def cached(key):
    return []


def in_cache(env):
    cached("all").append(env.index)
    return len(cached("all"))


def environment(env):
    os.environ["STEPS"] = str(int(os.environ.get("STEPS", 0)) + 1)
    return int(os.environ["STEPS"])


KINDS = {
    "numpy": lambda env: np.random.random(),
    "random": lambda env: random.random(),
    "module": module,
    "class": of_class,
    "first of class": first_of_class,
    "list": appended,
    "default": default,
    "cache": in_cache,
    "environment": environment,
    "iterator": lambda env: next(NUMBERS),
    "generator": lambda env: GENERATOR.random(),
    "legacy generator": lambda env: LEGACY.random_sample(),
}


class Sharing(gym.Env):
    """Takes what its kinds say, in each reset and in every so many steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Discrete(3)
    steps = 0
    scale = None

    def __init__(self, index, kinds, length, every, told):
        self.index, self.kinds, self.length, self.every = index, kinds, length, every
        self.told = told

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            if "numpy" in self.kinds:
                np.random.seed(seed)
            if "random" in self.kinds:
                random.seed(seed)
        self.now = 0
        return self.heard()

    def heard(self):
        takes = self.now % self.every == 0
        shared = [KINDS[kind](self) for kind in self.kinds] if takes else []
        info = {"shared": np.array(shared, float)} if shared and self.told else {}
        total = 0.0 if self.told else sum(map(float, shared))
        return np.array([self.np_random.random(), total]), info

    def step(self, action):
        self.now += 1
        observation, info = self.heard()
        reward = float(action) + self.index
        return observation, reward, self.now == self.length + self.index, False, info


def make_env(n_envs=1, use_async_envs=False, mode="NextStep", **kwargs):
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    env_fns = [lambda index=index: Sharing(index, **kwargs) for index in range(n_envs)]
    return kind(env_fns, autoreset_mode=mode)
