"""Packages that clients' repositories need, where the operator permits that (``--dependencies``).

They are made by another program: the client's own, which the operator has installed beside this
one, with its bounds. It chooses versions, installs wheels by their hashes, runs nothing of them,
and says what it did. Each client key has a folder of its own and one program at work at a time, all
keys together a few; an order that is not asked for any more is given up, and so is one that takes
too long: it delays the others only so far.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections import OrderedDict, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from envhub_worker.extras.access.quotas import BusyError, Quotas
from envhub_worker.extras.access.store.blob_store import SHARED, make_passable
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.server import Busy
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.supervisor.records import RefusedError

PROGRAM = "envhub_sandbox.extras.packages.for_a_server"
MAX_REQUIREMENTS = 1000
MAX_TEXT = 2000
MAX_WAITING = 2
"""Orders of one key that wait or are at work."""
MAX_IN_LINE = 64
"""Of all keys."""
MAX_AT_WORK = 4
"""Programs at once; of one key there is one."""
MAKE_S = 1800.0
"""For so long one may be at work."""
MAX_PER_HOUR = 60
"""Of one key: each asks the index."""
_REMEMBERED = 512
_HOUR_S = 3600.0
_FORGOTTEN_S = 60.0
"""An order that was not asked for in so long is given up."""
_FAILED_S = 30.0
"""For so long an order that failed is not tried again."""
_HANDED_S = 600.0
_RETRY_S = 10.0
_STOP_S = 30.0
_RESULT_BYTES = 1 << 20
_CHECK_S = 60.0

Place = tuple[str, str]
"""Whose an order is, and its hash."""


@dataclass
class Order:
    """An order that a client waits for: when it was asked for last, what the program said last."""

    plain: dict[str, Any]
    owner: bytes = b""
    asked: float = field(default_factory=monotonic)
    progress: str = "at work"


Outcome = tuple[Mapping[str, Any], float]
"""What became of an order: the program's own words, and when."""
News = tuple[bytes, float, Mapping[str, Any]]
"""For the log: whose session ordered first, how long the program took, its last words."""


class PackageProgram:
    """The program, at work on one order.

    Attributes:
        place: Whose the order is, and its hash.
        ended_at: When it was asked to end; None before.
    """

    def __init__(self, place: Place, order: Mapping[str, Any]) -> None:
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


