"""Which sentence an error gets: by its text, and by what the policy gives already."""

from __future__ import annotations

import pytest

from envhub_sandbox.errors import RemoteEnvError, WorkerDiedError
from envhub_sandbox.session.jails.reach import add_reach_advice
from envhub_sandbox.settings.policy import Policy


def advised(kind: str, message: str, network: str = "none") -> str:
    """What is added to a remote error."""
    error = RemoteEnvError(kind, message)
    before = str(error)
    add_reach_advice(error, Policy(network=network))
    add_reach_advice(error, Policy(network=network))  # once
    return str(error).removeprefix(before)


@pytest.mark.parametrize(
    ("kind", "message", "named"),
    [
        ("huggingface_hub.errors.LocalEntryNotFoundError", "outgoing traffic ...", "assets="),
        ("OSError", "We couldn't connect to 'https://huggingface.co' to load", "assets="),
        ("subprocess.CalledProcessError", "Command '['uv', 'pip', 'install', 'x']' ...", "extra"),
        ("subprocess.CalledProcessError", "Command 'pip install -q x' returned", "extra"),
        ("OSError", "[Errno 97] Address family not supported by protocol", "'loopback'"),
        ("requests.exceptions.ConnectionError", "Max retries exceeded", "assets="),
        ("subprocess.CalledProcessError", "Command '['git', '-C', 'x', 'pull']' ...", "assets="),
        ("socket.gaierror", "[Errno -3] Temporary failure in name resolution", "assets="),
        ("pyglet.display.xlib.NoSuchDisplayException", 'Cannot connect to "None"', "window"),
        ("_tkinter.TclError", "no display name and no $DISPLAY environment variable", "window"),
        ("glfw.GLFWError", "(65550) b'X11: Failed to open display '", "window"),
        ("pygame.error", "No available video device", "window"),
    ],
)
def test_each_failure_names_what_brings_it(kind: str, message: str, named: str) -> None:
    """One line, once."""
    assert named in advised(kind, message)
    assert advised(kind, message).count("\n") == 1


@pytest.mark.parametrize(
    ("kind", "message", "network"),
    [
        ("ValueError", "pip and git are words, a display too", "none"),
        ("KeyError", "'connect'", "none"),
        ("socket.gaierror", "[Errno -3] Temporary failure in name resolution", "host"),
        ("ConnectionRefusedError", "[Errno 111] Connection refused", "loopback"),
    ],
)
def test_others_get_none(kind: str, message: str, network: str) -> None:
    """Words alone say nothing, nor does a failure of a network that it has."""
    assert advised(kind, message, network) == ""


def test_its_own_loopback_is_not_named_twice() -> None:
    """Where it has one, a family that is refused is another one."""
    assert "loopback" not in advised("OSError", "[Errno 97] Address family", "loopback")


def test_of_a_death_only_the_display_is_read() -> None:
    """A process that exits by itself after such words, and one that is ended, are told apart."""
    said = "qt.qpa.xcb: could not connect to display \nThis application failed to start"
    for signal, added in (("SIGABRT", True), ("SIGKILL", False)):
        error = WorkerDiedError("died", signal=signal, reason="signal", log_tail=said)
        add_reach_advice(error, Policy())
        assert ("a jail has no display" in str(error)) is added
