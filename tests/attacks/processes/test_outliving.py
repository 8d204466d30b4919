"""Living longer than the environment: daemons, and processes that keep moving."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.attacks.harness import (
    HOSTILE,
    Arena,
    Run,
    call,
    control_run,
    kill_named,
    new_alias,
    pids_named,
)
from tests.support.processes import eventually

FAMILY = "Outliving the environment"
_PATIENCE_S = 60.0
"""Far less than what is left behind lives by itself."""
_CLIENT = """
import json, sys, time
from envhub_sandbox import make_env

folder, payload, arguments, profile = json.loads(sys.argv[1])
suites = make_env(folder, policy={"profile": profile})
suites.env.call("attack", payload, arguments, "atk-client")
print("attacked", flush=True)
time.sleep(600)
"""


@pytest.mark.short("strict-a daemon")
@pytest.mark.parametrize(
    ("title", "payload", "more"),
    [
        ("a daemon (double fork)", "daemon", {}),
        ("a process that keeps forking away", "grandchildren", {"seconds": 300}),
        ("a process without its main thread", "leaderless", {}),
    ],
)
def test_nothing_outlives_the_environment(
    arena: Arena, title: str, payload: str, more: dict[str, object]
) -> None:
    alias = new_alias()
    arguments = {"alias": alias, **more}
    with control_run(payload, arguments):
        assert eventually(lambda: bool(pids_named(alias)))
    try:
        # one that keeps forking may be missed by many looks in a row, on a machine that is slow
        assert lives(alias, 60.0), f"the control of {title} ended with its parent"
    finally:
        kill_group(alias)
    # another name: what the control left behind would be blamed on the jail
    alias = new_alias()
    arguments["alias"] = alias
    run = Run(new_alias(), True)
    with arena.environment() as env:
        call(env, run, payload, arguments)
        assert eventually(lambda: bool(pids_named(alias))), run.text
    try:
        # what is killed has ended soon, if not at once where somebody takes the core away
        left = not eventually(lambda: not lives(alias), _PATIENCE_S)
    finally:
        kill_group(alias)
    arena.judge(f"outlive the environment: {title}", "succeeds", left, run.text)


def lives(alias: str, patience_s: float = 1.0) -> bool:
    """Whether there is such a process; one that keeps forking is missed by a single look."""
    return eventually(lambda: bool(pids_named(alias)), patience_s)


def kill_group(alias: str) -> None:
    def gone() -> bool:
        found = pids_named(alias)
        for pid in found:  # again and again: one that keeps forking is another one by now
            with contextlib.suppress(ProcessLookupError):
                group = os.getpgid(pid)
                assert group != os.getpgid(0)
                os.killpg(group, signal.SIGKILL)
        return not found

    assert eventually(gone)


def test_nothing_outlives_the_client(arena: Arena) -> None:
    """When the client dies, the jail's daemons die with it.
    ``tests/faults/remains`` ends clients in other ways: a server sees the same of each."""
    alias = new_alias()
    words = json.dumps([str(HOSTILE), "daemon", {"alias": alias}, arena.profile])
    client = subprocess.Popen(
        [sys.executable, "-c", _CLIENT, words],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[3],
    )
    try:
        assert client.stdout.readline() == b"attacked\n"
        assert eventually(lambda: bool(pids_named(alias)))
        client.kill()
        client.wait()
        left = not eventually(lambda: not pids_named(alias), _PATIENCE_S)
    finally:
        client.kill()
        client.communicate()
        kill_named(alias)
    arena.judge("outlive the client (SIGKILL)", "succeeds", left, "")
