"""What is denied can be recorded; who is recorded gets no further by it, and hides nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from envhub_sandbox import make_env
from tests.support import inside
from tests.support.repositories import write_repository

_ATTEMPTS = """
import ctypes, os, socket
import gymnasium as gym
import numpy as np

LIBC = ctypes.CDLL(None, use_errno=True)

def answer(call, *arguments):
    return 0 if call(*arguments) == 0 else ctypes.get_errno()

def inet():
    try:
        socket.socket(socket.AF_INET).close()
    except OSError as error:
        return error.errno
    return 0

def attempts():
    return [
        inet(),
        answer(LIBC.unshare, 0x10000000),
        answer(LIBC.ptrace, 16, os.getppid(), 0, 0),
        answer(LIBC.mount, b"none", b"/tmp", b"tmpfs", 0, 0),
    ]

class Attempts(gym.Env):
    observation_space = gym.spaces.Box(0, 200, (4,), np.int64)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(4, np.int64), {}

    def step(self, action):
        if action == 0:
            for _ in range(2000):
                inet()
        return np.array(attempts(), np.int64), 0.0, False, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Attempts] * n_envs)
"""


def attempts(denied: Sequence[str]) -> list[str]:
    """Without what allocators and pools of threads try on their way."""
    assert len(set(denied)) == len(denied)
    return sorted(set(denied) - inside.HARMLESS_DENIALS)


def test_a_recorded_jail_is_refused_the_same(tmp_path: Path) -> None:
    """With the same errors; each attempt is told once, however often, and only where it is asked.

    The control is the jail that records nothing, and the reset that tries nothing: the jail's own
    test of its denials is no attempt of the repository.
    """
    folder = write_repository(tmp_path / "attempts", _ATTEMPTS)
    answers = {}
    for recorded in (False, True):
        with make_env(str(folder), policy={"record_denials": recorded}) as suites:
            env = suites.env
            assert env.jail_denials() is None, "it does not run"
            env.reset(seed=0)
            denied = env.jail_denials()
            assert (attempts(denied) if recorded else denied) == ([] if recorded else None)
            answers[recorded] = env.step([1])[0].tolist()
            env.step([0])
            told = env.jail_denials()
    assert 0 not in answers[True][0]
    assert answers[True] == answers[False]
    assert told is not None
    assert attempts(told) == ["mount", "ptrace", "socket AF_INET", "unshare"]
