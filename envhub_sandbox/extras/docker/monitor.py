"""The monitor of one container: ends the container with its client, and cleans up after it.

It runs as a script, with ``-I -S`` and the standard library only::

    monitor.py CLIENT_PIDFD READY_FD FOLDER NAME -- ENGINE run ...

The monitor starts the engine's attached ``run`` with a pipe as stdin. Only the monitor holds the
pipe's other end, because a fork of the client would keep it open. The monitor closes the pipe, and
so ends the container, at SIGTERM and whenever the client ends; the kernel closes it if the monitor
is killed. The monitor writes one JSON document to ``READY_FD``: the container's announcement, or
the end of the engine's command. Last it removes the container, if it is left, and ``FOLDER``.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence

_LINE_BYTES = 65536
_TAIL_BYTES = 8192
_END_S = 8.0
_REMOVE_S = 30.0


def main(argv: Sequence[str]) -> int:
    """Run a container until its client ends."""
    client, ready = int(argv[0]), int(argv[1])
    folder, name, command = argv[2], argv[3], list(argv[5:])
    woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wakes)
    signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        return ContainerMonitor(client, ready, woken, command).run()
    finally:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            # --rm has usually removed it by now; an engine that was restarted may have kept it
            nothing = subprocess.DEVNULL
            subprocess.run(
                [command[0], "rm", "--force", "--volumes", name],
                stdin=nothing,
                stdout=nothing,
                stderr=nothing,
                timeout=_REMOVE_S,
            )
        shutil.rmtree(folder, ignore_errors=True)


class ContainerMonitor:
    """The loop: waits for the client's end, and reads the container's output until its end."""

    def __init__(self, client: int, ready: int, woken: int, command: list[str]) -> None:
        self._client, self._ready, self._woken = client, ready, woken
        self._line = b""
        self._tail = b""
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()

    def run(self) -> int:
        """Run until the client or the container ends; returns the engine's exit code."""
        poller = select.poll()
        for fd in (self._client, self._woken, self._output):
            poller.register(fd, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poller.poll()}
            if self._output in ready and not self._read():
                break
            if ready & {self._client, self._woken}:
                break
        return self._end()

    def _read(self) -> bool:
        data = os.read(self._output, 65536)
        self._tail = (self._tail + data)[-_TAIL_BYTES:]
        if self._ready >= 0:
            *lines, line = (self._line + data).split(b"\n")
            self._line = line[-_LINE_BYTES:]
            for text in lines:
                if text.startswith(b'{"envhub-worker"'):
                    self._tell(text)  # the first of them; later ones are not told
        return bool(data)

    def _tell(self, document: bytes) -> None:
        if self._ready >= 0:
            with contextlib.suppress(OSError):  # the client has stopped waiting
                os.write(self._ready, document[:_LINE_BYTES] + b"\n")
            os.close(self._ready)
            self._ready = -1

    def _end(self) -> int:
        lifeline, self._process.stdin = self._process.stdin, None
        assert lifeline is not None
        lifeline.close()
        # the server ends when its stdin does; unread output would block it
        try:
            rest, _ = self._process.communicate(timeout=_END_S)
            self._tail = (self._tail + rest)[-_TAIL_BYTES:]
        except subprocess.TimeoutExpired:
            self._process.kill()
        code = self._process.wait()
        tail = self._tail.decode("utf-8", "replace")
        self._tell(json.dumps({"ended": code, "tail": tail}).encode())
        return code


if __name__ == "__main__":
    ended = main(sys.argv[1:]) if len(sys.argv) > 6 else 2
    sys.exit(ended if ended >= 0 else 125)  # a signal ended it: an engine's failure
