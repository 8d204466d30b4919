"""Does one thing wrong, at the moment that it is told to. ``fault.json`` says what at import."""

import atexit
import ctypes
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np

HERE = Path(__file__).parent


def hang() -> None:
    while True:
        time.sleep(3600)


def stop() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail() -> None:
    raise ValueError("no luck today")


def missing() -> None:
    import no_such_package_of_ours  # noqa: F401


def segfault() -> None:
    ctypes.string_at(0)


def memory() -> None:
    kept = []
    while True:
        kept.append(b"x" * (16 << 20))


def disk() -> None:
    with open(Path.home() / "big", "wb") as file:
        while True:
            file.write(b"x" * (1 << 20))


def spin() -> None:
    while True:
        pass


def recursion() -> None:
    recursion()


def flood() -> None:
    for _ in range(16):
        print("y\x1b[31m" * (1 << 17))
    print("the last words")


def thread() -> None:
    threading.Thread(target=hang).start()


def at_exit() -> None:
    atexit.register(hang)


def children() -> None:
    """Daemons, by double fork, deaf to SIGTERM; with files wherever they can be written."""
    for place in ("/dev/shm", "/tmp", "/var/tmp", str(Path.home())):
        try:
            Path(place, "envhub-fault-marker").write_text("left behind")
        except OSError:
            continue
    for _ in range(3):
        if os.fork() == 0:
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            if os.fork() == 0:
                hang()
            os._exit(0)


FAULTS = {
    "raise": fail,
    "missing": missing,
    "hang": hang,
    "exit": lambda: os._exit(7),
    "sys.exit": lambda: sys.exit(8),
    "kill": kill,
    "segfault": segfault,
    "stop": stop,
    "memory": memory,
    "disk": disk,
    "cpu": spin,
    "recursion": recursion,
    "flood": flood,
    "thread": thread,
    "atexit": at_exit,
    "children": children,
}


class Faulty(gym.Env):
    """Observation: ``[steps since the reset]``. The last sub-environment is the faulty one."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Box(0, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    render_mode = "rgb_array"

    def __init__(self, faulty: bool, moment: str, fault: str) -> None:
        self.faulty, self.moment, self.fault = faulty, moment, fault
        self.armed = False
        self._maybe("init")

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options:
            self._maybe("reset")
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        if action == 1:
            self._maybe("step")
        self.steps += 1
        return np.full(1, self.steps, np.float32), 0.0, False, False, {}

    def render(self):
        if self.armed:
            self._maybe("render")
        return np.zeros((2, 2, 3), np.uint8)

    def trip(self) -> int:
        """Something to call."""
        self._maybe("call")
        return self.steps

    def close(self):
        self._maybe("close")

    def _maybe(self, moment: str) -> None:
        if self.faulty and moment == self.moment:
            print(f"about to {self.fault}", flush=True)
            FAULTS[self.fault]()


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    moment: str = "never",
    fault: str = "",
    tasks: int = 0,
):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    if moment == "make":
        print(f"about to {fault}", flush=True)
        FAULTS[fault]()

    def make(index: int, at: str):
        return lambda: Faulty(index == n_envs - 1, at, fault)

    def one(at: str):
        return vector([make(index, at) for index in range(n_envs)])

    if not tasks:
        return one(moment)
    # in a suite only task 0 is faulty
    return {"suite": {task: one("never" if task else moment) for task in range(tasks)}}


if (HERE / "fault.json").exists():
    at_import = json.loads((HERE / "fault.json").read_text())
    print(f"about to {at_import}", flush=True)
    FAULTS[at_import]()
