"""Clients that are ended while their server starts, at a moment of one's choice.

``python -m tests.faults.remains.starts --rounds 200 --seed 1`` ends as many at random times, and
says what was left; the tests end a handful, at moments that they wait for.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from envhub_sandbox.sandboxes.process import stale_folders
from tests.faults.remains.clients import finish, left, line, start
from tests.faults.remains.traces import Traces, temporary_root
from tests.support.processes import eventually

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
_HALTED = """
import subprocess, tempfile

def halting(owner, name, when):
    whole = getattr(owner, name)

    def halted(*arguments, **options):
        if not {{"serve", "envhub-"}} & {{*(arguments or [()])[0], options.get("prefix")}}:
            return whole(*arguments, **options)  # git's, and the store's
        result = whole(*arguments, **options) if when == "after" else None
        say(getattr(result, "pid", 0))
        time.sleep(600)

    setattr(owner, name, halted)

halting({owner}, {name!r}, {when!r})
made()
"""


def halted(folder: Path, when: str, what: str) -> tuple[subprocess.Popen[str], int]:
    """A client that waits before or after it does something for its server; that one's pid."""
    owner, _, name = what.rpartition(".")
    client = start(folder, _HALTED.format(owner=owner, name=name, when=when))
    return client, int(line(client))


def age(folder: Path) -> None:
    """Make what is below a folder look as if it had been there for an hour."""
    for path in folder.iterdir():
        os.utime(path, (time.time() - 3600,) * 2)


def is_removed_by_the_next(folder: Path) -> bool:
    """Whether the next client removes what is there, and nothing is left of that one."""
    finish(start(folder, "made().close()"))
    return eventually(lambda: not left(folder))


def _round(folder: Path, chooser: random.Random) -> str:
    """What is left of one client, before and after the next one."""
    client, number = start(folder, "made()"), chooser.choice(SIGNALS)
    time.sleep(chooser.uniform(0.1, 1.5))
    client.send_signal(number)
    finish(client)
    eventually(lambda: not Traces.of(folder).processes)
    eventually(lambda: not left(folder), 5.0)
    before = left(folder)
    age(folder)
    found = list(stale_folders(folder))
    clean = is_removed_by_the_next(folder)
    return "" if not before else f"{number.name}: {before}, gc would find {found}, clean {clean}"


def main() -> int:
    """End clients at random times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chooser, dirty = random.Random(arguments.seed), 0
    with temporary_root() as folder:
        for number in range(arguments.rounds):
            said = _round(folder, chooser)
            if said:
                dirty += 1
                print(f"{number}: {said}", flush=True)
        print(f"{arguments.rounds} clients, {dirty} left something, {len(left(folder))} there now")
        return int(bool(left(folder)))


if __name__ == "__main__":
    sys.exit(main())
