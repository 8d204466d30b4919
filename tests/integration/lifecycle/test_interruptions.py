"""Ctrl-C anywhere in a start or in a close: nothing is left, and what follows is as ever.
Python looks for signals where a function begins, so these are the moments that are tried."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from tests.support.command_line import python
from tests.support.in_process.interrupts import at_call
from tests.support.samples import sample
from tests.support.started import nothing_more_held

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
_STARTS, _CLOSES = (23, 7) if "ENVHUB_TEST_LONG" in os.environ else (167, 41)
"""Calls between two moments: of some 500 in a start, and of some 120 in a close."""
_WAYS: dict[str, dict[str, Any]] = {
    "auto": {"use_async_envs": True},
    "frames": {"use_async_envs": True, "policy": {"lane": "frames"}},
    "fleet": {"n_envs": 6, "sandbox": ["process"] * 3},
}
ways = pytest.mark.parametrize("way", _WAYS)


@pytest.fixture
def nothing_more() -> Iterator[Callable[[], bool]]:
    """Whether nothing is held beyond what one environment does, which runs beside those tried."""
    with nothing_more_held() as question:
        yield question


def _made(way: str) -> Any:
    return make_env(sample("echo"), **{"n_envs": 2, **_WAYS[way]})


@ways
def test_an_interrupted_start_leaves_nothing(nothing_more: Callable[[], bool], way: str) -> None:
    """No use of the server, no jail, no descriptor; and what the next reset says is its own."""
    options = {"token": 5.0, "delay": 0.0}
    moment, came = 0, True
    while came:
        with _made(way) as suites:
            came = at_call(moment, suites.env.reset)
            observations, _ = suites.env.reset(options=options)
            assert observations.tolist() == [[5.0, 0.0]] * suites.env.num_envs
        assert nothing_more(), moment
        moment += _STARTS
    assert moment > 2 * _STARTS


@ways
def test_an_interrupted_close_leaves_nothing(nothing_more: Callable[[], bool], way: str) -> None:
    """No use of the server, no jail, no descriptor, once it is closed again, or nobody has it."""
    moment, came = 0, True
    while came:
        suites = _made(way)
        suites.env.reset()
        came = at_call(moment, suites.close)
        if moment % 2:
            suites.close()
            assert nothing_more(), moment
        del suites
        assert nothing_more(), moment
        moment += _CLOSES
    assert moment > 2 * _CLOSES


_IMPORTS = f"""
import os, signal, sys, time
import psutil
from envhub_sandbox import make_env

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == NAME:
            print("servers:", len(psutil.Process().children()))
            if KIND is ImportError:
                raise ImportError(name)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)

signal.signal(signal.SIGINT, signal.default_int_handler)
env = make_env({str(sample("echo"))!r}, n_envs=2).env
sys.meta_path.insert(0, Finder())
try:
    env.reset()
except KIND:
    print("left:", len(psutil.Process().children()))
del sys.meta_path[0]
print(env.reset(options={{"token": 5.0, "delay": 0.0}})[0].tolist())
"""


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("zmq", "KeyboardInterrupt"),
        ("envhub_sandbox.transport.lane", "KeyboardInterrupt"),
        ("envhub_sandbox.transport.lane", "ImportError"),
    ],
)
def test_an_interrupted_import_leaves_no_server_behind(
    tmp_path: Path, snapshot_store: Path, name: str, kind: str
) -> None:
    """What speaks with a server is imported while it starts. The next reset starts another."""
    runtime = tmp_path / "t"
    runtime.mkdir(mode=0o711)
    with make_env(sample("echo"), n_envs=2):
        pass  # its manifest is known from here on
    done = python("-c", f"NAME, KIND = {name!r}, {kind}{_IMPORTS}", TMPDIR=str(runtime))
    *servers, left, answer = done.stdout.splitlines()
    assert set(servers) == {"servers: 1"}
    assert ((left, answer), done.stderr) == (("left: 0", "[[5.0, 0.0], [5.0, 0.0]]"), "")
    assert list(runtime.iterdir()) == []
