"""A poll loop in one thread with callbacks for descriptors; sends and receives ZeroMQ messages.

The functions for messages skip work that pyzmq's own do for each frame.
"""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Callable, Mapping, Sequence
from time import monotonic

import zmq

from envhub_worker.protocol.codec.wire import Buffer

# Plain numbers: reading an enumeration's member costs more than the call that takes it.
_MORE = int(zmq.SNDMORE)
_NOW = int(zmq.NOBLOCK)
_EVENTS = int(zmq.EVENTS)
_READABLE = int(zmq.POLLIN)
_POLL_MS = 1000
_SIGNALS = 64
"""Read at once."""
_MAX_FAILURES = 100
"""Callbacks that fail one after the other."""


def _nothing(*_: object) -> None:
    pass


class Loop:
    """Calls back when a descriptor is ready or a ZeroMQ socket has messages, until ``stop``.
    ``failed``: called with the error of a callback; it must not raise.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        # Not ``zmq.Poller``: before it sleeps, zmq_poll(3) asks each socket twice, and to be asked
        # takes three system calls.
        self._poller = select.poll()
        self._callbacks: dict[int, Callable[[], None]] = {}  # by descriptor
        self._sockets: list[tuple[zmq.Socket[bytes], Callable[[], None]]] = []
        self._stopped = False
        self._tick: Callable[[], None] = _nothing  # called about once a second
        self._look: Callable[[], int | None] = _nothing  # called before each wait
        self._failures = 0  # of callbacks, in a row

    def tick(self, callback: Callable[[], None]) -> None:
        """Call a function about once a second, from now on."""
        self._tick = callback

    def look_by(self, callback: Callable[[], int | None]) -> None:
        """Call a function before each wait; it returns the wait's milliseconds at most, or None."""
        self._look = callback

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call a function when a descriptor is readable."""
        self._poller.register(fd, select.POLLIN)
        self._callbacks[fd] = callback

    def watch_messages(self, socket: zmq.Socket[bytes], callback: Callable[[], None]) -> None:
        """Call a function while a ZeroMQ socket has messages."""
        # A socket's descriptor is readable from the arrival of a message to the next call of any
        # function of the socket (zmq_getsockopt(3), ZMQ_FD). So before each sleep the loop also
        # asks the socket itself.
        self.watch(socket.fileno(), callback)
        self._sockets.append((socket, callback))

    def watch_writes(self, fd: int, wanted: bool) -> None:
        """Set whether a watched descriptor's function is also called when it is writable."""
        self._poller.register(fd, select.POLLIN | (select.POLLOUT if wanted else 0))

    def unwatch(self, fd: int) -> None:
        """Forget a descriptor. Idempotent."""
        if self._callbacks.pop(fd, None) is not None:
            self._poller.unregister(fd)

    def call_on(self, signals: Mapping[int, Callable[[], None]]) -> None:
        """Call a function at these signals, between two rounds. Only on the main thread."""
        woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(wakes)  # it gets the signals' numbers, a byte each
        for number in signals:
            signal.signal(number, _nothing)  # it only wakes the poll

        def signalled() -> None:
            for number in os.read(woken, _SIGNALS):
                if number in signals:
                    signals[number]()

        self.watch(woken, signalled)

    def stop(self) -> None:
        """End the loop after the current round."""
        self._stopped = True

    def run(self) -> None:
        """Poll and call functions until ``stop``."""
        ticked = monotonic()
        while not self._stopped:
            wait_ms = self._wait_ms()
            for socket, read in self._sockets:
                if has_message(socket):
                    self._call(read)
                    wait_ms = 0
            for fd, _ in self._poller.poll(wait_ms):
                callback = self._callbacks.get(fd)
                if callback is not None:
                    self._call(callback)
            if monotonic() - ticked >= _POLL_MS / 1000:
                ticked = monotonic()
                self._call(self._tick)

    def _wait_ms(self) -> int:
        try:
            wait_ms = self._look()
        except Exception as error:  # as for a callback
            self._failed(error)
            return _POLL_MS
        return _POLL_MS if wait_ms is None else wait_ms

    def _call(self, callback: Callable[[], None]) -> None:
        """Call a function. A single error must not end the server for all clients; after many
        failures in a row the error is raised.
        """
        try:
            callback()
        except Exception as error:
            self._failures += 1
            if self._failures >= _MAX_FAILURES:
                raise
            self._failed(error)
        else:
            self._failures = 0


def has_message(socket: zmq.Socket[bytes]) -> bool:
    """Whether ``receive`` would return a message; cheaper than the exception of a vain attempt."""
    return bool(int(socket.getsockopt(_EVENTS)) & _READABLE)


def receive(socket: zmq.Socket[bytes]) -> list[bytes]:
    """Returns the frames of an arrived message; raises ``zmq.Again`` if there is none."""
    frame = socket.recv(_NOW, copy=False)
    frames = [frame.bytes]
    while frame.more:
        frame = socket.recv(_NOW, copy=False)
        frames.append(frame.bytes)
    return frames


def send(socket: zmq.Socket[bytes], frames: Sequence[Buffer], *, copy: bool) -> None:
    """Send without waiting; drops the message if the client's queue is full.

    Without ``copy``, the caller must not change large frames any more.
    """
    for frame in frames[:-1]:
        socket.send(frame, _NOW | _MORE, copy)
    socket.send(frames[-1], _NOW, copy)
