"""Random operations with kills on many environments at once, each result against a model.

    python -m tests.faults.endurance.monkey [--seconds 3600] [--places process tcp]

Each place has a process of its own. In it a monkey opens, resets, steps, asks, kills, lets go and
closes, whichever environment it comes upon; most are in the middle of something. In a fleet it
also kills servers, and starts them again. The model is a
``SyncVectorEnv`` of the same class in the same process, with the same seeds and actions, and knows
which environments may have died. What it does not allow is a mismatch, and is printed.

With everything closed but one new environment, descriptors, memory, threads, processes and files
of the client and of its server are looked at after a tenth of the time and at the end. Prints one
JSON object; exits with 1 after a mismatch, or if something has grown.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from envhub_sandbox import errors, make_env
from tests.faults.endurance import clients
from tests.support import inside
from tests.support.samples import make_env_of, sample

PLACES = ("process", "tcp", "fleet")
NAMES = ("walk", "cartpole")
MIB = 1 << 20
LIVE, SLOW, HANG, EXIT = 0, 4, 5, 6
"""Actions of ``walk``."""
SLOW_S = 0.02
_WARM_UP = 0.1
_SETTLE_S = 60.0
_HANG_S = 300.0
"""An operation that takes longer hangs: it is shown where, and that is the end."""
_REPORT_S = 60
_AMID_S = 0.001
_PATIENCE = 200
"""Operations that an environment may outlive a kill of one of its processes."""
SLACK = {
    "client_descriptors": 4,
    "client_threads": 1,
    "client_mib": 48.0,
    "server_descriptors": 8,
    "server_threads": 1,
    "server_mib": 32.0,
}
"""By how much two looks may differ; all else is to be as it was."""


class Subject:
    """One environment, its model, and what is known of both."""

    def __init__(self, rng: np.random.Generator, sandbox: Any) -> None:
        self.name = str(rng.choice(NAMES))
        folder = sample(self.name)
        self.n_envs = int(rng.integers(1, 5))
        most = 2 if isinstance(sandbox, str) else 3
        self.workers = int(rng.integers(1, min(self.n_envs, most) + 1))
        self.lane = str(rng.choice(["auto", "frames"]))
        policy = {"restart": "on_reset", "restart_budget": 10**9, "restart_backoff_s": 0}
        self.suites = make_env(
            folder,
            n_envs=self.n_envs,
            use_async_envs=bool(rng.integers(2)),
            num_workers=self.workers,
            sandbox=sandbox,
            policy={**policy, "crash_history": 0, **clients.MEMORY, "lane": self.lane},
        )
        self.env = self.suites.env
        self.model = make_env_of(folder)(self.n_envs)
        self.ready = False
        self.pending: Any = None
        self.doubt = 0
        self.others = 0
        """Deaths that a reset may meet after the first: of workers that had answered by then."""

    def doubted(self) -> None:
        self.doubt = self.doubt or 1
        self.others = len(inside.leases(self.env)) - 1

    def lost(self) -> None:
        """What it was in the middle of is gone; a reset brings it back."""
        self.ready, self.pending = False, None


def _servers(subject: Subject) -> list[Any]:
    """Those that it has a jail in."""
    loaded = [one.loaded for one in inside.leases(subject.env)]
    return [one.server for one in loaded if one is not None]


def same(got: Any, expected: Any) -> bool:
    """Whether two steps gave the very same arrays and infos."""
    *arrays, infos = got
    *expected_arrays, expected_infos = expected
    pairs = zip(arrays, expected_arrays, strict=True)
    return (
        all(_equal(a, b) for a, b in pairs)
        and infos.keys() == expected_infos.keys()
        and all(_equal(infos[key], expected_infos[key]) for key in infos)
    )


def _equal(a: Any, b: Any) -> bool:
    return bool(a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b))


class Mismatch(Exception):
    """Something that the model does not allow."""


class Monkey:
    """What does one thing after another, and how often it did."""

    def __init__(
        self, sandbox: Any, environments: int, seed: int, kill_every: int, far: Any = ()
    ) -> None:
        self._sandbox, self._most, self._kill_every = sandbox, environments, kill_every
        self._far = {server.endpoint: server for server in far}
        self._rng = np.random.default_rng(seed)
        self._subjects: list[Subject] = []
        self.counts: Counter[str] = Counter()
        self.mismatches: list[str] = []

    def once(self) -> None:
        self.counts["operations"] += 1
        if not self._subjects or self._rng.random() * 40 * len(self._subjects) < self._most:
            self._open()
            return
        subject = self._subjects[self._rng.integers(len(self._subjects))]
        action = self._chosen(subject)
        self.counts[action.__name__.strip("_")] += 1
        try:
            self._watched(subject, action)
        except Exception as error:  # whatever it is: an hour is not given up for it
            self._note(subject, action, error)

    def _watched(self, subject: Subject, action: Callable[[Subject], None]) -> None:
        try:
            action(subject)
        except errors.WorkerDiedError:
            if not subject.doubt:
                if not subject.others or action != self._reset:
                    raise
                subject.others -= 1
            self.counts["deaths"] += 1
            subject.doubt = 0
            subject.lost()
        else:
            subject.doubt += bool(subject.doubt)
            if subject.doubt > _PATIENCE:
                raise Mismatch("a process of it was killed, and it goes on")

    def _note(self, subject: Subject, action: Callable[..., Any], error: Exception) -> None:
        said = f"{action.__name__} of {subject.name} n={subject.n_envs} workers={subject.workers} "
        self._mismatch(f"{said}{subject.lane} at {self.counts['operations']}: ", error)
        self._subjects.remove(subject)
        with contextlib.suppress(Exception):
            subject.suites.close()

    def _mismatch(self, what: str, error: Exception) -> None:
        self.mismatches.append(what + "".join(traceback.format_exception(error)))
        print(self.mismatches[-1], file=sys.stderr, flush=True)

    def _chosen(self, subject: Subject) -> Callable[[Subject], None]:
        rare = self._rng.random() * self._kill_every < 1
        if subject.pending is not None:
            usual, weights = [self._collect, self._late, self._close], np.array([60, 3, 0.5])
        elif rare:
            usual = [self._kill, self._kill_amid, self._exit, self._hang, self._kill_server]
            weights = np.array([1, 1, 1, 0.2, 0.2])
        elif not subject.ready:
            usual, weights = [self._reset, self._close, self._let_go], np.array([30.0, 1, 1])
        else:
            usual = [self._step, self._steps, self._send, self._reset, self._reset_some]
            usual += [self._ask, self._set, self._close, self._let_go]
            weights = np.array([30, 10, 20, 5, 3, 10, 5, 0.6, 0.4])
        return usual[self._rng.choice(len(usual), p=weights / weights.sum())]

    # --- what it does ----------------------------------------------------------------------

    def _open(self) -> None:
        self.counts["open"] += 1
        if len(self._subjects) >= self._most:
            return
        try:
            self._subjects.append(Subject(self._rng, self._sandbox))
        except errors.EnvHubError as error:
            self._mismatch("open: ", error)

    def _close(self, subject: Subject) -> None:
        self._subjects.remove(subject)
        subject.suites.close()
        if not subject.env.closed:
            raise Mismatch("it is closed, and says that it is not")

    def _let_go(self, subject: Subject) -> None:
        """Nobody holds it any more, and nobody closed it."""
        self._subjects.remove(subject)
        del subject.suites, subject.env

    def _reset(self, subject: Subject) -> None:
        seed = int(self._rng.integers(2**31))
        got = subject.env.reset(seed=seed)
        if not subject.ready:  # it may have found out by itself, and has another jail then
            subject.ready, subject.doubt, subject.others = True, 0, 0
        self._compare(got, subject.model.reset(seed=seed))

    def _reset_some(self, subject: Subject) -> None:
        mask = self._rng.random(subject.n_envs) < 0.5
        mask[self._rng.integers(subject.n_envs)] = True
        seed = int(self._rng.integers(2**31))
        got = subject.env.reset(seed=seed, options={"reset_mask": mask})
        self._compare(got, subject.model.reset(seed=seed, options={"reset_mask": mask}))

    def _step(self, subject: Subject) -> None:
        actions = self._actions(subject)
        got = subject.env.step(actions)
        self._compare(got, subject.model.step(actions))

    def _steps(self, subject: Subject) -> None:
        for _ in range(int(self._rng.integers(2, 30))):
            self.counts["steps in a row"] += 1
            self._step(subject)

    def _send(self, subject: Subject) -> None:
        actions = self._actions(subject)
        subject.env.step_async(actions)
        subject.pending = actions

    def _collect(self, subject: Subject, timeout: float | None = None) -> None:
        got = subject.env.step_wait(timeout=timeout)
        actions, subject.pending = subject.pending, None
        self._compare(got, subject.model.step(actions))

    def _late(self, subject: Subject) -> None:
        """Sooner than it can be; the reply must never be taken for another."""
        try:
            self._collect(subject, float(self._rng.random() * SLOW_S))
        except errors.WorkerTimeoutError:
            self.counts["time-outs"] += 1
            subject.lost()

    def _ask(self, subject: Subject) -> None:
        name = {"walk": "steps", "cartpole": "steps_beyond_terminated"}[subject.name]
        if subject.env.get_attr(name) != subject.model.get_attr(name):
            raise Mismatch(name)

    def _set(self, subject: Subject) -> None:
        """Something that a reset overwrites: what died meanwhile has forgotten all else."""
        if subject.name != "walk":
            return
        name, values = "position", self._rng.random(subject.n_envs).tolist()
        for env in (subject.env, subject.model):
            env.set_attr(name, values)
        if subject.env.get_attr(name) != subject.model.get_attr(name):
            raise Mismatch(name)

    def _kill(self, subject: Subject) -> None:
        pids = self._pids(subject)
        if pids and self._rng.random() < 0.8:
            pids = [int(self._rng.choice(pids))]
        self._end(subject, pids)

    def _kill_amid(self, subject: Subject) -> None:
        """In the middle of a step; asked before it, since a reply must not be taken from it."""
        pids = self._pids(subject)
        if not pids:
            return
        self._send(subject)
        time.sleep(self._rng.random() * _AMID_S)
        self._end(subject, pids)

    def _pids(self, subject: Subject) -> list[int]:
        """None where it has no jail; or where that may have died, which it has not noticed so; or
        where a server is too busy to answer within the second that a status waits for."""
        leases = inside.leases(subject.env) if subject.ready else []
        answers = [one.status() for one in leases if one.loaded]
        found = [pid for answer in answers for pid in answer.get("pids", ())]
        if leases and all(answers) and not found and not subject.doubt:
            raise Mismatch("its processes are not there, and none was killed")
        return found

    def _end(self, subject: Subject, pids: Sequence[int]) -> None:
        if not pids:
            return
        self.counts["killed"] += 1
        subject.doubted()
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _kill_server(self, subject: Subject) -> None:
        """Where it is this process's own: all environments that it serves die with it."""
        servers = _servers(subject) if subject.ready else []
        if not servers:
            return
        server = servers[self._rng.integers(len(servers))]
        far = self._far.get(server.endpoint)
        process = getattr(server, "process", None)
        if far is None and process is None:
            self._kill(subject)
            return
        self.counts["servers killed"] += 1
        for one in self._subjects:
            # one that has no jail has nothing to lose, and need not notice
            if server in _servers(one):
                one.doubted()
        if far is not None:
            far.killed_and_started()
        elif process is not None:
            process.kill()
            process.wait()  # whoever asks next must not be given one that is about to end

    def _exit(self, subject: Subject) -> None:
        self._badly(subject, EXIT, None)

    def _hang(self, subject: Subject) -> None:
        self._badly(subject, HANG, 0.05)

    def _badly(self, subject: Subject, action: int, timeout: float | None) -> None:
        """An action that never returns, wherever an episode is not at its end."""
        if subject.name != "walk" or not subject.ready:
            return
        actions = np.full(subject.n_envs, action)
        subject.env.step_async(actions)
        subject.pending = actions
        try:
            subject.env.step_wait(timeout=timeout)
        except errors.WorkerTimeoutError:
            self.counts["time-outs"] += 1
        except errors.WorkerDiedError:
            self.counts["deaths"] += 1
            subject.doubt = 0
        subject.lost()

    def _actions(self, subject: Subject) -> Any:
        high = {"walk": SLOW, "cartpole": 2}[subject.name]
        actions = self._rng.integers(LIVE, high, subject.n_envs)
        if subject.name == "walk" and self._rng.random() < 0.01:
            actions[0] = SLOW
        return actions

    def _compare(self, got: Any, expected: Any) -> None:
        self.counts["compared"] += 1
        if not same(got, expected):
            raise Mismatch(f"\n{got}\n is not\n{expected}")

    # --- what has grown --------------------------------------------------------------------

    def rest(self) -> None:
        for subject in self._subjects:
            subject.suites.close()
        self._subjects.clear()
        gc.collect()

    def look(self, place: Place, before: Mapping[str, float] | None = None) -> dict[str, float]:
        self.rest()
        subject = Subject(np.random.default_rng(0), self._sandbox)
        with subject.suites:
            subject.env.reset(seed=0)
            end = time.monotonic() + _SETTLE_S
            last: dict[str, float] = {}
            while time.monotonic() < end:
                now = place.footprint(subject)
                same_again = now["processes"] == last.get("processes")
                if same_again and not (before and clients.more(before, now, SLACK)):
                    break
                last = now
                time.sleep(0.5)
        return now


