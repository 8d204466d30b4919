"""What a listening server tells whoever watches it: figures, health and readiness, over HTTP.
The port has no keys: so there are attacks on it, while a client's work goes on."""

import contextlib
import http.client
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import ServerBusyError, WorkerDiedError
from envhub_worker.extras.access.commands import http_port
from envhub_worker.extras.access.commands.http_port import (
    MAX_CONNECTIONS,
    MAX_REQUEST_BYTES,
    HttpPort,
)
from envhub_worker.extras.access.commands.metrics import STALE_S, MetricsPage
from tests.remote.listening import listening
from tests.remote.monitoring.watched import Watched, get, watched
from tests.remote.strangers import hears, knock
from tests.support.processes import eventually
from tests.support.started import started

_MIB = 1 << 20


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """A server with room for two jails of a key."""
    with watched(tmp_path_factory.mktemp("watched"), "--max-jails", "2") as found:
        yield found


def test_a_client_is_seen_with_what_it_uses(one: Watched, repository: Path) -> None:
    """By name, against its quota; what it did is counted, and stays when it has gone."""
    who = "the one client"
    before = one.values()
    with started(repository, sandbox=one.server.sandbox()) as env:
        for _ in range(5):
            env.step(np.array([0]))
        assert one.shows("envhub_server_jails", who, value=1)
        assert one.shows("envhub_server_sessions", who, value=1)
        steps = before.get(("envhub_server_requests_total", who, "step"), 0)
        assert one.shows("envhub_server_requests_total", who, "step", value=steps + 5)
        now = one.values()
        assert now["envhub_server_quota", "jails"] == 2
        assert now["envhub_server_memory_limit_bytes", who] == 8 << 30
        assert now["envhub_server_upload_bytes", who] > 0
        assert eventually(lambda: one.values()["envhub_server_memory_bytes", who] > _MIB)
        sandbox = one.server.sandbox()
        with started(repository, n_envs=2, sandbox=sandbox), pytest.raises(ServerBusyError):
            make_env(repository, n_envs=3, sandbox=sandbox)
        refused = before["envhub_server_refusals_total", "jails"] + 1
        assert one.shows("envhub_server_refusals_total", "jails", value=refused)
        told = one.server.status()["server"]
        assert told["clients"][who]["sessions"] == 1
        assert told["refusals"]["jails"] == refused
        pid = one.server.sessions()[0]["jails"][0]["pids"][0]
        os.kill(pid, 9)
        with pytest.raises(WorkerDiedError):
            env.step(np.array([0]))
    deaths = before["envhub_server_deaths_total", "signal"] + 1
    assert one.shows("envhub_server_deaths_total", "signal", value=deaths)
    assert one.values()["envhub_server_jails_opened_total", who] >= 2
    assert eventually(lambda: one.values().get(("envhub_server_sessions", who), 0) == 0)


def test_no_secret_is_in_a_label(one: Watched, repository: Path) -> None:
    """Neither a key nor a session's name, which lets a connection be one of its client's."""
    with started(repository, sandbox=one.server.sandbox()):
        text = one.get("/metrics")[1]
        names = [found["session"] for found in one.server.sessions()]
    assert names
    for secret in (*names, one.server.client_key, one.server.public):
        assert secret not in text
    assert re.search(r"[0-9a-f]{32}", text) is None


def test_readiness_is_red_in_a_drain(tmp_path: Path, repository: Path) -> None:
    with (
        watched(tmp_path / "server", "--drain-s", "600") as one,
        started(repository, sandbox=one.server.sandbox()),
    ):
        one.server.process.terminate()
        assert eventually(lambda: one.get("/readyz")[0] == 503)
        assert "drains" in one.get("/readyz")[1]
        assert (one.get("/healthz")[0], one.values()["envhub_server_draining",]) == (200, 1)
        assert one.server.status()["server"]["draining_s"] > 0


