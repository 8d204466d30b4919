"""Packages that a server on another host installs, where its operator permits that."""

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.extras.packages.builds import download
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_worker.extras.access import packages as server_side
from envhub_worker.extras.access.packages import Packages
from envhub_worker.extras.access.quotas import BusyError, Quotas
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError
from tests.remote.listening import Listening, listening
from tests.support.command_line import below, gone, python
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel
from tests.support.processes import eventually
from tests.support.repositories import importing, write_repository

ENV = importing("wanted", version="wanted.VERSION")


@pytest.fixture(scope="module")
def permitting(real_index: Index, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """A server whose operator permits it, with an index of its own."""
    make_wheel(real_index.folder, "wanted", "1.0")
    folder = tmp_path_factory.mktemp("permitting")
    with listening(folder, "--dependencies", "--max-packages", "512") as found:
        yield found


def test_a_server_makes_what_the_repository_declares(
    permitting: Listening, real_index: Index, tmp_path: Path
) -> None:
    """On its side, once; the client is told what there is, and has none of it. What it imports and
    does not declare is made by the client's table, as the provenance says."""
    make_wheel(real_index.folder, "chess")
    source = f"import chess\n{ENV}"
    folder = write_repository(tmp_path / "repo", source, requirements__txt="wanted==1.0\n")
    asked = []
    for _ in range(2):
        with make_env(folder, sandbox=permitting.sandbox()) as suites:
            suites.env.reset(seed=0)
            assert suites.env.call("version") == ("1.0",)
            installed = suites.provenance["installed"]
            assert {"wanted==1.0", "chess==1.0"} <= set(installed["packages"])
            [guess] = installed["inferred"]
            assert guess["where"] == "env.py, line 1, which needs chess"
        asked.append(len(real_index.asked))
    assert 0 < asked[0] == asked[1]
    assert not (Path(os.environ["ENVHUB_CACHE"]) / "environments").exists()
    [made] = (permitting.state / "packages").glob("*/environments/*/packages")
    assert (made / "wanted").is_dir()
    assert eventually(lambda: f"name={made.parent.name}" in permitting.said())
    assert remote.ask_facts(permitting.sandbox()).dependencies


def test_a_packaged_environment_needs_no_repository(
    permitting: Listening, real_index: Index
) -> None:
    """The server installs the package, and the jail there imports it."""
    registers = (
        "import gymnasium\n"
        "gymnasium.register('Far/Cart-v0', 'gymnasium.envs.classic_control:CartPoleEnv')\n"
    )
    make_wheel(real_index.folder, "far-carts", files={"far_carts/__init__.py": registers})
    with make_env("pypi:far-carts#Far/Cart-v0", 2, sandbox=permitting.sandbox()) as suites:
        assert suites.env.reset(seed=0)[0].shape == (2, 4)
        assert "far-carts==1.0" in suites.provenance["installed"]["packages"]


def test_what_fails_there_is_told(permitting: Listening, real_index: Index, tmp_path: Path) -> None:
    """With the lines of the repository that it is about; and a version is asked for, not a path."""
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="wanted==3.0\n")
    with refused_dependency("resolution", match=r"line 1 of requirements\.txt") as caught:
        make_env(folder, sandbox=permitting.sandbox())
    assert "repo" in str(caught.value)
    with pytest.raises(PolicyError, match="name a version"):
        make_env(folder, sandbox=permitting.sandbox(), dependencies={"python": sys.executable})


def test_nothing_is_built_there(
    permitting: Listening, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would ask any host that a client names. The control: our own git does."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.create_server(("127.0.0.1", 0)) as host:
        url = f"https://127.0.0.1:{host.getsockname()[1]}/org/repo"
        declared = f"wanted @ git+{url}@{'0' * 40}\n"
        folder = write_repository(tmp_path / "repo", ENV, requirements__txt=declared)
        with refused_dependency("requirement", match="not built here"):
            make_env(folder, sandbox=permitting.sandbox())
        host.setblocking(False)
        with pytest.raises(BlockingIOError):
            host.accept()
        host.setblocking(True)
        asked = threading.Thread(target=lambda: host.accept()[0].close())
        asked.start()
        with refused_dependency("index"):
            download.check_out(url, "0" * 40, tmp_path, print)
        asked.join()


def test_a_server_that_makes_none_says_so(server: Listening, tmp_path: Path) -> None:
    """Its own packages are used; who asks for others, or lacks one, hears of the option."""
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="wanted==1.0\n")
    with refused_dependency("module", match="--dependencies"):
        make_env(folder, sandbox=server.sandbox())
    with pytest.raises(PolicyError, match="--dependencies"):
        make_env(folder, sandbox=server.sandbox(), dependencies={"extra": ["wanted"]})
    assert not (server.state / "packages").exists()


def test_without_the_program_that_makes_them_it_does_not_start(tmp_path: Path) -> None:
    """An interpreter that has the worker and not the client is told what to install."""
    lacking = tmp_path / "lacking.py"
    lacking.write_text(
        "import runpy, sys\nfrom envhub_worker.extras.access import packages\n"
        "packages.PROGRAM = 'no_such_package'\n"
        "from envhub_worker.__main__ import main\nsys.exit(main())\n"
    )
    words = ("listen", "--bind", "tcp://127.0.0.1:*", "--insecure-loopback", "--dependencies")
    done = python("-I", lacking, *words, "--state-dir", tmp_path / "state", code=2)
    assert "pip install envhub-sandbox" in done.stderr


def order(*requirements: str, always: bool = True) -> m.NeedPackages:
    """What a client that checks nothing sends."""
    return m.NeedPackages(tuple((one, "line 1") for one in requirements), "", "", "", always)


SLEEPING = [sys.executable, "-I", "-c", "import time; time.sleep(600)"]