class Place:
    """Where the environments are: what is to be looked at there."""

    def __init__(self, folder: Path, *servers: clients.Server) -> None:
        self._folder, self._server = folder, servers[0] if servers else None
        self.others = servers[1:]
        """Further servers of a fleet, which are killed and started."""

    def sandbox(self) -> Any:
        one = self._server.sandbox() if self._server else "process"
        return [one, *(server.sandbox() for server in self.others)] if self.others else one

    def footprint(self, subject: Subject) -> dict[str, float]:
        """Of this process, and of the server of an environment."""
        gc.collect()
        server = self._server or inside.server(subject.env)
        below = psutil.Process(server.process.pid)
        found: dict[str, float] = {
            "processes": len(below.children(recursive=True)),
            "children": len(psutil.Process().children()),
            "files": clients.entries(self._folder),
        }
        for name, process in (("client", psutil.Process()), ("server", below)):
            found[f"{name}_descriptors"] = process.num_fds()
            found[f"{name}_threads"] = process.num_threads()
            found[f"{name}_mib"] = round(process.memory_full_info().uss / MIB, 1)
        return found


@contextlib.contextmanager
def _place(name: str) -> Iterator[Place]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="monkey-")))
        folder.chmod(0o711)  # a jail has another user where this one is root
        servers = []
        for one in {"tcp": ("alone",), "fleet": ("stays", "a", "b")}.get(name, ()):
            (folder / one).mkdir()
            servers.append(stack.enter_context(clients.serving(folder / one)))
        if not servers:  # of this process, which was started for it alone
            os.environ["TMPDIR"], tempfile.tempdir = str(folder), str(folder)
        yield Place(servers[0].place if servers else folder, *servers)