def test_a_server_that_is_stuck_is_not_healthy(one: Watched) -> None:
    """Its port's own thread says so; there is nothing of last week's to read."""
    now = [0.0]
    page = MetricsPage(True, lambda _: ("text/plain", b"figures"), lambda: now[0])
    assert page.answer("/healthz")[0] == page.answer("/metrics")[0] == 503
    page.publish({"draining_s": None})
    assert (page.answer("/metrics")[2], page.answer("/readyz")[0]) == (b"figures", 200)
    now[0] = STALE_S + 1
    for path in ("/metrics", "/healthz", "/readyz"):
        assert page.answer(path)[0] == 503
    unusable = MetricsPage(False, lambda _: ("text/plain", b""), lambda: now[0])
    unusable.publish({"draining_s": None})
    assert (unusable.answer("/readyz")[0], unusable.answer("/healthz")[0]) == (503, 200)


# --- where it listens --------------------------------------------------------------------------


def test_a_port_that_others_can_reach_is_said(tmp_path: Path) -> None:
    """One that is asked for; a port that is taken ends the start, with the reason."""
    with listening(tmp_path / "server", "--metrics", "0.0.0.0:0") as server:
        assert "warning metrics_are_open" in server.said()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(AssertionError, match=r"--metrics \d+: .*in use"),
            listening(tmp_path / "other", "--metrics", str(port)),
        ):
            pass


def test_without_the_library_the_error_names_the_extra(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['prometheus_client'] = None\n"
        "from envhub_worker.__main__ import main\n"
        "sys.exit(main(['listen', '--state-dir', sys.argv[1], '--bind', 'tcp://127.0.0.1:*', "
        "*sys.argv[2:]]))"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "state")]
    done = subprocess.run([*command, "--metrics", "0"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "pip install 'envhub-sandbox[metrics]'" in done.stderr
    done = subprocess.run([*command, "--metrics", "x"], capture_output=True, text=True, timeout=120)
    assert "--metrics takes" in done.stderr


# --- attacks -----------------------------------------------------------------------------------


@pytest.fixture
def good(one: Watched, repository: Path) -> Iterator[Any]:
    """A client's environment and a reader of figures, which both must go on."""
    with started(repository, sandbox=one.server.sandbox()) as env:
        yield env
        assert (env.step(np.array([0]))[0].tolist(), one.get("/healthz")[0]) == ([[1.0]], 200)


def test_slow_readers_and_huge_requests_are_shown_the_door(one: Watched, good: Any) -> None:
    """A request that does not end, and an answer that nobody reads. One that is larger than any of
    ours is answered or ended, and not kept."""
    silent, slow, deaf = knock(one.port), knock(one.port), knock(one.port)
    slow.sendall(b"GET /metrics HTTP/1.1\r\n")
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    deaf.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
    good.call("count")
    assert hears(silent) == hears(slow) == b""
    for connection in (silent, slow, deaf):
        connection.close()
    before = one.server.memory()
    for data in (b"x" * 64 * _MIB, b"GET /" + b"a" * 16 * _MIB, b"GET / HTTP/1.1\r\n" * 1_000_000):
        with knock(one.port) as connection, contextlib.suppress(ConnectionError):
            connection.sendall(data)
            heard = hears(connection)
            assert heard == b"" or heard.startswith(b"HTTP/1.1 4"), heard[:100]
    assert one.server.memory() - before < 16 * _MIB


def test_a_crowd_does_not_hold_the_clients(one: Watched, good: Any) -> None:
    """Of connections, more than there is room for; or of readers: figures are made once for all of
    them, and steps go on meanwhile."""
    before = psutil.Process(one.server.process.pid).num_fds()
    with contextlib.ExitStack() as crowd:
        for _ in range(10 * MAX_CONNECTIONS):
            connection = crowd.enter_context(socket.socket())
            connection.setblocking(False)
            connection.connect_ex(("127.0.0.1", one.port))

        def answers() -> bool:
            with contextlib.suppress(ConnectionError, http.client.RemoteDisconnected):
                return one.get("/healthz")[0] == 200
            return False  # who asks slowly makes room for the crowd's late ones, and asks again

        assert eventually(answers)
        now = psutil.Process(one.server.process.pid).num_fds()
        assert now < before + 5 * MAX_CONNECTIONS
        good.call("count")
    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):
                get(one.port, "/metrics")

    readers = [threading.Thread(target=read) for _ in range(4)]
    for reader in readers:
        reader.start()
    try:
        for _ in range(50):
            good.call("count")
    finally:
        stop.set()
        for reader in readers:
            reader.join()


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET /metrics HTTP/1.1\r\n\r\n", 200),
        (b"GET /metrics?x=1 HTTP/1.0\n\n", 200),
        (b"HEAD /healthz HTTP/1.1\r\n\r\n", 200),
        (b"GET /../../etc/passwd HTTP/1.1\r\n\r\n", 404),
        (b"POST /metrics HTTP/1.1\r\nContent-Length: 9\r\n\r\n", 405),
        (b"\r\n\r\n", 400),
        (b"GET\r\n\r\n", 400),
        (b"GET /metrics HTTP/9.9\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\n\n", 400),
        (b"GET /\xff\x00\x1b HTTP/1.1\r\n\r\n", 404),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * MAX_REQUEST_BYTES, 431),
        (b"x" * (MAX_REQUEST_BYTES + 1), 431),
    ],
)
def test_only_whole_requests_are_answered(one: Watched, request_: bytes, status: int) -> None:
    """Whatever else is sent; ``HEAD`` without the page."""
    with knock(one.port) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(request_)
        heard = hears(connection)
    if len(request_) > 2 * MAX_REQUEST_BYTES:
        assert heard == b"" or b" 431 " in heard  # what was not read may take the answer along
        return
    head, _, body = heard.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status)
    read = status == 200 and not request_.startswith(b"HEAD")
    assert bool(body) == (read or status == 404)


