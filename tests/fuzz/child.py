"""The process that is lied to: little memory, a watchdog, and a note of what it is being told."""

import gc
import json
import mmap
import pickle
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.transport.values import DescriptionReader
from envhub_worker.protocol import messages as m
from tests.fuzz import bundle
from tests.fuzz.controls import CONTROLS
from tests.fuzz.lane import lane
from tests.fuzz.targets import TARGETS, Dice, NotSentError
from tests.fuzz.traffic import Frames

ALL: dict[str, Callable[[Dice], None]] = {**TARGETS, "lane": lane, "bundles": bundle.bundles}
_MOST_FAILURES = 5
_NOTE_BYTES = 4096


@dataclass
class Tally:
    """What became of one target's lies."""

    ends: Counter[str] = field(default_factory=Counter)
    refusals: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    failures: int = 0


def lie(name: str, number: int, seed: int, corpus: list[Frames], messages: list[m.Message]) -> str:
    """Tell one lie; what came of it. Raises what must not come out."""
    dice = Dice(random.Random(f"{seed}:{name}:{number}"), corpus, messages)
    try:
        (ALL | CONTROLS)[name](dice)
    except NotSentError:
        return "not sent"
    except EnvHubError as error:
        return f"refused {type(error).__name__}"
    return "taken"


def decoded(corpus: list[Frames]) -> list[m.Message]:
    return [m.unpack(frames, things=DescriptionReader) for frames in corpus]


def run(job: dict[str, Any], say: Callable[[str], None], note: Callable[[str], None]) -> int:
    """Tell lies until the job is done; returns how many went wrong."""
    corpus: list[Frames] = pickle.loads(Path(job["corpus"]).read_bytes())
    messages = decoded(corpus)
    tallies = {name: Tally() for name in job["targets"] or ALL}
    for name, number in _examples(job, list(tallies)):
        tally = tallies[name]
        note(f"{name} --only {number}")
        started = time.perf_counter()
        try:
            end = lie(name, number, job["seed"], corpus, messages)
        except Exception:
            end, tally.failures = "FAILED", tally.failures + 1
            say(f"FAILED: {name} --seed {job['seed']} --only {number}\n{traceback.format_exc()}")
        tally.slowest_s = max(tally.slowest_s, time.perf_counter() - started)
        tally.ends[end.partition(" ")[0] if end != "not sent" else end] += 1
        if sum(one.failures for one in tallies.values()) >= _MOST_FAILURES:
            break
    for name, tally in tallies.items():
        ends = ", ".join(f"{count} {end}" for end, count in sorted(tally.ends.items()))
        say(f"{name:14} {sum(tally.ends.values()):8} lies: {ends}; slowest {tally.slowest_s:.2f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    say(f"{len(corpus)} messages of real workers; most memory {peak:.0f} MiB")
    return sum(one.failures for one in tallies.values())


def _examples(job: dict[str, Any], names: list[str]) -> Iterator[tuple[str, int]]:
    if job["only"] is not None:
        yield from ((name, job["only"]) for name in names)
        return
    until, number = time.monotonic() + job["seconds"], 0
    while number < job["examples"] if job["examples"] else time.monotonic() < until:
        yield from ((name, number) for name in names)
        number += 1


def limit(further_bytes: int) -> None:
    """Caps further address space, and ends this process if one lie takes too long."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + further_bytes
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def noting(path: str, patience_s: int) -> Callable[[str], None]:
    """Writes down what is being told, for who finds us dead, and winds up the watchdog."""
    Path(path).write_bytes(bytes(_NOTE_BYTES))
    with open(path, "r+b") as file:
        page = mmap.mmap(file.fileno(), _NOTE_BYTES)

    def note(text: str) -> None:
        page[:64] = text.encode().ljust(64, b"\0")
        signal.alarm(patience_s)

    return note


def main() -> None:
    warnings.simplefilter("ignore")
    job = json.loads(sys.argv[1])
    note = noting(job["note"], job["patience"])
    limit(job["memory"])
    gc.freeze()
    try:
        failures = run(job, lambda text: print(text, flush=True), note)
    finally:
        signal.alarm(0)
        bundle.tidy()
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
