"""Prints a lot, with escape sequences that clear screens and set titles, and then fails."""

import sys

import gymnasium as gym

NASTY = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202etxt\x08"


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, fail: bool = True, lines: int = 50
) -> gym.vector.VectorEnv:
    for number in range(lines):
        print(f"{NASTY} line {number}")
        print(f"{NASTY} line {number}", file=sys.stderr, flush=True)
    if fail:
        raise RuntimeError(f"{NASTY} gave up")
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)
