"""Asks a repository every question of the table, and runs it in the sandbox for that.

What it answers is hostile: a report says what was seen from outside, and a check passes because
our own comparison found nothing, never because the repository says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from gymnasium.error import CustomSpaceError

from envhub_sandbox import __version__
from envhub_sandbox.api import make_env
from envhub_sandbox.check.checks import CHECKS
from envhub_sandbox.check.findings import Report
from envhub_sandbox.check.play import denials
from envhub_sandbox.check.play.confinement import walls
from envhub_sandbox.check.play.task import Asked, TaskJudge
from envhub_sandbox.check.static.survey import survey
from envhub_sandbox.check.static.undeclared import undeclared
from envhub_sandbox.dependencies.declared import declared
from envhub_sandbox.dependencies.pipeline import packages_for
from envhub_sandbox.dependencies.request import chosen
from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    LoadError,
    ObservationError,
    PackageIntegrityError,
    RemoteEnvError,
    RemoteProtocolError,
    RequirementError,
    ResolutionError,
    SandboxUnavailableError,
    SnapshotError,
    WorkerDiedError,
    WorkerTimeoutError,
)
from envhub_sandbox.hub.snapshot import Snapshot, named
from envhub_sandbox.policy import policy_from
from envhub_sandbox.session.recipe import pinned
from envhub_sandbox.sources import imports, parsing
from envhub_sandbox.vector.suites import EnvSuites
from envhub_worker.protocol.text import size_text

_ITS_FAULT = (
    *(LoadError, DependencyError, RemoteEnvError, RemoteProtocolError),
    *(WorkerDiedError, WorkerTimeoutError),
)
"""Where it does not load: what the repository is to blame for."""


__all__ = ["Asked", "judge"]


class _StoppedError(Exception):
    """Nothing more can be asked of this task, or of the repository."""


def judge(asked: Asked, report: Report | None = None) -> Report:
    """Judge a repository.

    Args:
        asked: What is judged, and how.
        report: Takes what is found as it is found, so that an interrupt loses none of it.

    Raises:
        EnvHubError: It could not be judged: it could not be had, this host cannot confine it, or
            a server is full. What the repository itself does wrong is a finding.
    """
    asked.tell(f"reading {asked.reference}")
    where = {name: asked.arguments.get(name) for name in ("hub_cache_dir", "token", "endpoint")}
    snapshot = named(asked.reference, **where)
    report = Report(asked.reference) if report is None else report
    report.reference, report.commit = pinned(snapshot), snapshot.commit
    report.asked = _told(asked)
    _Judge(asked, snapshot, report).ask()
    report.judged("deadline", [])
    return report


def _told(asked: Asked) -> dict[str, str]:
    """How it is judged, for who reads of it later: in the caller's words and ours."""
    policy = policy_from(asked.arguments.get("policy"), asked.arguments.get("limits"))
    limits = (_limit(name, value) for name, value in vars(policy.limits).items() if value)
    return {
        "judged at": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "by": f"envhub-sandbox {__version__}",
        "sandbox": str(asked.arguments.get("sandbox", "process")),
        "profile": policy.profile,
        "network": policy.network,
        "limits": ", ".join(limits),
        "plays": f"{asked.steps} steps each, seed {asked.seed}, {asked.resets} resets a round",
    }


def _limit(name: str, value: int) -> str:
    words = name.replace("_", " ")
    if name.endswith("_bytes"):
        return f"{words.removesuffix(' bytes')} {size_text(value)}"
    return f"{words} {value:,}"


def _cause(error: EnvHubError) -> str:
    """What an error is about, as ``CURES`` names it. Trust: the worker's word."""
    if isinstance(error, WorkerDiedError):
        return error.reason
    if isinstance(error, WorkerTimeoutError):
        return "timeout"
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    return remote.type_name.rpartition(".")[2] if isinstance(remote, RemoteEnvError) else ""


