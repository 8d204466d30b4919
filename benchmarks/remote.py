"""Steps per second over a network, against the same environments in a local sandbox.

``python -m benchmarks.remote [SECONDS [WORKLOAD ...]]`` starts a server on loopback and a wire to
it that delays both ways, since kernels without netem cannot.
"""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, perf_counter, sleep
from typing import Any

from envhub_sandbox import RemoteSandbox, make_env

_REPOSITORIES = Path(__file__).parent / "repositories"
_DELAYS_MS = (1, 10)
_WORKLOADS = (("cartpole", 1), ("cartpole", 16), ("halfcheetah", 8), ("cameras", 1), ("plain", 1))


def main(seconds: float = 2.0, *workloads: str) -> None:
    """Print a table: one row a workload (all by default), one column a way to it."""
    ways = ["process", "frames", "no keys", "CURVE", *(f"CURVE, {ms} ms" for ms in _DELAYS_MS)]
    print("| workload | " + " | ".join(ways) + " |")
    print("|---" * (len(ways) + 1) + "|")
    with _servers() as (keyed, plain, delayed):
        for name, n_envs in (one for one in _WORKLOADS if one[0] in workloads or not workloads):
            options: list[dict[str, Any]] = [
                {"sandbox": "process"},
                {"sandbox": "process", "lane": "frames"},
                *({"sandbox": sandbox} for sandbox in (plain, keyed, *delayed)),
            ]
            rates = [_rate(name, n_envs, seconds, one) for one in options]
            print(f"| {name}, n={n_envs} | " + " | ".join(f"{rate:.0f}" for rate in rates) + " |")


def _rate(name: str, n_envs: int, seconds: float, options: dict[str, Any]) -> float:
    """Vector steps per second, after a tenth of the time to warm up."""
    with make_env(_REPOSITORIES / name, n_envs=n_envs, **options) as suites:
        env = suites.env
        env.reset(seed=0)
        actions = env.action_space.sample()
        _steps(env, actions, seconds / 10)
        start = perf_counter()
        count = _steps(env, actions, seconds)
        return count / (perf_counter() - start)


def _steps(env: Any, actions: Any, seconds: float) -> int:
    end, count = perf_counter() + seconds, 0
    while perf_counter() < end:
        env.step(actions)
        count += 1
    return count


@contextmanager
def _servers() -> Iterator[tuple[RemoteSandbox, RemoteSandbox, list[RemoteSandbox]]]:
    """Sandboxes with keys, without, and with keys over wires that delay."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        keyed, plain = Path(folder, "keyed"), Path(folder, "plain")
        endpoint = stack.enter_context(_listening(keyed))
        public, secret = ((keyed / f"{name}").read_text() for name in ("server.pub", "client.key"))
        without = stack.enter_context(_listening(plain, "--insecure-loopback"))
        delayed = [
            RemoteSandbox(stack.enter_context(_wire(endpoint, ms)), public, secret)
            for ms in _DELAYS_MS
        ]
        open_one = RemoteSandbox(without, insecure_loopback=True)
        yield RemoteSandbox(endpoint, public, secret), open_one, delayed


@contextmanager
def _listening(state: Path, *options: str) -> Iterator[str]:
    """A server; its endpoint."""
    command = [sys.executable, "-I", "-m", "envhub_worker", "listen", "--bind", "tcp://127.0.0.1:*"]
    command += ["--state-dir", str(state), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not (state / "endpoint").exists() or not (state / "endpoint").read_text():
            if process.poll() is not None:
                raise RuntimeError("the server did not start")
            sleep(0.05)
        yield (state / "endpoint").read_text().split()[0]
    finally:
        process.terminate()
        process.wait()


@contextmanager
def _wire(endpoint: str, delay_ms: int) -> Iterator[str]:
    """A process of its own that forwards to an endpoint, later."""
    command = [sys.executable, "-m", "benchmarks.remote", "wire", endpoint, str(delay_ms)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait()


def wire(endpoint: str, delay_s: float) -> None:
    """Forward every connection, each piece ``delay_s`` after it came. Never returns."""
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    listener = socket.create_server(("127.0.0.1", 0))
    print(f"tcp://127.0.0.1:{listener.getsockname()[1]}", flush=True)
    while True:
        near, _ = listener.accept()
        far = socket.create_connection((host, int(port)))
        for source, target in ((near, far), (far, near)):
            target.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            pieces: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
            threading.Thread(target=_read, args=(source, pieces, delay_s), daemon=True).start()
            threading.Thread(target=_write, args=(target, pieces), daemon=True).start()


def _read(
    source: socket.socket, pieces: queue.SimpleQueue[tuple[float, bytes]], delay_s: float
) -> None:
    data = b"-"
    while data:
        try:
            data = source.recv(1 << 18)
        except OSError:
            data = b""
        pieces.put((monotonic() + delay_s, data))


def _write(target: socket.socket, pieces: queue.SimpleQueue[tuple[float, bytes]]) -> None:
    with contextlib.suppress(OSError):
        while True:
            due, data = pieces.get()
            sleep(max(0.0, due - monotonic()))
            if not data:
                target.shutdown(socket.SHUT_WR)
                return
            target.sendall(data)


if __name__ == "__main__":
    if sys.argv[1:2] == ["wire"]:
        wire(sys.argv[2], float(sys.argv[3]) / 1000)
    else:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        main(*map(float, sys.argv[1:2]), *sys.argv[2:])
