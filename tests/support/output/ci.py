"""What a CI system obeys of a log, and programs whose output goes to a pipe or to a terminal."""

import contextlib
import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
from collections.abc import Mapping, Sequence

_LINES = re.compile("\r\n|[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]")
_SKIPPED = re.compile("(?:\\s|\x1b\\[[0-9;?]*[A-Za-z])*")
_ANYWHERE = re.compile(r"##\w{0,16}\[|section_(?:start|end):")
"""GitHub's runner looks for ``##[`` and Azure's for ``##vso[``; the name between is short elsewhere
too (``##teamcity[``)."""


def obeyed(log: str) -> list[str]:
    """The lines with a command: of GitHub's runner, in both its forms, of Azure's, or GitLab's."""
    lines = (_SKIPPED.sub("", line, count=1) for line in _LINES.split(log))
    return [line for line in lines if line.startswith("::") or _ANYWHERE.search(line)]


def log_of(
    command: Sequence[str], columns: int | None, variables: Mapping[str, str] | None = None
) -> tuple[int, str]:
    """The exit code of a program, and its output: to a terminal of so many columns, or a pipe."""
    env = {**os.environ, "PYTHONIOENCODING": "utf-8", **(variables or {})}
    if columns is None:
        done = subprocess.run(
            command,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=300,
            check=False,
        )
        return done.returncode, done.stdout.decode("utf-8", "replace")
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    env["COLUMNS"] = str(columns)
    with subprocess.Popen(command, env=env, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # EIO: all who could write have ended
            while part := os.read(ours, 65536):
                shown += part
        code = process.wait(timeout=300)
    os.close(ours)
    return code, shown.decode("utf-8", "replace")