def run(arguments: argparse.Namespace, name: str) -> dict[str, Any]:
    begun = time.monotonic()
    with _place(name) as place:
        sandbox, many = place.sandbox(), arguments.environments
        monkey = Monkey(sandbox, many, arguments.seed, arguments.kill_every, place.others)
        _play(monkey, arguments, begun, _WARM_UP)
        before = monkey.look(place)
        _play(monkey, arguments, begun, 1)
        after = monkey.look(place, before)
    return {
        "seconds": round(time.monotonic() - begun),
        **{name: monkey.counts[name] for name in sorted(monkey.counts)},
        "mismatches": monkey.mismatches,
        "after_a_tenth": before,
        "at_the_end": after,
        "grown": clients.more(before, after, SLACK),
    }


def _has_done(monkey: Monkey, least: float, died: bool) -> bool:
    """Whether it has done as much, and met a death: how soon one shows is up to the machine."""
    counts = monkey.counts
    return counts["operations"] >= least and bool(not died or counts["deaths"] * counts["compared"])


def _play(monkey: Monkey, arguments: argparse.Namespace, begun: float, part: float) -> None:
    told, end = time.monotonic(), begun + arguments.seconds * part
    least = arguments.operations * part or float("inf")
    while (now := time.monotonic()) < end and not _has_done(monkey, least, part == 1):
        faulthandler.dump_traceback_later(_HANG_S, exit=True)
        monkey.once()
        if now > told + _REPORT_S:
            told = now
            size = psutil.Process().memory_full_info().uss / MIB
            said = f"{len(monkey.mismatches)} mismatches, {size:.0f} MiB: {dict(monkey.counts)}"
            print(said, file=sys.stderr, flush=True)
    faulthandler.cancel_dump_traceback_later()


