"""Packages for clients' repositories, if the operator permits them (``--dependencies``).

Another program makes them: the client package, which the operator has installed beside this one. It
chooses versions, installs wheels by their hashes without running their code, and reports its
result. Each client key has its own folder and at most one running program; all keys together have a
few. The server cancels an order that its client no longer asks for, and one that takes too long, so
that it does not delay the others.
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
from collections import OrderedDict, defaultdict, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
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
"""Most unfinished orders of one key."""
MAX_IN_LINE = 64
"""Most unfinished orders of all keys."""
MAX_AT_WORK = 4
"""Most programs at once; one key has one at a time."""
MAKE_S = 1800.0
"""Most seconds that one program may run."""
MAX_PER_HOUR = 60
"""Most programs of one key in an hour: each asks the package index."""
_REMEMBERED = 512
_HOUR_S = 3600.0
_FORGOTTEN_S = 60.0
"""An order is given up after so long without a request for it."""
_FAILED_S = 30.0
"""How long a failed order is not tried again."""
_HANDED_S = 600.0
_RETRY_S = 10.0
_STOP_S = 30.0
_RESULT_BYTES = 1 << 20
_CHECK_S = 60.0

OrderId = tuple[str, str]
"""The name of the client's folder, and the hash of what it asks for."""
News = tuple[bytes, float, Mapping[str, Any]]
"""For the log: whose session ordered first, how long the program took, its result."""


class PackageProgram:
    """The program while it makes one order.
    ``ended_at``: the time of the request to end it; None before.
    """

    def __init__(self, request: Mapping[str, Any]) -> None:
        self.since = monotonic()
        self.ended_at: float | None = None
        with contextlib.ExitStack() as undo:
            self._output = undo.enter_context(tempfile.TemporaryFile())
            with tempfile.TemporaryFile() as stdin:
                stdin.write(json.dumps(request).encode())
                stdin.seek(0)
                ourselves = os.pidfd_open(os.getpid())  # it ends when we do, whatever ends us
                try:
                    self._process = subprocess.Popen(
                        [*command(), f"--server-pidfd={ourselves}"],
                        stdin=stdin,
                        stdout=self._output,
                        cwd="/",
                        start_new_session=True,
                        pass_fds=(ourselves,),
                    )
                finally:
                    os.close(ourselves)
            undo.pop_all()  # the output lasts as long as the program

    def output(self) -> Mapping[str, Any]:
        """Returns the program's last complete output; nothing while it writes."""
        try:
            document = json.loads(os.pread(self._output.fileno(), _RESULT_BYTES, 0))
            return document if isinstance(document, dict) else {}
        except ValueError:
            return {}

    @property
    def code(self) -> int | None:
        """The exit code; None while the program runs."""
        return self._process.poll()

    def terminate(self, now: float) -> None:
        """Ask the program to end."""
        self._process.terminate()
        self.ended_at = now

    def kill(self, patience_s: float = 0.0) -> None:
        """Wait for the program's end, then kill it with the processes that it started."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """Close the program's output, after its end."""
        self._output.close()


@dataclass
class Order:
    """An order for packages, from its first request until it is forgotten.

    Attributes:
        asked: The time of the last request for it.
        program: The running program, or None. An order without program and result waits.
        result: The program's last output, and the time of it.
    """

    plain: dict[str, Any]
    owner: bytes
    asked: float = field(default_factory=monotonic)
    progress: str = "at work"
    program: PackageProgram | None = None
    result: tuple[Mapping[str, Any], float] | None = None


def command() -> list[str]:
    """Returns the command line of the program, with our own interpreter."""
    return [sys.executable, "-I", "-m", PROGRAM]


def why_impossible() -> str:
    """Returns why the program cannot run here; empty if it can."""
    try:
        done = subprocess.run(
            [*command(), "check"], stdin=subprocess.DEVNULL, capture_output=True, timeout=_CHECK_S
        )
    except subprocess.TimeoutExpired:
        return f"the program that makes packages did not answer in {_CHECK_S:.0f} s"
    if done.returncode == 0:
        return ""
    lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no word"]
    return (
        "packages are installed by envhub-sandbox, which does not work in this worker's "
        f"interpreter ({sys.executable}): {lines[-1][:500]}. Run: {sys.executable} -m pip install "
        "envhub-sandbox"
    )


