"""A jail turns on the doorbells that it shares with the client: the client goes on all the same.

The client is a process of its own, and this one watches it: it has to come to its end, whatever the
jail does with its copies of the descriptors. The control is a doorbell whose open file description
both sides share: the same acts hold its writer for ever.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.harness import Arena
from tests.support.processes import eventually
from tests.support.repositories import write_repository

FAMILY = "The client, from inside a jail"
WATCHDOG_S = 180
"""Far more than all timeouts of the client together."""

ABUSE = """
import contextlib, os, socket, stat, threading

ONE = (1).to_bytes(8, "little")

def fill(fd):
    os.set_blocking(fd, False)
    with contextlib.suppress(OSError):
        os.write(fd, (2**64 - 2).to_bytes(8, "little"))
    with contextlib.suppress(OSError):
        while True:
            os.write(fd, ONE)

def block(fd):
    fill(fd)
    os.set_blocking(fd, True)

def block_empty(fd):
    os.set_blocking(fd, False)
    with contextlib.suppress(OSError):
        while os.read(fd, 8):
            pass
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
    if ours := a_socket(fd):
        ours.setblocking(False)
        with contextlib.suppress(OSError):
            while True:
                socket.send_fds(ours, [ONE], [0] * 200)
"""
ACTS = ("fill", "block", "block_empty", "race", "close", "shut", "push")

ENV = """
import gymnasium as gym, numpy as np, os, signal, time
from envhub_worker.jail import host
from envhub_worker.protocol import messages as m, slabs

ABUSE_AND_ANSWER, ABUSE_AND_HANG, DIE = 1, 2, 3
lanes = []
honest = host.Host.attach

def remember(self, request):
    reply = honest(self, request)
    lanes.append(self.lane)
    return reply

host._HANDLERS[m.Attach] = remember

def answer(lane):
    lane._told[slabs.OUTCOME], lane._told[slabs.LENGTH] = slabs.DONE, 0
    lane._told[slabs.PARKED] = 1
    lane._told[slabs.SEQUENCE] = lane._asked[slabs.SEQUENCE]
    with contextlib.suppress(OSError):
        os.set_blocking(lane._client_bell, False)
        os.write(lane._client_bell, ONE)

def turn_on(bells):
    for bell in bells:
        globals()[{act!r}](bell)

class Abuser(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1), {{}}

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
        return np.zeros(1), 0.0, False, False, {{}}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.AsyncVectorEnv([Abuser] * n_envs)
"""
ANSWERS, HANGS, DIES = 1, 2, 3


def watched(arena: Arena, folder: Path, act: str, **order: Any) -> tuple[bool, list[str]]:
    """Whether a client whose environment does this came to its end, and what it said."""
    repository = write_repository(folder / "abuser", ABUSE + ENV.format(act=act))
    whole = {
        "policy": {"profile": arena.profile, "crash_history": 0, **order.pop("policy", {})},
        "options": order.pop("options", {}),
        "close": "same",
        "head_start_s": 1.0,
        **order,
    }
    command = [sys.executable, "-m", "tests.attacks.held_client", str(repository)]
    client = subprocess.Popen(
        [*command, json.dumps(whole)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=Path(__file__).parents[2],
        text=True,
    )
    try:
        said, _ = client.communicate(timeout=WATCHDOG_S)
    except subprocess.TimeoutExpired:
        client.kill()
        said, _ = client.communicate()
        return False, [*said.splitlines(), "held"]
    return client.returncode == 0 and said.endswith("closed\n"), said.splitlines()


def judge(arena: Arena, title: str, act: str, ended: bool, said: list[str]) -> None:
    """The act that has a control is a row of the table; the others have to be survived as well."""
    if act == "block":
        arena.judge(title, "succeeds", not ended, "; ".join(said[-3:]))
    assert ended, (act, said)


def test_a_shared_description_holds_its_writer(tmp_path: Path) -> None:
    """The control: an eventfd that was filled and made blocking by another who holds it."""
    bell = os.eventfd(0, os.EFD_NONBLOCK)
    ring = f"import os; print('rings', flush=True); os.write({bell}, (1).to_bytes(8, 'little'))"
    subprocess.run(
        [sys.executable, "-c", f"{ABUSE}\nblock({bell})"], pass_fds=[bell], check=True, timeout=60
    )
    with subprocess.Popen(
        [sys.executable, "-c", ring], pass_fds=[bell], stdout=subprocess.PIPE
    ) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"rings\n"
            assert not eventually(lambda: writer.poll() is not None, 3), "the control failed"
            os.read(bell, 8)  # it is the counter that held it, and nothing else
            assert eventually(lambda: writer.poll() == 0)
        finally:
            writer.kill()
            os.close(bell)


@pytest.mark.parametrize("act", ACTS)
def test_a_client_that_is_answered_is_not_held(arena: Arena, home: Path, act: str) -> None:
    """It rings for the next step, has its timeout, and closes: all in one thread."""
    ended, said = watched(arena, home, act, steps=[[ANSWERS], [0]])
    judge(arena, "hold the client's step by a doorbell", act, ended, said)
    assert "WorkerTimeoutError" in said, said


@pytest.mark.parametrize("act", ["block", "race", "close"])
def test_a_close_from_another_thread_is_not_held(arena: Arena, home: Path, act: str) -> None:
    """While a step waits for a jail that has turned on its doorbells."""
    ended, said = watched(arena, home, act, steps=[[ANSWERS], [0]], close="other")
    judge(arena, "hold the client's close by a doorbell", act, ended, said)


@pytest.mark.parametrize("act", ACTS)
def test_a_wait_for_survivors_is_not_held(arena: Arena, home: Path, act: str) -> None:
    """One shard turns on its doorbells and says nothing, the other one dies."""
    ended, said = watched(
        arena,
        home,
        act,
        steps=[[HANGS, DIES]],
        policy={"restart": "transparent"},
        options={"n_envs": 2, "use_async_envs": True, "num_workers": 2},
    )
    judge(arena, "hold the client that waits for survivors by a doorbell", act, ended, said)
