"""The program that makes a repository's packages: started, followed and ended.

It is the client's own, which the operator has installed beside this one, with its bounds. It
chooses versions, installs wheels by their hashes, runs nothing of them, and says what it did.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from time import monotonic
from typing import Any

PROGRAM = "envhub_sandbox.dependencies.for_a_server"
_RESULT_BYTES = 1 << 20
_CHECK_S = 60.0


class PackageProgram:
    """The program, at work on one order.

    Attributes:
        place: Whose the order is, and its hash.
        ended_at: When it was asked to end; None before.
    """

    def __init__(self, place: tuple[str, str], order: Mapping[str, Any]) -> None:
        self.place = place
        self.since = monotonic()
        self.ended_at: float | None = None
        with contextlib.ExitStack() as undo:
            self._said = undo.enter_context(tempfile.TemporaryFile())
            with tempfile.TemporaryFile() as given:
                given.write(json.dumps(order).encode())
                given.seek(0)
                ourselves = os.pidfd_open(os.getpid())  # it ends when we do, whatever ends us
                try:
                    self._process = subprocess.Popen(
                        [*command(), f"--server-pidfd={ourselves}"],
                        stdin=given,
                        stdout=self._said,
                        cwd="/",
                        start_new_session=True,
                        pass_fds=(ourselves,),
                    )
                finally:
                    os.close(ourselves)
            undo.pop_all()  # it lasts as long as the program

    def said(self) -> Mapping[str, Any]:
        """What the program has said; nothing while it writes."""
        try:
            found = json.loads(os.pread(self._said.fileno(), _RESULT_BYTES, 0))
            return found if isinstance(found, dict) else {}
        except ValueError:
            return {}

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.poll()

    def terminate(self, now: float) -> None:
        """Ask it to end."""
        self._process.terminate()
        self.ended_at = now

    def kill(self, patience_s: float = 0.0) -> None:
        """End it for certain, and what it started; give it so long to end by itself."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """It has ended: forget what it said."""
        self._said.close()


def command() -> list[str]:
    """The program, in the interpreter that this one runs in."""
    return [sys.executable, "-I", "-m", PROGRAM]


def why_impossible() -> str:
    """What hinders the program here; empty for nothing."""
    try:
        done = subprocess.run(
            [*command(), "check"], stdin=subprocess.DEVNULL, capture_output=True, timeout=_CHECK_S
        )
    except subprocess.TimeoutExpired:
        return f"the program that makes packages did not answer in {_CHECK_S:.0f} s"
    if done.returncode == 0:
        return ""
    said = done.stderr.decode(errors="replace").strip().splitlines() or ["no word"]
    return (
        "packages are installed by envhub-sandbox, which does not work in this worker's "
        f"interpreter ({sys.executable}): {said[-1][:500]}. Run: {sys.executable} -m pip install "
        "envhub-sandbox"
    )