def test_a_newcomer_takes_the_place_of_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of one that says something at that moment; one that will say no more is not kept."""
    monkeypatch.setattr(http_port, "PATIENCE_S", 3600.0)
    asked, both_came = threading.Event(), threading.Event()

    def answer(path: str) -> http_port.Reply:
        if path == "/large":
            asked.set()
            both_came.wait(60)
        return 200, "text/plain", bytes(_MIB * 16) if path == "/large" else b"right"

    port = HttpPort("127.0.0.1", 0, answer, print)
    number = int(port.address.rpartition(":")[2])
    try:
        with contextlib.ExitStack() as crowd:
            found = [crowd.enter_context(knock(number)) for _ in range(MAX_CONNECTIONS + 1)]
            assert hears(found[0]) == b""
            found[2].sendall(b"GET /large HTTP/1.1\r\n\r\n")  # and does not read it
            assert asked.wait(60)
            newcomer = crowd.enter_context(knock(number))
            found[1].sendall(b"GET / HTTP/1.1\r\n\r\n")
            both_came.set()
            newcomer.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert hears(newcomer).endswith(b"right")
            found[3].shutdown(socket.SHUT_WR)
            assert hears(found[3]) == b""
    finally:
        port.close()


def test_a_page_that_fails_is_an_answer() -> None:
    """The thread goes on; what was wrong is in the log."""

    def answer(path: str) -> http_port.Reply:
        if path == "/wrong":
            raise RuntimeError("on purpose")
        return 200, "text/plain", b"right"

    said = list[str]()
    port = HttpPort("127.0.0.1", 0, answer, said.append)
    try:
        number = int(port.address.rpartition(":")[2])
        assert (get(number, "/wrong")[0], get(number, "/right")) == (500, (200, "right"))
    finally:
        port.close()
    assert len(said) == 1
    assert "on purpose" in said[0]
