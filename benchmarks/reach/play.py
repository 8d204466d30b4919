"""Plays an environment and prints what comes: the Python, the reset, and a line for each step.

``play.py REF ARGUMENTS``: in a sandbox, with further arguments of ``make_env`` as JSON.
``play.py ENTRY``: its entry file imported as LeRobot does it, in an interpreter that has the
package and nothing of ours.
"""

from __future__ import annotations

import hashlib
import json
import platform
import runpy
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

SEED, STEPS = 7, 40


def main(arguments: list[str]) -> None:
    """Play it in the way that the arguments say."""
    if len(arguments) == 1:
        env = runpy.run_path(arguments[0])["make_env"](n_envs=1)
        print("\n".join([f"CPython {platform.python_version()}", *played(env)]))
        return
    from envhub_sandbox import make_env

    with make_env(arguments[0], **json.loads(arguments[1])) as suites:
        print(suites.provenance["interpreter"]["version"], flush=True)
        print("\n".join(played(suites.env)))


def played(env: Any) -> Iterator[str]:
    """A hash of each observation, with reward and flags."""
    env.action_space.seed(SEED)
    yield digest(env.reset(seed=SEED)[0])
    for _ in range(STEPS):
        observation, *rest, _ = env.step(env.action_space.sample())
        yield " ".join([digest(observation), *(repr(np.asarray(one).tolist()) for one in rest)])


def digest(value: Any) -> str:
    """The same for equal observations, bit for bit."""
    return hashlib.sha256(repr(plain(value)).encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Lists of texts and arrays, without an order of keys."""
    if isinstance(value, dict):
        return [[key, plain(value[key])] for key in sorted(value)]
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    array = np.asarray(value)
    return [
        str(array.dtype),
        array.shape,
        array.tolist() if array.dtype == object else array.tobytes(),
    ]


if __name__ == "__main__":
    main(sys.argv[1:])