class Packages:
    """The packages of all clients.
    ``shared``: other servers of this machine use the folder, too, and all clients are one user's.
    """

    def __init__(
        self, folder: Path | None, quotas: Quotas, make_s: float = MAKE_S, *, shared: bool = False
    ) -> None:
        self._folder = folder
        self._shared = shared
        self._quotas = quotas
        self._make_s = make_s
        self._line: OrderedDict[Place, Order] = OrderedDict()
        self._outcomes: OrderedDict[Place, Outcome] = OrderedDict()
        self._handed: dict[Place, tuple[Runtime, float]] = {}
        self._begun: dict[str, deque[float]] = {}
        self._at_work: dict[str, PackageProgram] = {}  # by key
        self._news: list[News] = []
        if folder is not None:
            make_passable(folder)

    def need(
        self, key: bytes, request: m.NeedPackages, in_use: Collection[str], owner: bytes = b""
    ) -> m.Packages:
        """How far they are; begins, or goes on, to make them.

        ``in_use``: folders of packages that must stay. Trust: the request is a client's.
        Raises ``RefusedError``: they cannot be made, or not now.
        """
        if self._folder is None:
            return _not_here(request)
        plain = checked(request)
        home = self._home(key)
        place = home, hashlib.sha256(json.dumps(plain).encode()).hexdigest()
        self.look(in_use)
        found = self._outcomes.get(place)
        if found is not None:
            reply = self._answer(place, found)
            if reply is not None:
                return reply
        order = self._line.get(place)
        if order is None:
            order = self._take(place, plain)
            order.owner = owner
            self.look(in_use)
            if place in self._outcomes:
                return self.need(key, request, in_use, owner)
        order.asked = monotonic()
        progress = order.progress if self._is_at(place) else self._waits(place)
        return m.Packages("making", "", {}, progress)

    def runtime(self, key: bytes, name: str) -> Runtime:
        """What a client's packages are, and their interpreter. Raises ``RefusedError``."""
        found = self._handed.get((self._home(key), name))
        if found is None or not os.path.isdir(found[0].packages):
            raise RefusedError(
                "WorkerError", "this server has no such packages; ask for them first"
            )
        return found[0]

    def _home(self, key: bytes) -> str:
        return SHARED if self._shared else key.hex()[:32] or "local"

    def look(self, in_use: Collection[str]) -> None:
        """Take what is done, give up what is not asked for, and begin the next."""
        now = monotonic()
        for work in list(self._at_work.values()):
            self._follow(work, now)
        deserted = [
            place
            for place, order in self._line.items()
            if now - order.asked > _FORGOTTEN_S and not self._is_at(place)
        ]
        for place in deserted:
            del self._line[place]
        for place in self._next():
            if len(self._at_work) < MAX_AT_WORK and place[0] not in self._at_work:
                self._begin(place, in_use)

    def news(self) -> list[News]:
        """What became of orders since this was asked last."""
        news, self._news = self._news, []
        return news

    def close(self) -> None:
        """End the programs; they leave nothing half-made, or the next ones remove it."""
        works, self._at_work = list(self._at_work.values()), {}
        now = monotonic()
        for work in works:
            work.terminate(now)
        until = now + _STOP_S
        for work in works:
            work.kill(max(0.0, until - monotonic()))

    # --- orders --------------------------------------------------------------------------------

    def _answer(self, place: Place, found: Outcome) -> m.Packages | None:
        said, when = found
        if "own" in said:
            return m.Packages("own", "", {}, "this server's interpreter has all of it")
        made = said.get("made")
        if made is not None and os.path.isdir(made["packages"]):
            home, name = place[0], made["name"]
            self._handed[home, name] = Runtime(made["python"], made["packages"]), monotonic()
            with contextlib.suppress(OSError):
                os.utime(Path(made["packages"]).with_name("environment.json"))
            return m.Packages("made", name, made["facts"], "")
        if made is None and monotonic() - when < _FAILED_S:
            raise RefusedError("DependencyError", str(said["said"]), missing=str(said["error"]))
        del self._outcomes[place]
        return None

    def _take(self, place: Place, plain: dict[str, Any]) -> Order:
        mine = sum(1 for home, _ in self._line if home == place[0])
        hour = self._begun.setdefault(place[0], deque(maxlen=MAX_PER_HOUR))
        while hour and monotonic() - hour[0] > _HOUR_S:
            hour.popleft()
        yours = "orders of your key for packages"
        for used, limit, what in (
            (mine, MAX_WAITING, f"{yours} wait already"),
            (len(hour), MAX_PER_HOUR, f"{yours} were begun in the last hour"),
            (len(self._line), MAX_IN_LINE, "orders for packages wait already"),
        ):
            if used >= limit:
                busy = Busy("packages", used, limit, _RETRY_S)
                raise BusyError(busy, f"packages: {used} {what}, and the server takes {limit}")
        self._line[place] = order = Order(plain)
        return order

    # --- the program ---------------------------------------------------------------------------

    def _next(self) -> list[Place]:
        """Who waits, in turn: first the key for which nothing was begun for longest."""
        waiting = [place for place in self._line if not self._is_at(place)]
        return sorted(waiting, key=lambda place: (self._begun.get(place[0]) or [0.0])[-1])

    def _waits(self, place: Place) -> str:
        """The progress of an order that waits. Of others it says only how many there are."""
        if place[0] in self._at_work:
            return "waiting for other packages of your key"
        before = self._next().index(place)
        return f"waiting for others' packages: {before} before it, {len(self._at_work)} at work"

    def _is_at(self, place: Place) -> bool:
        work = self._at_work.get(place[0])
        return work is not None and work.place == place

    def _begin(self, place: Place, in_use: Collection[str]) -> None:
        assert self._folder is not None
        folder = self._folder / place[0]
        now = monotonic()
        self._handed = {
            at: (runtime, when)
            for at, (runtime, when) in self._handed.items()
            if runtime.packages in in_use or now - when < _HANDED_S
        }
        keep = [name for home, name in self._handed if home == place[0]]
        order = self._line[place].plain | {
            "folder": str(folder.absolute()),
            "bytes": self._quotas.packages_bytes,
            "keep": keep,
        }
        self._begun.setdefault(place[0], deque(maxlen=MAX_PER_HOUR)).append(now)
        try:
            make_passable(folder)
            self._at_work[place[0]] = PackageProgram(place, order)
        except OSError as error:  # a full disk, no process left: the client reads it, once
            text = f"the program that makes packages cannot be started: {error.strerror}"
            self._end(place, {"error": "other", "said": text}, now)

    def _follow(self, work: PackageProgram, now: float) -> None:
        order = self._line[work.place]
        said, code = work.said(), work.code
        if code is None:
            order.progress = str(said.get("progress", order.progress))
            late = now - work.since > self._make_s
            if work.ended_at is None and (late or now - order.asked > _FORGOTTEN_S):
                work.terminate(now)
            elif work.ended_at is not None and now - work.ended_at > _STOP_S:
                work.kill()
            return
        del self._at_work[work.place[0]]
        work.close()
        if work.ended_at is not None:
            text = (
                f"they were not installed in time: the server permits {self._make_s:.0f} s "
                "(--packages-s)"
            )
            said = {"error": "index", "said": text}
        elif not said.keys() & {"own", "made", "error"}:
            text = f"the program that makes packages ended with {code}; its server's log says why"
            said = {"error": "other", "said": text}
        self._end(work.place, said, work.since)

    def _end(self, place: Place, said: Mapping[str, Any], since: float) -> None:
        now = monotonic()
        order = self._line.pop(place)
        self._outcomes[place] = said, now
        self._news.append((order.owner, now - since, said))
        while len(self._outcomes) > _REMEMBERED:
            self._outcomes.popitem(last=False)


