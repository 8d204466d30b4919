"""A jail turns on the doorbells that it shares with the client: the client goes on all the same.
The client is a process of its own, and this one watches it: it has to come to its end, whatever the
jail does with its copies of the descriptors. The control is a doorbell whose open file description
both sides share: the same acts hold its writer for ever."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.harness import Arena
from tests.attacks.runner.abuser import ABUSE, ANSWERS, DIES, HANGS, watched
from tests.support.processes import eventually

FAMILY = "The client, from inside a jail"
ACTS = ("fill", "block", "block_empty", "race", "close", "shut", "push")
SHARDS = {"n_envs": 2, "use_async_envs": True, "num_workers": 2}
WAYS: dict[str, tuple[Sequence[str], dict[str, Any]]] = {
    # it rings for the next step, has its timeout, and closes: all in one thread
    "'s step": (ACTS, {"steps": [[ANSWERS], [0]]}),
    # while a step waits for a jail that has turned on its doorbells
    "'s close": (["block", "race", "close"], {"steps": [[ANSWERS], [0]], "close": "other"}),
    # one shard turns on its doorbells and says nothing, the other one dies
    " that waits for survivors": (
        ACTS,
        {"steps": [[HANGS, DIES]], "policy": {"restart": "transparent"}, "options": SHARDS},
    ),
}


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
            assert writer.stdout.readline() == b"rings\n"
            assert not eventually(lambda: writer.poll() is not None, 3), "the control failed"
            os.read(bell, 8)  # it is the counter that held it, and nothing else
            assert eventually(lambda: writer.poll() == 0)
        finally:
            writer.kill()
            os.close(bell)


@pytest.mark.short
@pytest.mark.parametrize("what", WAYS)
def test_no_client_is_held_by_its_doorbells(strict: Arena, home: Path, what: str) -> None:
    """Whatever is done to them."""
    acts, order = WAYS[what]
    ended, said = watched(strict, home, acts, **order)
    strict.judge(
        f"hold the client{what} by a doorbell", "succeeds", not ended, "; ".join(said[-3:])
    )
    if what == "'s step":
        assert {f"{act} WorkerTimeoutError" for act in acts} <= set(said), said
