"""A jail turns on the doorbells that it shares with the client: the client goes on all the same.

The client is a process of its own, and this one watches it: it has to come to its end, whatever the
jail does with its copies of the descriptors. The control is a doorbell whose open file description
both sides share: the same acts hold its writer for ever.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.attacks.harness import Arena
from tests.attacks.runner.abuser import ABUSE, ANSWERS, DIES, HANGS, watched
from tests.support.processes import eventually

FAMILY = "The client, from inside a jail"
ACTS = ("fill", "block", "block_empty", "race", "close", "shut", "push")


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


@pytest.mark.short("strict-fill")
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
