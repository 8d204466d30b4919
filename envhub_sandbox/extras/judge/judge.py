"""Judges a repository: runs it in the sandbox and makes every check of the table.

Trust: the repository's answers are hostile. A report states what we observe from outside, and a
check passes because our own comparison finds no fault, never because the repository says so.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from gymnasium.error import CustomSpaceError

from envhub_sandbox import RaySandbox, __version__
from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    LoadError,
    RemoteEnvError,
    RemoteProtocolError,
    SandboxUnavailableError,
    SnapshotError,
    WorkerDiedError,
    WorkerTimeoutError,
)
from envhub_sandbox.extras.judge.checks import CHECKS
from envhub_sandbox.extras.judge.denials import denial_findings
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.play.members import OutsideSpaceError
from envhub_sandbox.extras.judge.play.task import TaskJudge
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.extras.judge.static import survey, undeclared
from envhub_sandbox.extras.packages.declared import declared
from envhub_sandbox.extras.packages.locks.day import days_for
from envhub_sandbox.extras.packages.packages import packages_for
from envhub_sandbox.extras.packages.request import chosen
from envhub_sandbox.extras.sources import parsing
from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, snapshot_named
from envhub_sandbox.play.confinement import Confinement
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import policy_from
from envhub_sandbox.vector.suites import EnvSuites
from envhub_worker.protocol.text import size_text

_ITS_FAULT = (
    *(LoadError, DependencyError, RemoteEnvError, RemoteProtocolError),
    *(WorkerDiedError, WorkerTimeoutError),
)
"""Errors of loading for which the repository is to blame."""


class _StoppedError(Exception):
    """Ends the questions to this task, or to the repository."""


def judge(asked: JudgeOptions, report: Report | None = None) -> Report:
    """Judges a repository; ``report`` takes each finding at once, so that an interrupt loses none.
    Raises ``EnvHubError``: the repository could not be judged: it is unreachable, this host cannot
    confine it, or a server is full. A fault of the repository itself is a finding.
    """
    asked.tell(f"reading {asked.reference}")
    where = {name: asked.arguments.get(name) for name in ("hub_cache_dir", "token", "endpoint")}
    allow = bool(asked.arguments.get("allow_secrets"))
    snapshot = snapshot_named(asked.reference, allow_secrets=allow, **where)
    report = Report(asked.reference) if report is None else report
    report.reference, report.commit = snapshot.reference, snapshot.commit
    judging = _Judge(asked, snapshot, report)
    report.asked = judging.how()
    with contextlib.suppress(_StoppedError):
        judging.ask()
    report.judged("deadline", [])
    return report


def _limit(name: str, value: int) -> str:
    words = name.replace("_", " ")
    if name.endswith("_bytes"):
        return f"{words.removesuffix(' bytes')} {size_text(value)}"
    return f"{words} {value:,}"


def is_moving(reference: str, snapshot: Snapshot) -> bool:
    """Tells whether a reference may later mean another commit or version; a repository's name can
    look like a commit.
    """
    if snapshot.is_local:
        return False
    revision = HubRef.parse(reference).revision
    return revision is None if snapshot.repo_type == "pypi" else revision != snapshot.commit


class _Judge:
    def __init__(self, asked: JudgeOptions, snapshot: Snapshot, report: Report) -> None:
        self._asked, self._snapshot, self._report = asked, snapshot, report
        self._policy = policy_from(asked.arguments.get("policy"), asked.arguments.get("limits"))
        self._arguments = dict(asked.arguments)
        sandbox = asked.arguments.get("sandbox", "process")
        self._is_here = sandbox == "process"
        if sandbox == "ray":  # else one play would hold the room that the next play waits for
            self._arguments["sandbox"] = RaySandbox(shared=True)
        self._files = parsing.read(snapshot)
        entry = self._files.get(snapshot.path)
        arguments = () if entry is None else entry.entries
        self._takes_render_mode = any("render_mode" in text for text, _ in arguments)
        self._unrecorded = ""

    def how(self) -> dict[str, str]:
        """Describes the settings of the judgement, in the caller's words and ours."""
        asked, policy = self._asked, self._policy
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

    def ask(self) -> None:
        self._read()
        self._resolve()
        self._load()

    def _read(self) -> None:
        reference = self._asked.reference
        moving = f"{reference} can mean another commit or version tomorrow"
        self._report.judged("pinned", [moving] if is_moving(reference, self._snapshot) else [])
        survey(self._snapshot, self._files, self._report)
        wrong = {finding.id for finding in self._report.findings}
        for check in CHECKS:
            if check.startswith(("licence", "card", "source-")) and check not in wrong:
                self._report.judged(check, [])

    def _resolve(self) -> None:
        self._asked.tell("reading and installing what it declares")
        packages, wanted, taken = None, {}, dict[str, str]()
        try:
            choice, _ = chosen(self._asked.arguments.get("dependencies", "auto"), None)
            says = declared(self._snapshot.root, self._snapshot.path)
            stated = () if says is None else says.wanted
            wanted = {package.requirement.name: package.requirement for package in stated}
            if self._asked.arguments.get("python") is None and self._is_here:
                packages_made = packages_for(self._snapshot, choice)
                if packages_made is not None:
                    packages = Path(packages_made.packages)
                    inferred = packages_made.facts.get("inferred", ())
                    taken = {guess["module"]: guess["where"] for guess in inferred}
        except DependencyError as error:
            if error.reason not in ("requirement", "resolution", "integrity"):
                raise
            self._report.judged("requirements", [str(error)])
            raise _StoppedError from error
        self._report.judged("requirements", [])
        read = parsing.imports(self._snapshot, self._files)
        missing = undeclared(read, wanted, packages, taken)
        for finding in missing:
            self._report.add(finding)
        if not missing:
            self._report.judged("imports", [])

    def make(self, *, record_denials: bool = False, **changes: Any) -> EnvSuites:
        """Makes the environments of the snapshot that was read; raises if its files changed."""
        # without restarts, which would hide a death
        record = record_denials or self._policy.record_denials
        policy = replace(self._policy, restart="never", record_denials=record)
        given = {**self._arguments, "cfg": self._report.reference, **changes}
        suites = make_env(**{**given, "policy": policy, "limits": None})
        if suites.provenance["commit"] != self._snapshot.commit:  # a local folder has changed
            suites.close()
            raise SnapshotError(f"{self._asked.reference} changed during the check; check it again")
        return suites

    def _load(self) -> None:
        self._asked.tell("loading it")
        try:
            suites = self._made_to_record()
        except _ITS_FAULT as error:
            self._unloaded(error)
            self._denied(error.denied)
            self._note_confinement(None)
            raise _StoppedError from error
        with suites:
            self._report.judged("loads", [])
            try:
                self._ask_tasks(suites)
            finally:  # also after an interrupt
                self._report.provenance = suites.provenance
                self._note_confinement(suites.provenance)

    def _ask_tasks(self, suites: EnvSuites) -> None:
        tasks = self._asked.tasks(suites)
        self._report.waiting = [f"{suite} / {task}" for suite, task in tasks]
        for suite, task in tasks:
            self._asked.tell(f"{suite} / {task}")
            env, takes = suites[suite][task], self._takes_render_mode
            judging = self._asked, self._report, self.make
            asking = TaskJudge(*judging, env, (suite, task), takes_render_mode=takes)
            with self._stopping(f"{suite} / {task}"):
                asking.ask()
            self._denied(asking.denied(), f"{suite} / {task}")
            asking.film()
            env.close()
            self._report.waiting.pop(0)

    def _note_confinement(self, provenance: Mapping[str, Any] | None) -> None:
        made = Confinement.of(self._policy.profile, provenance, self._unrecorded)
        self._report.confinement = made

    def _unloaded(self, error: EnvHubError) -> None:
        if isinstance(error, (WorkerDiedError, WorkerTimeoutError)):
            self._report.raised("survives", error, message=f"while it loaded: {error}")
            return
        dated = self._with_older_packages(error)
        if not isinstance(error, DependencyError):  # or a name with control codes
            self._report.raised("loads", error, message=f"{error}{dated}")
        elif dated or "imports" not in {finding.id for finding in self._report.findings}:
            self._report.raised("imports", error, message=f"{error}{dated}")

    def _with_older_packages(self, error: EnvHubError) -> str:
        """Returns advice with the latest of a few days whose packages cure an error of a start."""
        if not self._is_here or self._arguments.get("dependencies", "auto") != "auto":
            return ""
        said = ""
        for day in days_for(self._snapshot, error):
            self._asked.tell(f"loading it with packages of {day}")
            try:
                with self.make(num_workers=1, dependencies={"exclude_newer": day}) as suites:
                    suite, task = self._asked.tasks(suites)[0]
                    suites[suite][task].reset(seed=self._asked.seed)
            except EnvHubError:
                return said or f"\nIt does not start with packages of {day} either"
            older = option_name("dependencies", {"exclude_newer": day})
            said = f"\nIt starts with {older}, which a lock can keep"
        return said

    def _denied(self, denied: Iterable[str] | None, task: str = "") -> None:
        """Record a jail's denials as findings, if the jail recorded any."""
        if denied is not None:
            for check, findings in denial_findings(denied).items():
                self._report.judged(check, findings, task)

    def _made_to_record(self) -> EnvSuites:
        """Makes environments whose jails record denials, if kernel and container permit it.

        Recording slows steps down, so this play measures no times.
        """
        self._unrecorded = "" if self._is_here else "only --sandbox process records them"
        if self._is_here:
            try:
                return self.make(record_denials=True, num_workers=1)
            except SandboxUnavailableError as error:  # a fault of the profile is raised again
                self._unrecorded = str(error)
        return self.make(num_workers=1)

    @contextmanager
    def _stopping(self, task: str) -> Iterator[None]:
        try:
            yield
        except (OutsideSpaceError, CustomSpaceError) as error:  # CustomSpaceError is about actions
            check = "observation-space" if isinstance(error, OutsideSpaceError) else "runs"
            self._report.judged(check, [str(error)], task)
        except RemoteEnvError as error:
            error.message += self._with_older_packages(error)
            self._report.raised("runs", error, task)
        except (LoadError, DependencyError, RemoteProtocolError) as error:
            again = f"another result than the first time: {error}"
            self._report.raised("loads", error, task, again)
        except (WorkerDiedError, WorkerTimeoutError) as error:
            self._report.raised("survives", error, task)
        else:
            for check in ("observation-space", "runs", "survives"):
                self._report.judged(check, [], task)
