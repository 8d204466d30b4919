"""A client that is ended while its server starts: nothing remains, or the next one removes it."""

import os
import signal
from pathlib import Path

import pytest

from envhub_sandbox.sandboxes.process import stale_folders
from tests.faults.remains.clients import finish, left
from tests.faults.remains.starts import SIGNALS, age, halted, is_removed_by_the_next
from tests.support.processes import eventually


@pytest.mark.parametrize("number", SIGNALS)
def test_a_server_that_finds_no_client_leaves_nothing(number: signal.Signals, folder: Path) -> None:
    """It is held until the client has gone, and meets a pipe that nobody reads."""
    client, server = halted(folder, "after", "subprocess.Popen")
    os.kill(server, signal.SIGSTOP)
    client.send_signal(number)
    finish(client)
    os.kill(server, signal.SIGCONT)


@pytest.mark.parametrize("sign", ["zygote-*", "server", "fds"])
def test_a_server_loses_its_client_while_it_starts(sign: str, folder: Path) -> None:
    """As far as one can see from outside: its zygote is there, and then its sockets are."""
    client, _ = halted(folder, "after", "subprocess.Popen")
    assert eventually(lambda: bool(list(folder.glob(f"envhub-*/{sign}"))))
    client.kill()
    finish(client)


@pytest.mark.parametrize(
    ("when", "what"), [("after", "tempfile.mkdtemp"), ("before", "subprocess.Popen")]
)
def test_what_a_client_left_that_had_no_server_yet_goes_with_the_next(
    when: str, what: str, folder: Path
) -> None:
    """Nobody is there who could remove it; while the client lives it is not touched."""
    client, _ = halted(folder, when, what)
    age(folder)
    if when == "before":  # an empty folder says nothing of its client, but how old it is
        assert list(stale_folders(folder)) == []
    client.kill()
    finish(client)
    assert len(list(stale_folders(folder))) == 1
    assert is_removed_by_the_next(folder), left(folder)


def test_what_is_left_when_both_are_killed_goes_with_the_next(folder: Path) -> None:
    client, server = halted(folder, "after", "subprocess.Popen")
    assert eventually(lambda: bool(list(folder.glob("envhub-*/fds"))))
    os.kill(server, signal.SIGKILL)
    client.kill()
    finish(client)
    assert len(list(stale_folders(folder))) == 1
    assert is_removed_by_the_next(folder), left(folder)
