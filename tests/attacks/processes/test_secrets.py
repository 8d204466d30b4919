"""Getting at secrets that lie in memory, environments and keyrings."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from envhub_sandbox.sandboxes.process import PROCESS
from tests.attacks.harness import Arena, token
from tests.attacks.hostile.payloads import kernel
from tests.attacks.processes.victim import victim

FAMILY = "Secrets in memory, environments and keyrings"

_ADD_USER_KEYRING, _INVALIDATE = -4, 21


@pytest.fixture
def hub_token(monkeypatch: pytest.MonkeyPatch) -> str:
    """A token in the client's environment, and therefore in its memory."""
    made = f"hf_canary_{token()}"
    monkeypatch.setenv("HF_TOKEN", made)
    return made


@pytest.fixture
def fresh_server(hub_token: str, home: Path, other_cache: Path) -> Iterator[None]:
    """A worker server that is started while the token is in the client's environment."""
    use = PROCESS.acquire(other_cache / "snapshots")
    yield
    use.release()


@pytest.mark.short("strict")
@pytest.mark.usefixtures("fresh_server")
def test_token_is_not_in_the_environment(arena: Arena, hub_token: str) -> None:
    """Neither os.environ nor what the kernel kept of it holds the client's token."""
    arena.steal("find the token in the environment", "environment", hub_token)


@pytest.mark.short("strict")
@pytest.mark.usefixtures("fresh_server")
def test_token_is_not_in_memory(arena: Arena, hub_token: str) -> None:
    """No page of the worker was ever the client's: it is executed afresh, never forked off."""
    more = {"prefix": "hf_canary_", "secret": hub_token}
    arena.steal("find the token in memory", "own_memory", hub_token, **more)


@pytest.mark.parametrize(
    ("title", "payload"),
    [
        ("read /proc/<client>/environ", "environment_of_others"),
        ("read /proc/<client>/cmdline", "command_lines_of_others"),
    ],
)
def test_environments_and_command_lines_are_closed(arena: Arena, title: str, payload: str) -> None:
    """What a process of the same user was started with, a password perhaps, cannot be read."""
    with victim(token()) as target:
        arena.steal(title, payload, target.secret, pid=target.pid)


def test_keyring_is_closed(arena: Arena) -> None:
    """A key that the kernel keeps for the client's user stays there."""
    name, secret = f"envhub-{token()}", token()
    key = kernel.syscall(
        "add_key", b"user", name.encode(), secret.encode(), len(secret), _ADD_USER_KEYRING
    )
    try:
        arena.steal("read a key from the keyring (keyctl)", "keyring", secret, name=name)
    finally:
        kernel.syscall("keyctl", _INVALIDATE, key)


@pytest.mark.usefixtures("fresh_server")
def test_server_and_zygote_never_had_the_token(hub_token: str) -> None:
    """Nothing that we start ourselves is given the client's environment."""
    processes = psutil.Process().children(recursive=True)
    assert processes
    assert hub_token in os.environ.values()
    read = 0
    for process in processes:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            assert hub_token not in Path(f"/proc/{process.pid}/environ").read_text()
            read += 1
    assert read >= 2  # of the fresh server and its zygote, at least
