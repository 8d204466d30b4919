"""A repository whose environment turns on the descriptors that its jail holds, and its client.
The client is a process of its own (``held_client``); whoever asks for it watches it from outside.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.attacks.harness import Arena
from tests.attacks.repositories import write_environment

WATCHDOG_S = 240
"""Far more than all timeouts of the client together."""
ABUSE = """
import contextlib, os, resource, socket, stat, threading

ONE = (1).to_bytes(8, "little")
MANY = 100_000  # more than any pipe or socket holds; /dev/null is never full

def fill(fd):
    os.set_blocking(fd, False)
    with contextlib.suppress(OSError):
        os.write(fd, (2**64 - 2).to_bytes(8, "little"))
    with contextlib.suppress(OSError):
        for _ in range(MANY):
            os.write(fd, ONE)

def block(fd):
    fill(fd)
    os.set_blocking(fd, True)

def block_empty(fd):
    os.set_blocking(fd, False)
    with contextlib.suppress(OSError):
        for _ in range(MANY):
            os.read(fd, 8)
    os.set_blocking(fd, True)

def race(fd):
    block_empty(fd)
    def ring():
        while True:
            os.write(fd, ONE)
    def drain():
        while True:
            os.read(fd, 8)
    for act in (ring, drain):
        threading.Thread(target=act, daemon=True).start()

def truncate(fd):
    with contextlib.suppress(OSError):
        os.ftruncate(fd, 0)

def seek(fd):
    with contextlib.suppress(OSError):
        os.lseek(fd, 1 << 40, os.SEEK_SET)

def close(fd):
    with contextlib.suppress(OSError):
        os.close(fd)

def a_socket(fd):
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.fstat(fd).st_mode):
            return socket.socket(fileno=os.dup(fd))

def shut(fd):
    if ours := a_socket(fd):
        with contextlib.suppress(OSError):
            ours.shutdown(socket.SHUT_RDWR)

def push(fd):
    # what is on its way counts for all programs of a user: the others keep theirs
    resource.setrlimit(resource.RLIMIT_NOFILE, (512, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    if ours := a_socket(fd):
        ours.setblocking(False)
        with contextlib.suppress(OSError):
            while True:
                socket.send_fds(ours, [ONE], [0] * 200)
"""
KEEP = """
import os
from envhub_worker.runner import runner
from envhub_worker.protocol import messages as m

honest, kept, lanes = runner.Runner.attach, [], []

def keep(self, request):
    kept.extend(map(os.dup, self.descriptors))
    reply = honest(self, request)
    lanes.append(self.lanes[request.env])
    return reply

runner._HANDLERS[m.Attach] = keep
"""
"""Keeps what it is given when its steps begin: the lane, and copies of the descriptors."""
ENV = """
import signal, time
from envhub_worker.protocol.shared_memory import slabs

ABUSE_AND_ANSWER, ABUSE_AND_HANG, DIE = 1, 2, 3
order = {}

def answer(lane):
    lane._told[slabs.OUTCOME], lane._told[slabs.LENGTH] = slabs.DONE, 0
    lane._told[slabs.PARKED] = 1
    lane._told[slabs.SEQUENCE] = lane._asked[slabs.SEQUENCE]
    with contextlib.suppress(OSError):
        os.set_blocking(lane._client_bell, False)
        os.write(lane._client_bell, ONE)

def turn_on(bells):
    for fd in every() if order["every"] else bells:
        globals()[order["act"]](fd)

def every():
    found = []
    for fd in range(64):
        with contextlib.suppress(OSError):
            os.fstat(fd)
            found.append(fd)
    return found

VECTOR = gym.vector.AsyncVectorEnv

class Abuser(Plain):
    def reset(self, *, seed=None, options=None):
        order.update(options or {})
        return super().reset(seed=seed)

    def step(self, action):
        lane = lanes[-1]
        if action == ABUSE_AND_ANSWER:
            turn_on([lane.bell])
            answer(lane)
            turn_on([lane._client_bell])
            time.sleep(3600)
        if action == ABUSE_AND_HANG:
            turn_on([lane.bell, lane._client_bell])
            time.sleep(3600)
        if action == DIE:
            time.sleep(0.5)
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)
"""
ANSWERS, HANGS, DIES = 1, 2, 3


def abuser(folder: Path) -> Path:
    """The repository; the options of a reset name a function of ``ABUSE``, and for what it is."""
    return write_environment(folder / "abuser", ABUSE + KEEP + ENV)


def watched(
    arena: Arena, folder: Path, acts: Sequence[str], *, every: bool = False, **order: Any
) -> tuple[bool, list[str]]:
    """Whether a client whose environments do these came to its end, and what it said."""
    whole = {
        "acts": acts,
        "every": every,
        "policy": {"profile": arena.profile, "crash_history": 0, **order.pop("policy", {})},
        "options": order.pop("options", {}),
        "close": "same",
        **order,
    }
    words = ["-m", "tests.attacks.runner.held_client", str(abuser(folder)), json.dumps(whole)]
    client = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=Path(__file__).parents[3],
        text=True,
    )
    try:
        said, _ = client.communicate(timeout=WATCHDOG_S)
    except subprocess.TimeoutExpired:
        client.kill()
        said, _ = client.communicate()
        return False, [*said.splitlines(), "held"]
    return client.returncode == 0 and said.endswith("closed\n"), said.splitlines()
