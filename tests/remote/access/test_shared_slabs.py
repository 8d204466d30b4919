"""What a client on another host may have a server make for its runners."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import words
from tests.remote.listening import Listening, listening
from tests.support import inside
from tests.support.processes import eventually
from tests.support.samples import sample

MIB = 1 << 20
REQUEST_BYTES = words.HEADER_BYTES + words.INFO_BYTES
LIMIT_BYTES = 320 * MIB
MANY = 200


@contextmanager
def opened(server: Listening) -> Iterator[Any]:
    options: dict[str, Any] = {"n_envs": 6, "num_workers": 6}
    limits = {"limits": {"memory_bytes": LIMIT_BYTES}}
    with make_env(sample("counter"), sandbox=server.sandbox(), **limits, **options) as suites:
        suites.env.reset(seed=0)
        yield suites.env


@pytest.fixture
def env(server: Listening) -> Iterator[Any]:
    with opened(server) as found:
        yield found


def share(env: Any, slabs: list[tuple[int, int]]) -> m.Message:
    """Ask for observation slabs of so many bytes, each for the runner at that place."""
    jail = inside.jail(env)
    parts = tuple((jail.runners[at], 0, REQUEST_BYTES, size) for at, size in slabs)
    return jail.client.request(m.ShareSlabs(jail.number, parts), deadline=Deadline(60))[0]


def files(server: Listening) -> int:
    return len(os.listdir(f"/proc/{server.process.pid}/fd"))


def test_slabs_are_no_memory_beside_the_limit(env: Any, server: Listening) -> None:
    """What the server reads of them first is its own memory, which no limit of the jail bounds.
    One request makes them once for each runner: each takes time of a server that others use, and
    one could ask for 40,000. What is made again leaves nothing."""
    refused = share(env, [(0, 64)] * 2)
    assert isinstance(refused, m.Refusal), refused
    assert refused.error == "LocalProtocolError"
    assert isinstance(share(env, [(at, 64) for at in range(6)]), m.Done)
    before = files(server)
    for _ in range(MANY):
        assert isinstance(share(env, [(0, 64)]), m.Done)
    assert files(server) < before + MANY, "a connection may come; each slab would be there still"
    most = 63 * MIB
    assert isinstance(share(env, [(0, most), (1, most), (2, most)]), m.Done)
    refused = share(env, [(3, most), (4, most), (5, most)])
    assert isinstance(refused, m.Refusal), refused
    assert "memory_bytes" in refused.message
    # the same again is no more than there was
    assert isinstance(share(env, [(0, most)]), m.Done)


def test_slabs_are_no_memory_beside_the_quota(tmp_path: Path) -> None:
    """Of a key; an environment whose slabs find no room steps all the same, by messages."""
    most = 63 * MIB
    quota = f"--max-memory={LIMIT_BYTES + 2 * most + 8 * MIB}B"
    with listening(tmp_path, quota) as server, opened(server) as env:
        assert isinstance(share(env, [(0, most), (1, most)]), m.Done)
        refused = share(env, [(2, most)])
        assert isinstance(refused, m.Refusal), refused
        assert "--max-memory" in refused.message
        assert isinstance(share(env, [(1, most)]), m.Done)
    quota = f"--max-memory={LIMIT_BYTES}B"
    with listening(tmp_path / "full", quota) as server, opened(server) as env:
        assert isinstance(share(env, [(0, 64)]), m.Refusal)
        assert env.step(env.action_space.sample())[0].shape == env.observation_space.shape


def test_what_is_made_for_a_jail_that_ends_goes_with_it(server: Listening) -> None:
    """Its end takes a moment, in which its client may go on asking."""
    left = list[int]()
    for asks in (False, True):
        with opened(server) as env:
            jail = inside.jail(env)
            client, runners = jail.client, jail.runners
            parts = tuple((runner, 0, REQUEST_BYTES, 64) for runner in runners)
            closing = client.send(m.CloseJail(jail.number))
            sharing = client.send(m.ShareSlabs(jail.number, parts)) if asks else None
            replies = [client.receive(one, Deadline(60))[0] for one in (sharing, closing) if one]
            assert isinstance(replies[-1], m.Done)
        assert eventually(lambda: server.jails() == 0)
        left.append(files(server))
    few = left[0] + len(parts)
    # what it closes of a jail goes one by one, and some of that after the jail has gone
    assert eventually(lambda: files(server) <= few), "descriptors of a jail that has ended"
