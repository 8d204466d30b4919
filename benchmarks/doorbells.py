"""What a wake-up costs, by its mechanism: ``python -m benchmarks.doorbells``.

Two processes share a word and wake one another, each asleep when it is rung; one round
trip is two wake-ups. All mechanisms have a turn in each round, in a new order; ratios to the first
stay within a round. Beside them stands the share of the cores that the host took away meanwhile.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import select
import socket
import statistics
from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any

from benchmarks.load import stolen
from envhub_worker.protocol.shared_memory.descriptors import OwnBell, RunnerBell, Watch

_RING = (1).to_bytes(8, "little")
_FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL

End = tuple[Callable[[], object], Callable[[], object]]
"""Rings the other side; sleeps until it is rung."""


def _poll(fd: int, take_back: Callable[[], object]) -> Callable[[], object]:
    poller = select.poll()
    poller.register(fd, select.POLLIN)

    def sleep() -> None:
        poller.poll()
        take_back()

    return sleep


def eventfds() -> tuple[End, End]:
    """Descriptions that both sides share."""
    there, back = os.eventfd(0), os.eventfd(0)
    ours = (lambda: os.write(there, _RING)), _poll(back, lambda: os.read(back, 8))
    theirs = (lambda: os.write(back, _RING)), _poll(there, lambda: os.read(there, 8))
    return ours, theirs


def pipes() -> tuple[End, End]:
    """A pipe each way."""
    (heard_there, there), (heard_back, back) = os.pipe(), os.pipe()
    ours = (lambda: os.write(there, b"r")), _poll(heard_back, lambda: os.read(heard_back, 64))
    theirs = (lambda: os.write(back, b"r")), _poll(heard_there, lambda: os.read(heard_there, 64))
    return ours, theirs


def _sockets(kind: int) -> tuple[End, End]:
    def end(own: socket.socket) -> End:
        return (lambda: own.send(_RING, _FLAGS)), _poll(own.fileno(), lambda: own.recv(64))

    one, other = socket.socketpair(socket.AF_UNIX, kind)
    return end(one), end(other)


def ours() -> tuple[End, End]:
    """What the fast lane uses: a socket there, an eventfd that is only watched back."""
    there, back, watch = RunnerBell(), OwnBell(), Watch()
    watch.bell(back)
    heard = there.theirs
    client = there.ring, lambda: watch.wait(None)
    # by the bell itself, which closes with its last owner
    runner = (lambda: os.write(back.fileno(), _RING)), _poll(heard, lambda: os.read(heard, 8))
    return client, runner


MECHANISMS: dict[str, Callable[[], tuple[End, End]]] = {
    "eventfds": eventfds,
    "socket and watched eventfd": ours,
    "pipes": pipes,
    "stream sockets": lambda: _sockets(socket.SOCK_STREAM),
    "packet sockets": lambda: _sockets(socket.SOCK_SEQPACKET),
    "datagram sockets": lambda: _sockets(socket.SOCK_DGRAM),
}


def turn(mechanism: str, trips: int) -> float:
    """The median round trip, in microseconds."""
    (ring, sleep), (ring_back, sleep_there) = MECHANISMS[mechanism]()
    words = memoryview(mmap.mmap(-1, 128)).cast("Q")
    child = os.fork()
    if child == 0:
        _echo(words, ring_back, sleep_there, trips)
    times = []
    for number in range(1, trips + 1):
        start = perf_counter_ns()
        words[0] = number
        ring()
        while words[8] != number:
            sleep()
        times.append(perf_counter_ns() - start)
    os.waitpid(child, 0)
    return statistics.median(times) / 1000


def _echo(words: Any, ring: Callable[[], object], sleep: Callable[[], object], trips: int) -> None:
    try:
        for number in range(1, trips + 1):
            while words[0] != number:
                sleep()
            words[8] = number
            ring()
    finally:
        os._exit(0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each mechanism."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.doorbells")
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--trips", type=int, default=2000)
    options = parser.parse_args(arguments)
    found: dict[str, list[float]] = {name: [] for name in MECHANISMS}
    before, order = stolen(), random.Random(0)
    for _ in range(options.rounds):
        for name in order.sample(list(MECHANISMS), len(MECHANISMS)):
            found[name].append(turn(name, options.trips))
    taken, passed = (late - early for late, early in zip(stolen(), before, strict=True))
    base = found[next(iter(MECHANISMS))]
    for name, times in found.items():
        ratio = statistics.median(own / first for own, first in zip(times, base, strict=True))
        print(f"{name:28} {statistics.median(times):7.1f} us  {ratio:.2f} of {next(iter(found))}")
    print(f"stolen: {taken / max(passed, 1):.1%}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
