"""A jail holds the descriptors of the fast lane's slabs: what can it do to the client with them?

The hostile side is another process with exactly those descriptors; the verdict is the client's
own memory, and whether the client is still alive.
"""

from __future__ import annotations

import mmap
import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.fast_lane import LaneShard
from envhub_worker.protocol import slabs

WAIT_S = 60


@pytest.fixture
def shard() -> Iterator[LaneShard]:
    """The client's side of a shard of two sub-environments with boolean observations."""
    layout = slabs.layout_of(spaces.Box(0, 1, (8,), np.bool_), spaces.Box(-1, 1, (2,)), 2)
    assert layout is not None
    made = LaneShard(layout)
    yield made
    made.close()


def attack(shard: LaneShard, code: str) -> str:
    """Run code in a process that holds the descriptors ``request`` and ``reply``."""
    request, reply = shard.fds[:2]
    layout = shard.layout
    head = f"""
import ctypes, errno, mmap, os, struct
request, reply = {request}, {reply}
request_bytes, reply_bytes = {layout.request_bytes}, {layout.reply_bytes}
def outcome(call, *arguments, **keywords):
    try:
        call(*arguments, **keywords)
        print("done")
    except OSError as error:
        print(errno.errorcode[error.errno])
"""
    done = subprocess.run(
        [sys.executable, "-c", head + code],
        pass_fds=(request, reply),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=True,
    )
    return done.stdout.strip()


def ask_and_answer(shard: LaneShard) -> None:
    """One request, so that there is something to answer."""
    shard.ask([np.zeros((2, 2), np.float32)], 0)


def test_unsealed_memory_kills_its_reader() -> None:
    """Control: without seals, whoever shares the memory can end the reader with SIGBUS."""
    code = """
import mmap, os
fd = os.memfd_create("open", os.MFD_ALLOW_SEALING)
os.ftruncate(fd, 1 << 16)
mapped = mmap.mmap(fd, 1 << 16)
os.ftruncate(fd, 0)
mapped[0]
"""
    done = subprocess.run([sys.executable, "-c", code], timeout=WAIT_S, check=False)
    assert done.returncode == -signal.SIGBUS


@pytest.mark.parametrize("name", ["request", "reply"])
@pytest.mark.parametrize("size", ["0", "1 << 30"])
def test_a_slab_cannot_be_cut_or_grown(shard: LaneShard, name: str, size: str) -> None:
    """Neither slab changes its size, so the client cannot be made to fault."""
    assert attack(shard, f"outcome(os.ftruncate, {name}, {size})") == "EPERM"
    assert os.fstat(shard.fds[0]).st_size == shard.layout.request_bytes
    assert os.fstat(shard.fds[1]).st_size == shard.layout.reply_bytes


def test_the_seals_cannot_be_taken_off(shard: LaneShard) -> None:
    """Nobody can add or remove a seal any more."""
    for name in ("request", "reply"):
        assert attack(shard, f"import fcntl; outcome(fcntl.fcntl, {name}, 1033, 8)") == "EPERM"


def test_actions_cannot_be_rewritten(shard: LaneShard) -> None:
    """The request slab is the client's alone: no write, and no writable map."""
    assert attack(shard, "outcome(os.pwrite, request, b'x', 0)") == "EPERM"
    assert attack(shard, "outcome(mmap.mmap, request, request_bytes)") == "EPERM"


def test_the_reply_slab_is_theirs_to_write(shard: LaneShard) -> None:
    """Control of the test above: the same calls succeed on the reply slab."""
    assert attack(shard, "outcome(os.pwrite, reply, b'x', 4096)") == "done"
    assert attack(shard, "outcome(mmap.mmap, reply, reply_bytes)") == "done"


def test_a_punched_hole_is_zeros(shard: LaneShard) -> None:
    """Pages can be taken away, and read as zeros; nothing faults."""
    os.pwrite(shard.fds[1], b"\xff" * mmap.PAGESIZE, 0)
    code = """
libc = ctypes.CDLL(None, use_errno=True)
libc.fallocate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_long, ctypes.c_long]
print(libc.fallocate(reply, 3, 0, 4096), errno.errorcode.get(ctypes.get_errno()))
"""
    assert attack(shard, code) == "0 None"
    rewards, terminations, truncations = shard.results()
    assert rewards.tolist() == [0.0, 0.0]
    assert not terminations.any()
    assert not truncations.any()
    with pytest.raises(RemoteProtocolError, match="impossible reply"):
        shard.outcome()


@pytest.mark.parametrize(
    ("outcome", "length"),
    [(99, 0), (0, 0), (slabs.DONE, slabs.INFO_BYTES + 1), (slabs.DONE, 2**64 - 1)],
)
def test_an_impossible_header_is_refused(shard: LaneShard, outcome: int, length: int) -> None:
    """Words out of range never become a slice or an allocation."""
    ask_and_answer(shard)
    words = f"struct.pack('QQ', {outcome}, {length})"
    attack(shard, f"os.pwrite(reply, {words}, {slabs.OUTCOME * 8})")
    with pytest.raises(RemoteProtocolError):
        shard.outcome()


@pytest.mark.parametrize("bytes_", ["b'\\x80\\x04.'", "os.urandom(64)", "b'\\xff' * 64"])
def test_garbage_for_infos_is_refused(shard: LaneShard, bytes_: str) -> None:
    """What lies in the info area is decoded by the same suspicious code as a message."""
    ask_and_answer(shard)
    attack(
        shard,
        f"os.pwrite(reply, {bytes_}, {shard.layout.infos})\n"
        f"os.pwrite(reply, struct.pack('QQ', {slabs.DONE}, 64), {slabs.OUTCOME * 8})",
    )
    with pytest.raises(RemoteProtocolError):
        shard.outcome()


def test_columns_without_a_schema_are_refused(shard: LaneShard) -> None:
    """Columns are read by the client's own schema only, and there is none yet."""
    ask_and_answer(shard)
    attack(shard, f"os.pwrite(reply, struct.pack('QQ', {slabs.COLUMNS}, 0), {slabs.OUTCOME * 8})")
    kind, message = shard.outcome()
    assert (kind, message) == (slabs.COLUMNS, None)
    with pytest.raises(RemoteProtocolError, match="before their schema"):
        shard.columns()


def test_bytes_that_are_no_booleans_become_booleans(shard: LaneShard) -> None:
    """A flag or a boolean observation of 2 would be neither true nor false: it is made true."""
    layout = shard.layout
    os.pwrite(shard.fds[1], b"\x02" * 4, layout.results + 16)
    os.pwrite(shard.fds[1], b"\x02" * 16, layout.observations[0].offset)
    _, terminations, truncations = shard.results()
    [observation] = shard.taken()
    for array in (terminations, truncations, observation):
        assert array.dtype == np.bool_
        assert set(array.tobytes()) == {1}


def test_what_the_caller_has_is_not_rewritten(shard: LaneShard) -> None:
    """Results are copies: a later write of the jail changes nothing that was handed out."""
    rewards, terminations, _ = shard.results()
    [observation] = shard.taken()
    attack(shard, "m = mmap.mmap(reply, reply_bytes); m[:] = b'\\x01' * reply_bytes")
    assert rewards.tolist() == [0.0, 0.0]
    assert not terminations.any()
    assert not observation.any()
    assert shard.taken()[0].all()
