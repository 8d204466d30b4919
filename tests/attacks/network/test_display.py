"""A virtual display is the jail's own: the host's is not there, and nobody outside finds it."""

import contextlib
import random
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import LoadError, SandboxUnavailableError
from tests.attacks.harness import Arena, OpenJail
from tests.attacks.network.listeners import listening, sends
from tests.support.interpreter import needs
from tests.support.repositories import STILL, write_repository

FAMILY = "Network"
SOCKETS = Path("/tmp/.X11-unix")
DISPLAY = {"display": "virtual"}
_NEEDED = pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb")
WINDOWS = f"""{STILL}
import os, socket

class Windows(Still):
    def connect(self, number=None):
        '''The answer of an X server to a client without a password: 1 is welcome.'''
        number = os.environ["DISPLAY"].lstrip(":") if number is None else number
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(f"/tmp/.X11-unix/X{{number}}")
            client.sendall(b"l\\0\\x0b" + bytes(9))
            return client.recv(1)[0]

    def variables(self):
        names = ("DISPLAY", "SDL_VIDEODRIVER", "PYOPENGL_PLATFORM", "XAUTHORITY")
        return {{name: os.environ.get(name) for name in names}}
"""


@contextlib.contextmanager
def hosts_display() -> Iterator[tuple[int, Any, Any]]:
    """Sockets where an X server of the host listens: the file, and the abstract one."""
    existed = SOCKETS.is_dir()
    SOCKETS.mkdir(mode=0o1777, exist_ok=True)
    # drawn: another run of this test may be looking for one, too
    numbers = random.sample(range(700, 5000), 100)
    number = next(n for n in numbers if not (SOCKETS / f"X{n}").exists())
    path = SOCKETS / f"X{number}"
    stream = (socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with listening(*stream, str(path)) as named, listening(*stream, f"\0{path}") as abstract:
            path.chmod(0o777)
            yield number, named, abstract
    finally:
        path.unlink(missing_ok=True)
        if not existed:
            with contextlib.suppress(OSError):  # somebody else has a display by now
                SOCKETS.rmdir()


@_NEEDED
def test_the_hosts_display_is_not_there(strict: Arena) -> None:
    """Neither its socket file nor its abstract socket, with the network of its own and none."""
    for network in ("none", "loopback"):
        with (
            hosts_display() as (_, named, abstract),
            strict.environment({**DISPLAY, "network": network}) as env,
        ):
            jail = OpenJail(strict, env, f'with display="virtual", network="{network}": ')
            sends(jail, "the host's display, by its file", "unix_stream", named)
            sends(jail, "the host's display, by its abstract name", "unix_stream", abstract)


@_NEEDED
@needs("strict")
def test_a_display_of_its_own_welcomes_it_and_nobody_else(tmp_path: Path) -> None:
    """Each jail has one; no socket of it is on the host, and another jail's has another window."""
    folder = write_repository(tmp_path / "repo", WINDOWS)
    before = unix_names()
    with make_env(str(folder), policy=DISPLAY) as one, make_env(str(folder)) as other:
        assert one.env.call("connect") == (1,)
        [variables] = one.env.call("variables")
        number = variables["DISPLAY"].lstrip(":")
        assert variables == {**dict.fromkeys(variables), "DISPLAY": f":{number}"}
        with pytest.raises(FileNotFoundError):
            other.env.call("connect", number)
        # displays of other numbers come and go: those of the tests that run beside this one
        assert not {one for one in unix_names() - before if one.endswith(f"/X{number}")}


@_NEEDED
@needs("strict")
def test_processes_of_one_environment_have_a_display_each(tmp_path: Path) -> None:
    """The environments are spread; each process opens windows, and nothing of it stays."""
    folder = write_repository(tmp_path / "repo", WINDOWS)
    spread = {"n_envs": 4, "use_async_envs": True, "num_workers": 2}
    with make_env(str(folder), policy=DISPLAY, **spread) as suites:
        assert suites.env.call("connect") == (1,) * 4


def unix_names() -> set[str]:
    """Names of sockets in this network namespace, abstract ones with an ``@``."""
    rows = Path("/proc/net/unix").read_text().splitlines()[1:]
    return {row.split()[-1] for row in rows if "/" in row}


@needs("strict")
def test_without_xvfb_the_error_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_repository(tmp_path / "repo", WINDOWS)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(SandboxUnavailableError, match="needs Xvfb, which is not installed"):
        make_env(str(folder), policy={**DISPLAY, "environment": ["PATH"]})


@needs("no-userns")
def test_a_profile_without_socket_files_has_no_display(tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "repo", WINDOWS)
    with pytest.raises(SandboxUnavailableError, match="permits no socket files"):
        make_env(str(folder), policy={**DISPLAY, "profile": "no-userns"})


def test_a_window_without_a_display_names_the_option(tmp_path: Path) -> None:
    broken = write_repository(tmp_path / "broken", "raise OSError('cannot open display: None')\n")
    with pytest.raises(LoadError, match=r"policy=\{'display': 'virtual'\}"):
        make_env(str(broken))
