"""Copies a jail's output to a log, a file or stderr while the jail runs.

A thread asks the server for it a few times a second, over a connection of its own, so that steps
are not delayed. It runs only with ``Policy(output=...)``, or with DEBUG on the logger
``envhub_sandbox.worker.output``. Trust: the text is the jail's; control characters are removed.
"""

from __future__ import annotations

import contextlib
import logging
import re
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from envhub_sandbox.errors import EnvHubError, PolicyError, WorkerTimeoutError
from envhub_sandbox.system.log import OUTPUT
from envhub_sandbox.system.threads import starting
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.transport.connection import WorkerConnection

FILE_BYTES = 64 << 20
"""The most that is written to one file, since a worker may print for ever."""
_PERIOD_S = 0.25
_ASK_S = 5.0
_LINE_CHARS = 4096
_LINE_BYTES = 4 * _LINE_CHARS
_ENDS = rb"\r\n|\n|\r"

Sink = Callable[[str], object]


class Lines:
    """Cuts bytes into lines without control characters, and gives each line to the sinks."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = sinks
        self._rest = b""  # the begin of a line whose end has not come yet

    def feed(self, data: bytes) -> None:
        """Take bytes; every complete line goes to the sinks."""
        *lines, self._rest = re.split(_ENDS, self._rest + data)
        for line in lines:
            self._emit(line)
        while len(self._rest) > _LINE_BYTES:
            self._emit(self._rest[:_LINE_BYTES])
            self._rest = self._rest[_LINE_BYTES:]

    def say(self, text: str) -> None:
        """Emit a line of our own, after the pending text."""
        self.end()
        for sink in self._sinks:
            sink(f"[{text}]")

    def end(self) -> None:
        """Emit the last line, which may lack its newline."""
        if self._rest:
            self._emit(self._rest)
            self._rest = b""

    def _emit(self, line: bytes) -> None:
        text = printable(line.decode("utf-8", "backslashreplace"), _LINE_CHARS)
        for sink in self._sinks:
            sink(text)


def bounded_sink(write: Sink, left: int) -> Sink:
    """A sink that writes lines until ``left`` bytes are used up, then a note that it stops."""

    def sink(line: str) -> None:
        nonlocal left
        if left > 0:
            left -= len(line.encode("utf-8", "backslashreplace")) + 1
            write(f"{line}\n" if left > 0 else "[the rest is left out]\n")

    return sink


class OutputSinks:
    """The destinations of a jail's lines: a log, a file, stderr, several of these, or none.

    Args:
        label: The jail's name in the log.
        path: The file, or None; it grows to at most ``FILE_BYTES``.
        stderr: Whether lines also go to this program's stderr, at most ``FILE_BYTES``.
    Raises ``PolicyError``: the file cannot be written.
    """

    def __init__(self, label: str, path: Path | None, *, stderr: bool = False) -> None:
        self.sinks: list[Sink] = [bounded_sink(_write_to_stderr, FILE_BYTES)] if stderr else []
        self._file: TextIO | None = None
        if path is not None:
            try:
                self._file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115
            except OSError as error:
                raise PolicyError(f"policy: output {str(path)!r}: {error}") from error
            self.sinks.append(bounded_sink(self._file.write, FILE_BYTES - self._file.tell()))
        if OUTPUT.isEnabledFor(logging.DEBUG):
            self.sinks.append(partial(OUTPUT.debug, "%s: %s", label))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class OutputFollower:
    """Follows one jail's output until ``stop``.

    Args:
        connect: Makes a connection to the server, for this thread alone.
        jail: The jail's number.
        sinks: The destinations of its lines.
    """

    def __init__(
        self, connect: Callable[[], WorkerConnection], jail: int, sinks: OutputSinks
    ) -> None:
        self._connect, self._jail, self._sinks = connect, jail, sinks
        self._lines = Lines(sinks.sinks)  # joins lines over several answers
        self._offset = 0  # of the next byte to ask for, in all that the jail has printed
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="envhub-output", daemon=True)
        with starting("the thread that reads what a jail prints"):
            self._thread.start()

    def stop(self) -> None:
        """Fetch the rest of the output and stop. Call it before closing the jail. Idempotent."""
        self._stopped.set()
        if self._thread is not threading.current_thread():
            self._thread.join(_ASK_S)

    def _run(self) -> None:
        try:
            client = self._connect()
            try:
                while not self._stopped.wait(_PERIOD_S):
                    with contextlib.suppress(WorkerTimeoutError):  # a busy server is asked again
                        self._ask(client)
                rest = Deadline(_ASK_S)  # as long as stop() waits: a server may never end
                while self._ask(client) and not rest.passed:
                    pass
            finally:
                client.close()
        except EnvHubError:
            pass  # the server has gone, or the jail was closed
        finally:
            self._lines.end()
            self._sinks.close()

    def _ask(self, client: WorkerConnection) -> int:
        """Fetch new output; returns how many bytes it had."""
        request = m.FollowOutput(self._jail, self._offset)
        reply = expect_reply(client.request(request, deadline=Deadline(_ASK_S))[0], m.OutputBytes)
        if reply.start > self._offset:
            self._lines.say(f"{reply.start - self._offset} bytes are lost: it printed too fast")
        self._offset = reply.start + len(reply.data)
        self._lines.feed(reply.data)
        return len(reply.data)


def _write_to_stderr(text: str) -> None:
    """Write to the current ``sys.stderr``, such as a notebook's; failing to write is no error."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(text)
        sys.stderr.flush()
