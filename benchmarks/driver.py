"""Starts peers in processes of their own, and gives them turns."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.clock import Slice
from benchmarks.interpreters import Interpreters
from benchmarks.load import take_precedence
from benchmarks.peers import Peer
from benchmarks.workloads import Workload

ROOT = Path(__file__).resolve().parent.parent
_OPEN_S = 180.0
_REPLY_S = 180.0
_CLOSE_S = 15.0


class Absent(Exception):
    """A peer that cannot be measured, and why."""


class Player:
    """One peer with its environments open, stopped between its turns if it is restless.

    Attributes:
        peer: Who.
        ready: What it said when its environments were up.
    """

    def __init__(self, peer: Peer, workload: Workload, count: int, python: str) -> None:
        self.peer = peer
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        self._process = subprocess.Popen(
            [python, "-m", "benchmarks.driven", peer.name, workload.name, str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            cwd=ROOT,
            env=os.environ | {"PYTHONWARNINGS": "ignore", "OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )
        try:
            self.ready = self._report(_OPEN_S)
            if not self.ready.get("ready"):
                raise Absent(self.ready.get("missing") or f"{self.ready.get('failed')}")
            take_precedence(self._process.pid)
        except BaseException:
            self.close()
            raise
        self._pause()

    def turn(self, order: Slice) -> dict[str, Any]:
        """Run one slice."""
        return self._ask({"do": "slice", **asdict(order)})

    def _ask(self, order: dict[str, Any]) -> dict[str, Any]:
        self._signal(signal.SIGCONT)
        with suppress(BrokenPipeError):  # it has ended; there may still be a report
            self._write(order)
        report = self._report(_REPLY_S)
        self._pause()
        return report

    def _write(self, order: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()

    def _report(self, timeout_s: float) -> dict[str, Any]:
        stdout = self._process.stdout
        assert stdout is not None
        if not select.select([stdout], [], [], timeout_s)[0]:
            raise Absent(f"no answer in {timeout_s:.0f} s. {self._last_words()}")
        line = stdout.readline()
        if not line:
            raise Absent(f"it ended. {self._last_words()}")
        report: dict[str, Any] = json.loads(line)
        return report

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return lines[-1][:300] if lines else ""

    def _pause(self) -> None:
        if self.peer.restless:
            self._signal(signal.SIGSTOP)

    def _signal(self, number: int) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def close(self) -> None:
        """End it: politely, then for certain."""
        self._signal(signal.SIGCONT)
        with suppress(OSError):
            self._write({"do": "close"})
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_S)
        self._signal(signal.SIGKILL)
        self._process.communicate()
        self._log.close()


@contextmanager
def players(
    peers: list[Peer], workload: Workload, count: int, interpreters: Interpreters
) -> Iterator[tuple[list[Player], dict[str, str]]]:
    """Those that came up, and why the others did not."""
    present: list[Player] = []
    absent: dict[str, str] = {}
    try:
        for peer in peers:
            try:
                present.append(Player(peer, workload, count, interpreters.of(peer)))
            except Absent as error:
                absent[peer.name] = str(error)
        yield present, absent
    finally:
        for player in present:
            player.close()
