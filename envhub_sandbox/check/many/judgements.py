"""Judgements side by side, each a process of its own: what ends one ends no other.

One thread starts them, looks what has become of them, and ends them: so that there is one place
that an interrupt can come to, and whatever it interrupts, none is left.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from envhub_sandbox.errors import WorkerStartupError
from envhub_sandbox.system.platform import kill_group, own_group, pidfd
from envhub_worker.protocol.text import printable, size_text

_TICK_S = 0.1
_MOST_BYTES = 32 << 20
"""Of what one prints: a document, or what it complains of."""
_TAIL_BYTES = 4_096
PATIENCE_S = 20.0
"""For one that has been asked to end: its jails have to go."""
_KILLED_S = 20.0
"""For the kernel to end one, where that is not in a disk's hands."""
T = TypeVar("T")
Command = Callable[[T, Path, int], list[str]]


@dataclass(frozen=True, kw_only=True)
class Outcome(Generic[T]):
    """What has become of a process.

    Attributes:
        order: What it was started for.
        folder: Its own, with what it has written. It is there until the next is asked for.
        code: Its exit code, negative for a signal; None where we have ended it.
        said: The end of what it has complained of, or why we have ended it. Trust: partly a
            stranger's text; it is printable.
    """

    order: T
    folder: Path
    code: int | None
    seconds: float
    out: bytes
    said: str


class _Job(Generic[T]):
    def __init__(
        self, order: T, folder: Path, command: Command[T], variables: Mapping[str, str]
    ) -> None:
        self.order, self._folder = order, folder
        self._begun = time.monotonic()
        folder.mkdir(mode=0o700)
        with (
            self._file("out").open("xb") as out,
            self._file("err").open("xb") as err,
            pidfd() as ourselves,
        ):
            try:
                self._process: subprocess.Popen[bytes] = subprocess.Popen(
                    command(order, folder, ourselves),
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    env={**os.environ, **variables},
                    pass_fds=(ourselves,),
                    **own_group(),  # Ctrl-C is for us, who then end it
                )
            except OSError as error:
                raise WorkerStartupError(
                    f"no check can be started: {error.strerror}. Finished results are kept; run "
                    "fewer at once with --jobs"
                ) from error

    @property
    def has_ended(self) -> bool:
        """Asked so that its number stays its own until its group is killed."""
        if self._process.returncode is not None:
            return True
        ended = True
        if sys.platform == "linux":
            with contextlib.suppress(ChildProcessError):  # SIGCHLD is ignored since before us
                how = os.WEXITED | os.WNOHANG | os.WNOWAIT
                ended = os.waitid(os.P_PID, self._process.pid, how) is not None
        else:
            ended = self._process.poll() is not None
        return ended

    def terminate(self) -> None:
        """Ask it to end."""
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it by force, and what it has left in its group, also where it has ended itself."""
        if self._process.returncode is None:
            kill_group(self._process)

    def reap(self) -> int | None:
        """Its exit code; None where the kernel cannot end it."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_KILLED_S)
        return self._process.returncode

    def ended(self, most_s: float, patience_s: float) -> Outcome[T] | None:
        """What has become of it, if it has ended; one that takes or says too much is ended."""
        why = ""
        if not self.has_ended:
            why = self._too_much(most_s)
            if not why:
                return None
            end([self], patience_s)
        self.kill()
        code = self.reap()
        return Outcome(
            order=self.order,
            folder=self._folder,
            code=None if why else code,
            seconds=time.monotonic() - self._begun,
            out=b"" if why else self._read("out", _MOST_BYTES),
            said=why or self._complaint(code),
        )

    def _too_much(self, most_s: float) -> str:
        if time.monotonic() - self._begun > most_s:
            return f"there was no result within {most_s:g} s (--deadline)"
        if any(self._file(name).stat().st_size > _MOST_BYTES for name in ("out", "err")):
            return f"it printed more than {size_text(_MOST_BYTES)}"
        return ""

    def _complaint(self, code: int | None) -> str:
        end = f"a signal ended it: {-code}. " if code is not None and code < 0 else ""
        text = self._read("err", _TAIL_BYTES).decode("utf-8", "replace")
        return printable(end + text.strip())

    def _read(self, name: str, last: int) -> bytes:
        with self._file(name).open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - last))
            return file.read(last)

    def _file(self, name: str) -> Path:
        return self._folder / name


def judgements(
    orders: Iterable[T],
    command: Command[T],
    *,
    folder: Path,
    jobs: int,
    most_s: float,
    variables: Mapping[str, str],
    patience_s: float = PATIENCE_S,
) -> Generator[Outcome[T], None, None]:
    """Run a command for each order, and yield what came of each as it ends.

    A caller that stops asking, or is interrupted, must close the iterator: then all are ended. A
    command gets a folder of its own, and a pidfd of ours that it has to end with.
    """
    waiting = enumerate(orders)
    running: list[_Job[T]] = []
    more = True
    try:
        while more or running:
            while more and len(running) < jobs:
                number, order = next(waiting, (-1, None))
                more = order is not None
                if order is not None:
                    running.append(_Job(order, folder / str(number), command, variables))
            time.sleep(_TICK_S)
            for job in tuple(running):
                what = job.ended(most_s, patience_s)
                if what is not None:
                    running.remove(job)
                    yield what
                    shutil.rmtree(what.folder, ignore_errors=True)
    finally:
        end(running, patience_s)


def end(running: Iterable[_Job[T]], patience_s: float) -> None:
    """End processes, and what they have started; another interrupt ends the wait."""
    left = list(running)
    until = time.monotonic() + patience_s
    try:
        for one in left:
            one.terminate()
        while time.monotonic() < until and not all(one.has_ended for one in left):
            time.sleep(_TICK_S / 4)
    finally:
        for one in left:
            one.kill()
        for one in left:
            one.reap()