class _Judge:
    def __init__(self, asked: Asked, snapshot: Snapshot, report: Report) -> None:
        self._asked, self._snapshot, self._report = asked, snapshot, report
        self._files = parsing.read(snapshot)
        self._unrecorded = ""

    def ask(self) -> None:
        self._read()
        try:
            self._resolve()
            self._load()
        except _StoppedError:
            return

    def _read(self) -> None:
        is_moving = self._snapshot.repo_type != "local" and (
            self._snapshot.commit not in self._asked.reference
        )
        moving = [f"{self._asked.reference} may mean another commit tomorrow"] if is_moving else []
        self._report.judged("pinned", moving)
        found = survey(self._snapshot, self._files).findings
        for finding in found:
            self._report.add(finding)
        read = [check for check in CHECKS if check.startswith(("licence", "card", "source-"))]
        for check in set(read) - {one.id for one in found}:
            self._report.judged(check, [])

    def _resolve(self) -> None:
        self._asked.tell("reading and installing what it declares")
        packages, wanted, taken = None, {}, dict[str, str]()
        try:
            choice, _ = chosen(self._asked.arguments.get("dependencies", "auto"), None)
            says = declared(self._snapshot.root, self._snapshot.path)
            wanted = (
                {}
                if says is None
                else {one.requirement.name: one.requirement for one in says.wanted}
            )
            if self._asked.arguments.get("python") is None and self._is_here:
                made = packages_for(self._snapshot, choice)
                if made is not None:
                    packages = Path(made.packages)
                    inferred = made.facts.get("inferred", ())
                    taken = {one["module"]: one["where"] for one in inferred}
        except (RequirementError, ResolutionError, PackageIntegrityError) as error:
            self._report.judged("requirements", [str(error)])
            raise _StoppedError from error
        self._report.judged("requirements", [])
        read = imports.imports(self._snapshot, self._files)
        found = undeclared(read, wanted, packages, taken)
        for finding in found:
            self._report.add(finding)
        if not found:
            self._report.judged("imports", [])

    @property
    def _takes_render_mode(self) -> bool:
        """Whether its make_env names such an argument, as far as its text says."""
        entry = self._files.get(self._snapshot.path)
        return entry is not None and any("render_mode" in text for text, _ in entry.entries)

    @property
    def _is_here(self) -> bool:
        return bool(self._asked.arguments.get("sandbox", "process") == "process")

    def make(self, **changes: Any) -> EnvSuites:
        """Its environments; of the very files that were read, or it cannot be judged."""
        given = {**self._asked.arguments, "cfg": self._report.reference, **changes}
        policy = policy_from(given.get("policy"), given.get("limits"))
        # no death is to be survived that nobody is told of
        given |= {"policy": replace(policy, restart="never"), "limits": None}
        suites = make_env(**given)
        if suites.provenance["commit"] != self._snapshot.commit:  # a folder of this machine
            suites.close()
            raise SnapshotError(f"{self._asked.reference} changed while it was judged; judge again")
        return suites

    def _load(self) -> None:
        self._asked.tell("loading it")
        try:
            suites = self._made_to_record()
        except _ITS_FAULT as error:
            self._unloaded(error)
            self.denied(error.denied)
            self._note_walls(None)
            raise _StoppedError from error
        with suites:
            self._report.judged("loads", [])
            try:
                self._ask_tasks(suites)
            finally:  # also where an interrupt ends it
                self._report.provenance = suites.provenance
                self._note_walls(suites.provenance)

    def _ask_tasks(self, suites: EnvSuites) -> None:
        tasks = self._asked.tasks(suites)
        self._report.waiting = [f"{suite} / {task}" for suite, task in tasks]
        for suite, task in tasks:
            self._asked.tell(f"{suite} / {task}")
            asking = self._task(suites, suite, task)
            with self._stopping(f"{suite} / {task}", asking):
                asking.ask()
            self.denied(asking.denied(), f"{suite} / {task}")
            asking.film()
            suites[suite][task].close()
            self._report.waiting.pop(0)

    def _task(self, suites: EnvSuites, suite: str, task: Any) -> TaskJudge:
        env, takes = suites[suite][task], self._takes_render_mode
        asked, report = self._asked, self._report
        return TaskJudge(asked, report, self.make, env, (suite, task), takes_render_mode=takes)

    def _note_walls(self, provenance: Mapping[str, Any] | None) -> None:
        policy = policy_from(self._asked.arguments.get("policy"), None)
        self._report.walls = walls(policy.profile, provenance, self._unrecorded)

    def _unloaded(self, error: EnvHubError) -> None:
        if isinstance(error, (WorkerDiedError, WorkerTimeoutError)):
            self._report.judged("survives", [f"while it loaded: {error}"], cause=_cause(error))
        elif not isinstance(error, DependencyError):  # also a name that a terminal would obey
            self._report.judged("loads", [str(error)], cause=_cause(error))
        elif not self._found("imports"):  # where it stands has been said already
            self._report.judged("imports", [str(error)])

    def denied(self, denied: Iterable[str] | None, task: str = "") -> None:
        """What a jail was refused, where that was recorded."""
        if denied is not None:
            for check, found in denials.sorted_out(denied).items():
                self._report.judged(check, found, task)

    def _made_to_record(self) -> EnvSuites:
        """Of which what they are denied is recorded, where a kernel and its containers let it be.

        With the longer steps that this costs nobody measures a time.
        """
        given = self._asked.arguments
        if not self._is_here:
            self._unrecorded = "only --sandbox process has it recorded"
            return self.make(num_workers=1, validate=True)
        policy = policy_from(given.get("policy"), given.get("limits"))
        recording = {"policy": replace(policy, record_denials=True), "limits": None}
        try:
            return self.make(num_workers=1, validate=True, **recording)
        except SandboxUnavailableError as error:  # of the profile, too: then it is raised again
            self._unrecorded = str(error)
        return self.make(num_workers=1, validate=True)

    @contextmanager
    def _stopping(self, task: str, asking: TaskJudge) -> Iterator[None]:
        try:
            with asking.ending():
                yield
        except ObservationError as error:
            self._report.judged("observation-space", [str(error)], task)
        except CustomSpaceError as error:  # of actions
            self._report.judged("runs", [str(error)], task)
        except RemoteEnvError as error:
            line = error.where.strip().partition("\n")[0]
            found = [f"{error.type_name}: {error.message}" + (f" ({line})" if line else "")]
            self._report.judged("runs", found, task, cause=_cause(error))
        except (LoadError, DependencyError, RemoteProtocolError) as error:
            found = [f"not as it did at first: {error}"]
            self._report.judged("loads", found, task, cause=_cause(error))
        except (WorkerDiedError, WorkerTimeoutError) as error:
            self._report.judged("survives", [str(error)], task, cause=_cause(error))
        else:
            for check in ("observation-space", "runs", "survives"):
                self._report.judged(check, [], task)

    def _found(self, check: str) -> bool:
        return any(finding.id == check for finding in self._report.findings)