def checked(request: m.NeedPackages) -> dict[str, Any]:
    """An order as plain values, within bounds; what they mean, the program looks at.

    Trust: input from a client.
    Raises ``RefusedError``: it is none.
    """
    rows: dict[str, tuple[tuple[Any, ...], int]] = {
        "requirements": (request.requirements, 2),
        "guesses": (request.guesses, 4),
        "constraints": (request.constraints, 2),
        "override": (request.override, 2),
        "without": (tuple((name,) for name in request.without), 1),
    }
    good = all(_are_texts(given, width) for given, width in rows.values())
    if not good or max(map(len, (request.supports, request.python, request.exclude_newer))) > (
        MAX_TEXT
    ):
        raise RefusedError(
            "LocalProtocolError",
            f"an order has at most {MAX_REQUIREMENTS} rows of texts of {MAX_TEXT} characters",
        )
    return {
        **{name: [list(row) for row in given] for name, (given, _) in rows.items()},
        "supports": request.supports,
        "python": request.python,
        "exclude_newer": request.exclude_newer,
        "always": request.always,
        "gpu": request.gpu,
    }


def _are_texts(rows: tuple[Any, ...], width: int) -> bool:
    return len(rows) <= MAX_REQUIREMENTS and all(
        type(row) is tuple
        and len(row) == width
        and all(type(text) is str and len(text) <= MAX_TEXT for text in row)
        for row in rows
    )


def _not_here(request: m.NeedPackages) -> m.Packages:
    if request.always:
        raise RefusedError(
            "PolicyError",
            "dependencies: this server installs no packages; start it with --dependencies, or in "
            "an interpreter that has them",
        )
    return m.Packages("own", "", {}, "this server makes no environments (--dependencies)")
