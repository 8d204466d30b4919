"""What tests of a lying worker share: how to open its environment, to lie, and to be refused."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import cloudpickle
import psutil
import pytest
from gymnasium import spaces

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.vector.suites import EnvSuites
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.spaces.spaces import encode_space
from tests.attacks.client.lying_server import (
    NUM_ENVS,
    Frames,
    Lie,
    LyingSandbox,
    LyingServer,
)

MIB = 1 << 20
GROWTH = 192 * MIB
"""What a lie may make the client take at its worst: the limits of the wire allow 8 MiB headers,
whose decoding takes a multiple of that."""
ACTIONS = [0] * NUM_ENVS
SCRIPT = "<script>steal()</script>"


def opened(liar: LyingServer, folder: str, **options: Any) -> EnvSuites:
    """``make_env`` by way of the liar."""
    timeouts = {"startup_s": 20.0, "step_s": 20.0, "reset_s": 20.0, "call_s": 20.0, "close_s": 1.0}
    options = {"timeouts": timeouts, "n_envs": NUM_ENVS, **options}
    return make_env(folder, sandbox=LyingSandbox(liar), **options)


@contextmanager
def started(liar: LyingServer, folder: str, **options: Any) -> Iterator[Any]:
    """Its environment, after a reset."""
    with opened(liar, folder, **options) as suites:
        suites.env.reset()
        yield suites.env


def relayed(*answers: m.Message | Frames) -> Lie:
    """A lie of a runner's: under the right id one answer, or messages as the frames of one."""
    packed = (m.pack(one) if isinstance(one, m.Message) else one for one in answers)
    frames = list(chain.from_iterable(packed))
    return lambda asked: [asked.answer(frames)]


def pickled(answer: m.Message) -> Frames:
    """An answer in which every object that has no form of its own is a pickle."""
    return m.pack(answer, pickler=cloudpickle.dumps)


def peak_growth(action: Callable[[], object]) -> int:
    """By how much resident memory grew at its highest while ``action`` ran."""
    Path("/proc/self/clear_refs").write_text("5")
    before = psutil.Process().memory_info().rss
    action()
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 - before
    raise AssertionError("there is no VmHWM")


def refuses(action: Callable[[], object]) -> EnvHubError:
    """The error of ours that an action ends in, within bounded memory."""
    caught: list[EnvHubError] = []

    def attempt() -> None:
        with pytest.raises(EnvHubError) as info:
            action()
        caught.append(info.value)

    grown = peak_growth(attempt)
    assert grown < GROWTH, f"the client grew by {grown} bytes"
    return caught[0]


class Canary:
    """Its pickle makes a folder when it is loaded, and so would code in its place."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (self.path,))


def nested(levels: int) -> dict[str, Any]:
    """The description of tuples in tuples."""
    space: Any = encode_space(spaces.Discrete(2))
    for _ in range(levels):
        space = {"kind": "tuple", "spaces": [space]}
    return dict(space)


def system(command: str, **kwargs: Any) -> None:
    """``os.system`` for whoever passes more."""
    subprocess.run(command, shell=True, check=True)


def spec_of(canary: Path) -> dict[str, Any]:
    """What a worker calls the specification of its environment."""
    return {
        "id": "Trap-v0",
        "entry_point": "os:system",
        "vector_entry_point": f"{__name__}:system",
        "kwargs": {"command": f"echo made > {canary}"},
        "additional_wrappers": (),
        "max_episode_steps": 7,
    }