class Packages:
    """The packages of all clients.
    ``shared``: other servers of this machine use the folder, too, and all clients are one user's.
    """

    def __init__(
        self, folder: Path | None, quotas: Quotas, make_s: float = MAKE_S, *, shared: bool = False
    ) -> None:
        self._folder, self._quotas = folder, quotas
        self._make_s, self._shared = make_s, shared
        self._orders: OrderedDict[OrderId, Order] = OrderedDict()
        self._handed: dict[OrderId, tuple[Runtime, float]] = {}
        self._begun: defaultdict[str, deque[float]] = defaultdict(
            partial(deque, maxlen=MAX_PER_HOUR)
        )
        self._news: list[News] = []
        if folder is not None:
            make_passable(folder)

    def need(
        self, key: bytes, request: m.NeedPackages, in_use: Collection[str], owner: bytes = b""
    ) -> m.Packages:
        """Starts or continues an order; returns its progress.

        ``in_use``: folders of packages that must stay. Trust: the request is a client's.
        Raises ``RefusedError``: the packages cannot be made, or not now.
        """
        if self._folder is None:
            if not request.always:
                return m.Packages(
                    "own", "", {}, "this server makes no environments (--dependencies)"
                )
            raise RefusedError(
                "PolicyError",
                "dependencies: this server installs no packages; start it with --dependencies, or "
                "in an interpreter that has them",
            )
        plain = checked(request)
        home = self._home(key)
        order_id = home, hashlib.sha256(json.dumps(plain).encode()).hexdigest()
        self.look(in_use)
        reply = self._reply(order_id)
        if reply is None and order_id not in self._orders:
            self._check_room(home)
            self._orders[order_id] = Order(plain, owner)
            self.look(in_use)
            reply = self._reply(order_id)
        if reply is not None:
            return reply
        order = self._orders[order_id]
        order.asked = monotonic()
        progress = order.progress if order.program is not None else self._why_waiting(order_id)
        return m.Packages("making", "", {}, progress)

    def runtime(self, key: bytes, name: str) -> Runtime:
        """Returns a client's packages and their interpreter. Raises ``RefusedError``."""
        runtime, _ = self._handed.get((self._home(key), name), (None, 0.0))
        if runtime is None or not os.path.isdir(runtime.packages):
            raise RefusedError(
                "WorkerError", "this server has no such packages; ask for them first"
            )
        return runtime

    def _home(self, key: bytes) -> str:
        return SHARED if self._shared else key.hex()[:32] or "local"

    def look(self, in_use: Collection[str]) -> None:
        """Take results, cancel orders that nobody asks for, and start the next programs."""
        now = monotonic()
        for order_id, order in list(self._orders.items()):
            if order.program is not None:
                self._follow(order_id, order, order.program, now)
            elif order.result is None and now - order.asked > _FORGOTTEN_S:
                del self._orders[order_id]
        for order_id in self._waiting():
            running = self._running()
            if len(running) < MAX_AT_WORK and order_id[0] not in running:
                self._begin(order_id, in_use)

    def news(self) -> list[News]:
        """Returns the orders that have ended since the last call."""
        news, self._news = self._news, []
        return news

    def close(self) -> None:
        """End the programs; later programs remove unfinished packages."""
        programs = list(self._running().values())
        self._orders.clear()
        now = monotonic()
        for program in programs:
            program.terminate(now)
        until = now + _STOP_S
        for program in programs:
            program.kill(max(0.0, until - monotonic()))

    # --- orders --------------------------------------------------------------------------------

    def _reply(self, order_id: OrderId) -> m.Packages | None:
        """Returns the answer to an order; None without a result that still holds."""
        order = self._orders.get(order_id)
        if order is None or order.result is None:
            return None
        result, when = order.result
        if "own" in result:
            return m.Packages("own", "", {}, "this server's interpreter has all of it")
        environment = result.get("made")
        if environment is not None and os.path.isdir(environment["packages"]):
            name, folder = environment["name"], environment["packages"]
            self._handed[order_id[0], name] = Runtime(environment["python"], folder), monotonic()
            with contextlib.suppress(OSError):
                os.utime(Path(folder).with_name("environment.json"))
            return m.Packages("made", name, environment["facts"], "")
        if environment is None and monotonic() - when < _FAILED_S:
            raise RefusedError("DependencyError", str(result["said"]), missing=str(result["error"]))
        del self._orders[order_id]
        return None

    def _check_room(self, home: str) -> None:
        unfinished = [names for (names, _), order in self._orders.items() if order.result is None]
        hour = self._begun[home]
        while hour and monotonic() - hour[0] > _HOUR_S:
            hour.popleft()
        yours = "orders of your key for packages"
        for used, limit, text in (
            (unfinished.count(home), MAX_WAITING, f"{yours} wait already"),
            (len(hour), MAX_PER_HOUR, f"{yours} were begun in the last hour"),
            (len(unfinished), MAX_IN_LINE, "orders for packages wait already"),
        ):
            if used >= limit:
                busy = Busy("packages", used, limit, _RETRY_S)
                raise BusyError(busy, f"packages: {used} {text}, and the server takes {limit}")

    # --- the program ---------------------------------------------------------------------------

    def _running(self) -> dict[str, PackageProgram]:
        """Returns the running programs by the folder of their key: each key has one at most."""
        orders = self._orders.items()
        return {home: order.program for (home, _), order in orders if order.program is not None}

    def _waiting(self) -> list[OrderId]:
        """Returns waiting orders in turn: first that of the key that has waited longest."""
        orders = self._orders.items()
        waiting = [name for name, order in orders if order.program is None and order.result is None]
        begun = {name: max(self._begun[name[0]], default=0.0) for name in waiting}
        return sorted(waiting, key=begun.__getitem__)

    def _why_waiting(self, order_id: OrderId) -> str:
        """Returns the progress of a waiting order, with no more than the number of the others."""
        running = self._running()
        if order_id[0] in running:
            return "waiting for other packages of your key"
        before = self._waiting().index(order_id)
        return f"waiting for others' packages: {before} before it, {len(running)} at work"

    def _begin(self, order_id: OrderId, in_use: Collection[str]) -> None:
        assert self._folder is not None
        now, home, order = monotonic(), order_id[0], self._orders[order_id]
        folder = self._folder / home
        self._handed = {
            handed: (runtime, when)
            for handed, (runtime, when) in self._handed.items()
            if runtime.packages in in_use or now - when < _HANDED_S
        }
        request = order.plain | {
            "folder": str(folder.absolute()),
            "bytes": self._quotas.packages_bytes,
            "keep": [name for owner, name in self._handed if owner == home],
        }
        self._begun[home].append(now)
        try:
            make_passable(folder)
            order.program = PackageProgram(request)
        except OSError as error:  # a full disk, no process left: the client reads it, once
            text = f"the program that makes packages cannot be started: {error.strerror}"
            self._end(order_id, {"error": "other", "said": text}, now)

    def _follow(self, order_id: OrderId, order: Order, program: PackageProgram, now: float) -> None:
        output, code = program.output(), program.code
        if code is None:
            order.progress = str(output.get("progress", order.progress))
            late = now - program.since > self._make_s
            if program.ended_at is None and (late or now - order.asked > _FORGOTTEN_S):
                program.terminate(now)
            elif program.ended_at is not None and now - program.ended_at > _STOP_S:
                program.kill()
            return
        program.close()
        if program.ended_at is not None:
            text = (
                f"they were not installed in time: the server permits {self._make_s:.0f} s "
                "(--packages-s)"
            )
            output = {"error": "index", "said": text}
        elif not output.keys() & {"own", "made", "error"}:
            text = f"the program that makes packages ended with {code}; its server's log says why"
            output = {"error": "other", "said": text}
        self._end(order_id, output, program.since)

    def _end(self, order_id: OrderId, result: Mapping[str, Any], since: float) -> None:
        now, order = monotonic(), self._orders[order_id]
        order.program, order.result = None, (result, now)
        self._news.append((order.owner, now - since, result))
        self._orders.move_to_end(order_id)
        finished = [name for name, other in self._orders.items() if other.result is not None]
        for oldest in finished[:-_REMEMBERED]:
            del self._orders[oldest]


def checked(request: m.NeedPackages) -> dict[str, Any]:
    """Checks the types and bounds of an order's values; the program checks their meaning.

    Trust: input from a client.
    Raises ``RefusedError``: the value is no order.
    """
    rows: dict[str, tuple[tuple[Any, ...], int]] = {
        "requirements": (request.requirements, 2),
        "guesses": (request.guesses, 4),
        "constraints": (request.constraints, 2),
        "override": (request.override, 2),
        "without": (tuple((name,) for name in request.without), 1),
    }
    good = all(_are_texts(texts, width) for texts, width in rows.values())
    if not good or max(map(len, (request.supports, request.python, request.exclude_newer))) > (
        MAX_TEXT
    ):
        raise RefusedError(
            "LocalProtocolError",
            f"an order has at most {MAX_REQUIREMENTS} rows of texts of {MAX_TEXT} characters",
        )
    return {
        **{name: [list(row) for row in texts] for name, (texts, _) in rows.items()},
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