@pytest.fixture
def idle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    """A server's packages, whose program never says anything."""
    monkeypatch.setattr(server_side, "command", lambda: SLEEPING)
    found = Packages(tmp_path / "packages", Quotas())
    yield found
    found.close()


def test_orders_are_bounded(idle: Packages, monkeypatch: pytest.MonkeyPatch) -> None:
    """One key has so many at once, and so many in an hour; another has its own."""
    for number in range(server_side.MAX_WAITING):
        for _ in range(2):
            assert idle.need(b"a", order(f"p{number}"), ()).state == "making"
    with pytest.raises(BusyError, match="wait already") as caught:
        idle.need(b"a", order("another"), ())
    assert caught.value.missing == "packages"
    assert idle.need(b"b", order("another"), ()).state == "making"
    monkeypatch.setattr(server_side, "MAX_PER_HOUR", 1)
    monkeypatch.setattr(server_side, "MAX_WAITING", 100)
    with pytest.raises(BusyError, match="last hour"):
        idle.need(b"a", order("another"), ())


def test_what_nobody_asks_for_is_given_up(idle: Packages, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program ends, and the next in line has its turn."""
    monkeypatch.setattr(server_side, "MAX_AT_WORK", 1)
    clock = [time.monotonic()]  # an order notes by itself when it came: this is not another time
    monkeypatch.setattr(server_side, "monotonic", lambda: clock[0])
    assert idle.need(b"a", order("first"), ()).state == "making"
    clock[0] += 40
    assert idle.need(b"b", order("second"), ()).state == "making"
    clock[0] += 40

    def begun() -> bool:
        idle.need(b"b", order("second"), ())
        try:
            return idle.need(b"a", order("first"), ()).state != "making"
        except RefusedError as error:
            return error.missing == "index"

    idle.look(())
    assert eventually(begun)


def test_nobody_holds_others_who_have_room(idle: Packages, monkeypatch: pytest.MonkeyPatch) -> None:
    """A key has one program at work, all together a few; who waits hears how many are before."""
    monkeypatch.setattr(server_side, "MAX_AT_WORK", 2)
    begun = Mock(side_effect=server_side.command)
    monkeypatch.setattr(server_side, "command", begun)

    def progress(key: bytes, name: str) -> str:
        reply = idle.need(key, order(name), ())
        assert reply.state == "making"
        return reply.progress

    for key, name, said, count in (
        (b"a", "first", "at work", 1),
        (b"a", "second", "waiting for other packages of your key", 1),
        (b"b", "first", "at work", 2),
        (b"c", "first", "waiting for others' packages: 0 before it, 2 at work", 2),
    ):
        assert (progress(key, name), begun.call_count) == (said, count)


def test_an_order_that_takes_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though somebody asks for it all the time: the operator says how long."""
    monkeypatch.setattr(server_side, "command", lambda: SLEEPING)
    clock = [time.monotonic()]
    monkeypatch.setattr(server_side, "monotonic", lambda: clock[0])
    with contextlib.closing(Packages(tmp_path / "packages", Quotas(), make_s=120)) as found:
        for _ in range(3):
            assert found.need(b"a", order("first"), ()).state == "making"
            clock[0] += 55

        def is_refused() -> bool:
            try:
                found.need(b"a", order("first"), ())
            except RefusedError as error:
                return error.missing == "index" and "--packages-s" in str(error)
            return False

        assert eventually(is_refused)


_SERVER = """
import sys, time
from pathlib import Path
from envhub_worker.extras.access.packages import Packages
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.protocol import messages as m
packages = Packages(Path(sys.argv[1]), Quotas())
packages.need(b"a", m.NeedPackages((("wanted", "line 1"),), "", "", "", True), ())
time.sleep(600)
"""


@pytest.mark.parametrize("killed", ["the server", "who watches"])
def test_the_program_and_its_uv_end_with_who_started_them(killed: str, tmp_path: Path) -> None:
    """Also where that was killed: nobody would measure what they take, and nobody waits for it."""
    with contextlib.ExitStack() as stack:
        # it takes connections and says nothing: whoever asks it waits
        index = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=64))
        index.settimeout(90)
        url = f"http://127.0.0.1:{index.getsockname()[1]}/simple"
        # what else chooses an index, as other tests' variables do, is not to be asked first
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("UV_", "PIP_"))}
        environment = {**kept, "UV_DEFAULT_INDEX": url, "UV_HTTP_TIMEOUT": "600"}
        command = [sys.executable, "-c", _SERVER, str(tmp_path / "packages")]
        with subprocess.Popen(command, env=environment) as server:
            try:
                found = psutil.Process(server.pid)
                stack.callback(index.accept()[0].close)  # from here on uv waits for an answer
                [watcher] = found.children()
                rest = below(watcher.pid)
                assert len(rest) >= 2  # one that works, and its uv
                (found if killed == "the server" else watcher).kill()
                assert eventually(lambda: gone(rest))
                assert killed != "the server" or eventually(lambda: gone([watcher]))
            finally:
                for one in below(server.pid):
                    one.kill()
                server.kill()


def test_a_program_that_cannot_be_started_is_not_tried_for_ever(
    idle: Packages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever asked hears it; the server, whose tick begins what waits, does not fail with it."""
    missing = Mock(return_value=["/nowhere/at/all"])
    monkeypatch.setattr(server_side, "command", missing)
    for _ in range(2):
        with pytest.raises(RefusedError, match="cannot be started"):
            idle.need(b"a", order("first"), ())
        idle.look(())
    assert missing.call_count == 1


def test_packages_have_names_that_were_given(idle: Packages) -> None:
    for name in ("0" * 40, "/usr", "../..", ""):
        with pytest.raises(RefusedError):
            idle.runtime(b"a", name)