def main(argv: Sequence[str] | None = None) -> int:
    """Play where the arguments say; 0 if nothing differs and nothing has grown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600)
    text = "at least, and until a process has died; 0: as long as the seconds last"
    parser.add_argument("--operations", type=int, default=0, help=text)
    parser.add_argument("--places", nargs="+", choices=PLACES, default=PLACES)
    parser.add_argument("--environments", type=int, default=12, help="at most, at one time")
    parser.add_argument("--kill-every", type=int, default=100, help="operations, about")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", choices=PLACES, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one:
        print(json.dumps(run(arguments, arguments.one)))
        return 0
    found = _all(arguments, list(sys.argv[1:] if argv is None else argv))
    print(json.dumps(found, indent=1))
    return 0 if all(map(passed, found.values())) else 1


def passed(found: Mapping[str, Any]) -> bool:
    return not found["mismatches"] and not found["grown"]


def _all(arguments: argparse.Namespace, words: list[str]) -> dict[str, Any]:
    """All places at once, each in a process of its own."""
    command = [sys.executable, "-m", "tests.faults.endurance.monkey", *words, "--one"]
    with contextlib.ExitStack() as stack:
        playing = {
            place: stack.enter_context(
                subprocess.Popen([*command, place], stdout=subprocess.PIPE, text=True)
            )
            for place in arguments.places
        }
        return {place: json.loads(one.communicate()[0]) for place, one in playing.items()}


if __name__ == "__main__":
    sys.exit(main())
