"""Getting at secrets that lie in memory, environments and keyrings."""

import os
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from envhub_sandbox.sandboxes.process import PROCESS
from tests.attacks.harness import Arena, OpenJail, token
from tests.attacks.hostile.payloads import kernel
from tests.attacks.processes.victim import victim
from tests.support.processes import unless_ended

FAMILY = "Secrets in memory, environments and keyrings"
_ADD_USER_KEYRING, _INVALIDATE = -4, 21


@pytest.fixture
def hub_token(home: Path, other_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    made = f"hf_canary_{token()}"
    monkeypatch.setenv("HF_TOKEN", made)
    use = PROCESS.acquire(other_cache / "snapshots")
    yield made
    use.release()


@pytest.mark.short("strict")
def test_nothing_of_ours_has_the_token(arena: Arena, hub_token: str) -> None:
    """Neither the environments of what we start, nor any page of a jail's memory.
    A worker is executed afresh, and never forked off the client."""
    assert hub_token in os.environ.values()
    read = 0
    for process in psutil.Process().children(recursive=True):
        with unless_ended(process.pid):
            assert hub_token not in Path(f"/proc/{process.pid}/environ").read_text()
            read += 1
    assert read >= 2  # of the fresh server and its zygote, at least
    with arena.environment() as env:
        env.reset()
        jail = OpenJail(arena, env)
        jail.steal("find the token in the environment", "environment", hub_token)
        more = {"prefix": "hf_canary_", "secret": hub_token}
        jail.steal("find the token in memory", "own_memory", hub_token, **more)


@pytest.mark.parametrize(
    ("title", "payload"),
    [
        ("read /proc/<client>/environ", "environment_of_others"),
        ("read /proc/<client>/cmdline", "command_lines_of_others"),
    ],
)
def test_environments_and_arguments_are_closed(jail: OpenJail, title: str, payload: str) -> None:
    """What a process of the same user was started with, a password perhaps, cannot be read."""
    with victim(token()) as target:
        jail.steal(title, payload, target.secret, pid=target.pid)


def test_keyring_is_closed(jail: OpenJail) -> None:
    name, secret = f"envhub-{token()}", token()
    key = kernel.syscall(
        "add_key", b"user", name.encode(), secret.encode(), len(secret), _ADD_USER_KEYRING
    )
    try:
        jail.steal("read a key from the keyring (keyctl)", "keyring", secret, name=name)
    finally:
        kernel.syscall("keyctl", _INVALIDATE, key)
