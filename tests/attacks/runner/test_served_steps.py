"""A jail turns on slabs and doorbells that it shares with a server, which others use as well.
Whatever it does there, the server goes on, and so does another environment of the same server.
Controls: ``test_doorbells`` has the descriptor that holds its writer, ``test_slabs`` the memory
that kills its reader."""

import os
import select
import struct
import subprocess
import sys
from pathlib import Path
from time import monotonic
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerTimeoutError
from envhub_worker.protocol.shared_memory import words
from envhub_worker.supervisor.served_slabs import ServedSlabs, ServedSteps
from tests.attacks.harness import TIMEOUTS, Arena
from tests.attacks.runner.abuser import ANSWERS, abuser
from tests.attacks.runner.test_doorbells import ACTS
from tests.support import inside

FAMILY = "The client, from inside a jail"
STEPS = 30
_PATIENCE_S = 240.0
"""A jail that hammers leaves little of a busy machine to who answers it."""
OBSERVATION_BYTES = 96 * 1024
"""Sent from where it lies."""
HALF = struct.pack(
    f"<{words.DTYPES - words.SPIN}Q", 200_000, *[0] * (words.DTYPES - words.SPIN - 1)
)
HAMMER = """
import ctypes, mmap, os, random, struct, sys, threading
request, reply, observations, bell, servers_bell = map(int, sys.argv[1:])
size, one = os.fstat(reply).st_size, (1).to_bytes(8, "little")
asked = memoryview(mmap.mmap(request, os.fstat(request).st_size, prot=mmap.PROT_READ)).cast("Q")
tells = memoryview(mmap.mmap(reply, size))[: size - size % 8].cast("Q")
libc = ctypes.CDLL(None)
libc.fallocate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_long, ctypes.c_long]
ODD = (0, 1, 2, 3, 4, 5, 2**16, 2**16 + 1, 2**63, 2**64 - 1)

def lie():
    while True:
        tells[16], tells[17] = random.choice(ODD), random.choice(ODD)
        tells[8] = random.choice((0, 1, 2**64 - 1))
        tells[0] = asked[0] if random.random() < 0.5 else random.choice(ODD)

def punch():
    while True:
        for slab in (reply, observations):
            libc.fallocate(slab, 3, 0, os.fstat(slab).st_size)
            os.pwrite(slab, os.urandom(4096), 8192)

def ring():
    os.set_blocking(servers_bell, True)
    while True:
        os.eventfd_write(servers_bell, 1)
        os.eventfd_read(servers_bell)

for act in (punch, ring):
    threading.Thread(target=act, daemon=True).start()
print("hammers", flush=True)
lie()
"""


def hammered(steps: ServedSteps, slabs: ServedSlabs) -> list[list[bytes]]:
    """The answers to many steps, as the server would take them while it serves others."""
    answers: list[list[bytes]] = []
    until = monotonic() + _PATIENCE_S
    while len(answers) < STEPS and monotonic() < until:
        if slabs.owner is None:
            slabs.ask(HALF, "owner")
            steps.owe(slabs, lambda: answers.append([bytes(one) for one in slabs.take()[1]]))
        wait_ms = steps.look()
        wait_s = 0.05 if wait_ms is None else wait_ms / 1000
        if select.select([steps.fileno()], [], [], wait_s)[0]:
            steps.rung()
    return answers


@pytest.mark.timeout(_PATIENCE_S + 60)
def test_a_jail_that_lies_rings_and_punches_holes_holds_no_server() -> None:
    """All at once, while it is read: each answer is as large as it may be, and no more."""
    steps = ServedSteps()
    slabs = ServedSlabs(0, words.HEADER_BYTES + words.INFO_BYTES, OBSERVATION_BYTES)
    steps.add(slabs)
    given, slabs.deposit = slabs.deposit, []
    with subprocess.Popen(
        [sys.executable, "-c", HAMMER, *map(str, given)], pass_fds=given, stdout=subprocess.PIPE
    ) as jail:
        try:
            assert jail.stdout.readline() == b"hammers\n"
            answers = hammered(steps, slabs)
        finally:
            jail.kill()
    assert len(answers) == STEPS, "the server was held"
    for first, *pieces in answers:
        assert 16 <= len(first) <= 16 + words.INFO_BYTES
        assert sum(map(len, pieces)) == OBSERVATION_BYTES
    said = [struct.unpack_from("<QQ", first) for first, *_ in answers]
    # the control: to believe it would be to read beyond the slab
    assert any(length > words.REPLY_BYTES for _, length in said)
    steps.forget(slabs)
    steps.close()
    for fd in given:
        os.close(fd)


@pytest.mark.short
def test_a_server_is_not_held_by_a_doorbell(strict: Arena, home: Path) -> None:
    """It rings for the next step of the jail, and goes on with those of another."""
    repository = abuser(home)
    options: dict[str, Any] = {"policy": {"profile": strict.profile, "lane": "frames"}}
    short = {**TIMEOUTS, "close_s": 1.0}
    with strict.environment(policy={"lane": "frames"}) as neighbour:
        neighbour.reset()
        for act in ACTS:
            with make_env(str(repository), timeouts=short, **options) as suites:
                suites.env.reset(options={"act": act, "every": False})
                suites.env.step([ANSWERS])
                with inside.hurried(suites.env, step_s=1.0), pytest.raises(WorkerTimeoutError):
                    suites.env.step([0])
                for _ in range(10):
                    neighbour.step([0])
            neighbour.step([0])
