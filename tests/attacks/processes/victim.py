"""A process of the client's user that attacks aim at; run as a script, and its end for tests.
As a script it holds a secret in its memory, its environment, its command line and an unlinked
file, permits everybody to trace it (as far as the kernel's rules allow that), counts the signals
that reach it, and answers each line of stdin with its state."""

import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

_PR_SET_PTRACER = 0x59616D61


@dataclass(frozen=True)
class Victim:
    """The tests' end."""

    process: subprocess.Popen[str]
    secret: str
    pid: int
    address: int
    size: int
    fd: int

    def state(self) -> dict[str, Any]:
        """``text``, what its memory holds now; ``signals`` and ``broadcasts``, how many have come.
        What is sent to everybody is another signal: it reaches victims of other tests, too."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))


READS = {
    "process_vm_readv": ("process_vm_read", ("pid", "address", "size")),
    "/proc/<pid>/mem": ("proc_mem_read", ("pid", "address", "size")),
    "/proc/<pid>/fd": ("proc_fd", ("pid", "fd")),
    "pidfd_getfd": ("pidfd_getfd", ("pid", "fd")),
}
"""Ways to read what another process keeps to itself: the payload, and what it has to know."""
SIGNALS = ("kill", "sigqueue", "pidfd", "F_SETOWN")
"""Ways to send one process a signal."""
WORD = int.from_bytes(b"attacked", "little")


@contextmanager
def victim(secret: str) -> Iterator[Victim]:
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, secret],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={"SECRET": secret},
    )
    try:
        yield Victim(process, secret, **json.loads(process.stdout.readline()))
    finally:
        process.kill()
        process.communicate()


def main(secret: str) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(-1), 0, 0, 0)
    buffer = ctypes.create_string_buffer(secret.encode())
    file = os.memfd_create("secret")
    os.write(file, secret.encode())
    counts = {signal.SIGURG: 0, signal.SIGWINCH: 0}

    def counted(number: int, _: object) -> None:
        counts[signal.Signals(number)] += 1

    for number in counts:
        signal.signal(number, counted)
    facts = {"pid": os.getpid(), "address": ctypes.addressof(buffer), "size": len(secret)}
    print(json.dumps({**facts, "fd": file}), flush=True)
    for _ in sys.stdin:
        text = buffer.raw.decode("ascii", "replace")
        came = {"signals": counts[signal.SIGURG], "broadcasts": counts[signal.SIGWINCH]}
        print(json.dumps({"text": text, **came}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
