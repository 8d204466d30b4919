"""How fast steps are over a network, beside the same environments in a local sandbox.

``python -m benchmarks remote [SECONDS [WORKLOAD ...]]`` starts a server on loopback and a wire to
it that delays both ways, since kernels without netem cannot. All ways have a turn in each round, in
a new order; what is printed is medians. Beside them stands what ZeroMQ alone does in the same
rounds, two processes with CURVE: echoes of 64 bytes, and the bytes of the workload's observation.
``python -m benchmarks remote driver`` measures what a step costs the client itself, of 1 and of 16
workers.
"""

from __future__ import annotations

import contextlib
import os
import queue
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, perf_counter, sleep, thread_time
from typing import Any

import numpy as np
import zmq

from benchmarks.load import take_precedence
from envhub_sandbox import RemoteSandbox, make_env

_REPOSITORIES = Path(__file__).parent / "repositories"
_DELAYS_MS = (1, 10)
_ROUNDS = 5
_WORKLOADS = (("cartpole", 1), ("cartpole", 16), ("halfcheetah", 8), ("cameras", 1), ("plain", 1))
_WORKERS = (1, 16)
_REQUEST = bytes(64)
_ECHO = """
import sys, zmq
size, secret = int(sys.argv[1]), sys.argv[2].encode()
router = zmq.Context().socket(zmq.ROUTER)
router.curve_server, router.curve_secretkey = True, secret
router.bind("tcp://127.0.0.1:*")
print(router.getsockopt_string(zmq.LAST_ENDPOINT), flush=True)
answer = bytes(size)
while True:
    peer, _ = router.recv_multipart()
    router.send_multipart([peer, answer])
"""


def main(seconds: float = 2.0, *workloads: str) -> None:
    """Print a table: one row a workload (all by default), one column a way to it."""
    ways = ["process", "frames", "no keys", "CURVE", *(f"CURVE, {ms} ms" for ms in _DELAYS_MS)]
    ways += ["echo", "its bytes"]
    print("| workload | " + " | ".join(ways) + " |")
    print("|---" * (len(ways) + 1) + "|")
    with _servers() as (keyed, plain, delayed):
        for name, n_envs in (one for one in _WORKLOADS if one[0] in workloads or not workloads):
            options: list[dict[str, Any]] = [
                {"sandbox": "process"},
                {"sandbox": "process", "policy": {"lane": "frames"}},
                *({"sandbox": sandbox} for sandbox in (plain, keyed, *delayed)),
            ]
            with contextlib.ExitStack() as stack:
                envs = [stack.enter_context(_env(name, n_envs, one)) for one in options]
                steps = [_stepper(env) for env in envs]
                steps += [stack.enter_context(_echo(size)) for size in (64, _size(envs[0]))]
                take_precedence(os.getpid())
                rates = _rates(steps, seconds)
            print(f"| {name}, n={n_envs} | " + " | ".join(f"{rate:.0f}" for rate in rates) + " |")


def driver(seconds: float) -> None:
    """Print what one step of one worker costs the client's own thread."""
    print("| workers | frames, us | CURVE, us |")
    print("|---|---|---|")
    with _servers() as (keyed, _, _):
        for count in _WORKERS:
            costs = []
            for options in ({"policy": {"lane": "frames"}}, {"sandbox": keyed}):
                with contextlib.ExitStack() as stack:
                    places = [_env("cartpole", 1, options) for _ in range(count)]
                    costs.append(_cost([stack.enter_context(one) for one in places], seconds))
            print(f"| {count} | " + " | ".join(f"{cost:.0f}" for cost in costs) + " |")


def _cost(envs: list[Any], seconds: float) -> float:
    """Microseconds of this thread for a step of one; all are asked before one is waited for."""
    actions = envs[0].action_space.sample()
    until, count, began = perf_counter() + seconds, 0, thread_time()
    while perf_counter() < until:
        for env in envs:
            env.step_async(actions)
        for env in envs:
            env.step_wait()
        count += 1
    return (thread_time() - began) / count / len(envs) * 1e6


@contextmanager
def _env(name: str, n_envs: int, options: dict[str, Any]) -> Iterator[Any]:
    with make_env(_REPOSITORIES / name, n_envs=n_envs, **options) as suites:
        suites.env.reset(seed=0)
        yield suites.env


def _size(env: Any) -> int:
    """Bytes of an observation."""
    spaces = getattr(env.observation_space, "spaces", {"": env.observation_space})
    return sum(int(np.prod(one.shape)) * one.dtype.itemsize for one in spaces.values())


def _stepper(env: Any) -> Callable[[], object]:
    actions = env.action_space.sample()
    return lambda: env.step(actions)


def _rates(steps: list[Callable[[], object]], seconds: float) -> list[float]:
    """Of each, how often a second; after a tenth of the time to warm up."""
    found: list[list[float]] = [[] for _ in steps]
    for step in steps:
        _times(step, seconds / 10)
    for _ in range(_ROUNDS):
        for index in random.sample(range(len(steps)), len(steps)):
            start = perf_counter()
            count = _times(steps[index], seconds / _ROUNDS)
            found[index].append(count / (perf_counter() - start))
    return [statistics.median(one) for one in found]


def _times(step: Callable[[], object], seconds: float) -> int:
    end, count = perf_counter() + seconds, 0
    while perf_counter() < end or not count:
        step()
        count += 1
    return count


@contextmanager
def _echo(size: int) -> Iterator[Callable[[], object]]:
    """A request of 64 bytes to another process, and its answer of so many."""
    (public, secret), (own_public, own_secret) = zmq.curve_keypair(), zmq.curve_keypair()
    command = [sys.executable, "-c", _ECHO, str(size), secret.decode()]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        zmq.Context() as context,
        context.socket(zmq.DEALER) as peer,
    ):
        try:
            assert server.stdout is not None
            peer.curve_serverkey = public
            peer.curve_publickey, peer.curve_secretkey = own_public, own_secret
            peer.connect(server.stdout.readline().strip())

            def step() -> None:
                peer.send(_REQUEST)
                peer.poll()
                peer.recv(copy=False)

            yield step
        finally:
            peer.close(0)
            server.kill()


@contextmanager
def _servers() -> Iterator[tuple[RemoteSandbox, RemoteSandbox, list[RemoteSandbox]]]:
    """Sandboxes with keys, without, and with keys over wires that delay."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        keyed, plain = Path(folder, "keyed"), Path(folder, "plain")
        endpoint = stack.enter_context(listening(keyed))
        public, secret = ((keyed / f"{name}").read_text() for name in ("server.pub", "client.key"))
        without = stack.enter_context(listening(plain, "--insecure-loopback"))
        delayed = [
            RemoteSandbox(stack.enter_context(delaying(endpoint, ms)), public, secret)
            for ms in _DELAYS_MS
        ]
        open_one = RemoteSandbox(without, insecure_loopback=True)
        yield RemoteSandbox(endpoint, public, secret), open_one, delayed


@contextmanager
def listening(state: Path, *options: str) -> Iterator[str]:
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
def delaying(endpoint: str, delay_ms: int) -> Iterator[str]:
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
        if sys.argv[1:2] == ["driver"]:
            driver(*map(float, sys.argv[2:] or ["2"]))
            sys.exit()
        main(*map(float, sys.argv[1:2]), *sys.argv[2:])
