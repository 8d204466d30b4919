"""What tests of a lying worker share: how to open its environment, to lie, and to be refused."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import psutil
import pytest
from gymnasium import spaces

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.vector.suites import EnvSuites
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.spaces.spaces import encode_space
from tests.attacks.client.lying_server import NUM_ENVS, Frames, Lie, LyingSandbox, LyingServer

MIB = 1 << 20
GROWTH = 192 * MIB
"""What a lie may make the client take at its worst: the limits of the wire allow 8 MiB headers,
whose decoding takes a multiple of that."""
ACTIONS = [0] * NUM_ENVS
SCRIPT = "<script>steal()</script>"


def opened(liar: LyingServer, folder: str, **options: Any) -> EnvSuites:
    timeouts = {"startup_s": 60.0, "step_s": 60.0, "reset_s": 60.0, "call_s": 60.0, "close_s": 1.0}
    options = {"timeouts": timeouts, "n_envs": NUM_ENVS, **options}
    return make_env(folder, sandbox=LyingSandbox(liar), **options)


@contextmanager
def started(liar: LyingServer, folder: str, **options: Any) -> Iterator[Any]:
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


def mt19937(**changes: Any) -> dict[str, Any]:
    state = {"key": np.arange(624, dtype=np.uint32), "pos": 3, **changes}
    return {"bit_generator": "MT19937", "state": state}


def philox(**changes: Any) -> dict[str, Any]:
    four = np.zeros(4, np.uint64)
    state = {"counter": four, "key": np.zeros(2, np.uint64)}
    whole = {"state": state, "buffer": four, "buffer_pos": 4, "has_uint32": 0, "uinteger": 0}
    return {"bit_generator": "Philox", **whole, **changes}


def pcg64(inc: int = 1, **changes: Any) -> dict[str, Any]:
    whole = {"state": {"state": 0, "inc": inc}, "has_uint32": 0, "uinteger": 0}
    return {"bit_generator": "PCG64", **whole, **changes}


def sfc64(state: Any = None, **changes: Any) -> dict[str, Any]:
    words = np.zeros(4, np.uint64) if state is None else state
    return {"bit_generator": "SFC64", "state": {"state": words}, "has_uint32": 0, "uinteger": 0,
            **changes}  # fmt: skip


STATES: dict[str, Any] = {
    "an index far away": mt19937(pos=2**31 - 1),
    "an index before the key": mt19937(pos=-1),
    "an index just behind the key": mt19937(pos=625),
    "an index that is a flag": mt19937(pos=True),
    "an index that is a float": mt19937(pos=3.0),
    "a short key": mt19937(key=np.arange(623, dtype=np.uint32)),
    "a key of another dtype": mt19937(key=np.arange(624, dtype=np.uint64)),
    "a key of objects": mt19937(key=np.array([None] * 624, object)),
    "a key that is a list": mt19937(key=[0] * 624),
    "a key that never yields anything but zero": mt19937(key=np.zeros(624, np.uint32)),
    "a field more": mt19937(more=1),
    "a buffer's index before it": philox(buffer_pos=-64),
    "a buffer's index behind it": philox(buffer_pos=5),
    "a buffer's index that it never has": philox(buffer_pos=0),
    "a flag of two": philox(has_uint32=2),
    "a word of 33 bits": philox(uinteger=2**32),
    "a negative word": philox(uinteger=-1),
    "a short buffer": philox(buffer=np.zeros(3, np.uint64)),
    "a counter of another dtype": philox(state={"counter": np.zeros(4), "key": np.zeros(2)}),
    "a state of 129 bits": pcg64(state={"state": 2**128, "inc": 1}),
    "a negative state": pcg64(state={"state": -1, "inc": 1}),
    "an increment with which it stands still": pcg64(inc=0),
    "no increment": pcg64(state={"state": 1}),
    "a word that is an array": pcg64(uinteger=np.zeros(2)),
    "five words": sfc64(np.zeros(5, np.uint64)),
    "words of two dimensions": sfc64(np.zeros((2, 2), np.uint64)),
    "a flag that is a text": sfc64(has_uint32="1"),
    "a state that is a list": {"bit_generator": "SFC64", "state": []},
    "a generator by another name": {"bit_generator": "os.system"},
    "a name that is an array": {"bit_generator": np.zeros(3)},
    "no name": {},
    "no mapping": 3,
    "nothing": None,
    "text": "PCG64",
}
