"""``envhub check --all FILE``: a list of repositories, each judged in a process of its own."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from envhub_sandbox.check.checks import CHECKS
from envhub_sandbox.check.many import index, lines
from envhub_sandbox.check.many.results import (
    FolderError,
    ForeignResultError,
    Result,
    Results,
    Verdict,
)
from envhub_sandbox.check.many.running import Ended, judgements
from envhub_sandbox.check.reports import write
from envhub_sandbox.check.settings import merged, policy
from envhub_sandbox.cli.check.outside import refuse_the_judged
from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import print_json, safe_line, say, show
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.cli.shared.findings import annotate
from envhub_sandbox.cli.shared.memory import free_bytes
from envhub_sandbox.cli.version import versions
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.hub.snapshot import commit_of
from envhub_sandbox.policy import policy_from
from envhub_worker.protocol.text import duration_text, size_text

if TYPE_CHECKING:
    from envhub_sandbox.check.many.lines import Listed

_GRACE_S = 60.0
"""For a judgement that ends itself at its deadline and writes its report; then it is ended."""
_JAILS = 2
"""Of one judgement at once: the one that is played, and the one that it is compared with."""
_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.UNJUDGED: "yellow"}
OF_THE_LIST = frozenset(
    {
        *("ref", "listed", "output", "jobs", "memory_budget", "deadline", "again"),
        *("json", "junit", "sarif", "html", "github", "settings", "policy", "token", "debug"),
    }
)
"""Options that are not handed on to each judgement, or in another way."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A list, and how it is judged.

    Attributes:
        file: The list.
        output: Where results go.
        jobs, memory_budget, deadline, again: As the options.
        make: The options of ``make_env``, for whatever reference.
        settings, policy: The caller's files.
        arguments: What each judgement is told.
        debug: Whether each tells of tracebacks.
    """

    file: str
    output: Path | None
    jobs: int | None
    memory_budget: str | None
    deadline: float
    again: bool
    make: opt.MakeOptions
    settings: Path | None
    policy: Path | None
    arguments: Sequence[str]
    debug: bool = False


def handed_on(ctx: typer.Context) -> list[str]:
    """The options of this command that each judgement gets, as words; defaults included.

    They are those that hold here, whatever said so: the command line or a file.
    """
    words = []
    for parameter in ctx.command.params:
        value = ctx.params.get(parameter.name or "")
        if parameter.name in OF_THE_LIST or value is None or value is False:
            continue
        name = next(one for one in parameter.opts if one.startswith("--"))
        for one in value if isinstance(value, (list, tuple)) else (value,):
            words.append(name if one is True else f"{name}={one}")
    return words


def judge_all(wanted: Wanted) -> Judged:
    """Judge a list, but for what has been judged already.

    Raises:
        UsageError: An option cannot be, such as a folder for results with other things in it.
        HubReferenceError: A line of the list.
        PolicyError: The policy.
    """
    if wanted.output is None:
        raise UsageError("--all needs --output DIR, where reports and their index go")
    listed = _listed(wanted.file)
    places = {"--settings": wanted.settings, "--policy": wanted.policy, "--output": wanted.output}
    for one in listed:
        refuse_the_judged(places, one.reference, f" (line {one.line} of {wanted.file})")
    jobs, text = _jobs(wanted), _policy(wanted)
    results = Results(wanted.output, _digest(wanted.arguments, text))
    judged = Judged(results, {one: Result(listed=one) for one in listed})
    try:
        with results.held() as running:
            copy = running / "policy.toml"  # what is digested is what each is judged by
            copy.write_bytes(text)
            _judge_in(running, judged, wanted, jobs, copy)
    except FolderError as error:
        raise UsageError(f"--output {error}") from error
    return judged


def _judge_in(running: Path, judged: Judged, wanted: Wanted, jobs: int, policy: Path) -> None:
    for one in list(judged.of):
        judged.recall(one, forget=wanted.again)
    judged.write()
    ended = judgements(
        _waiting(judged, wanted.make),
        lambda one, place, ourselves: _command(wanted, one, place, ourselves, policy),
        folder=running,
        jobs=jobs,
        most_s=wanted.deadline + _GRACE_S,
        variables=_variables(wanted.make.given["token"]),
    )
    try:
        with contextlib.closing(ended):
            for what in ended:
                judged.take(what)
    finally:
        judged.write()


def print_judged(judged: Judged, *, json: bool, junit: Path | None, github: bool) -> None:
    """Print what has come of a list, and end with its code.

    Args:
        judged: It.
        json: Print the index as JSON.
        junit: JUnit's file.
        github: Print annotations.

    Raises:
        UsageError: A file cannot be written.
        Exit: Not all passed.
    """
    results = list(judged.of.values())
    if junit is not None:
        judged.report(junit)
    if github:
        annotate(index.workflow_commands(results), index.summary(results))
    if json:
        print_json(index.document(results))
    elif not github:
        judged.print()
    if judged.exit is not Exit.OK:
        raise typer.Exit(judged.exit)


@dataclass
class Judged:
    """What has come of each reference, so far."""

    results: Results
    of: dict[Listed, Result]
    _done: set[Listed] = field(default_factory=set)

    def recall(self, listed: Listed, *, forget: bool) -> None:
        """What came of it before, unless that is to be forgotten."""
        if forget:
            self.results.forget(listed)
            return
        try:
            kept = self.results.kept(listed)
        except ForeignResultError as error:
            say(safe_line(f"judging {listed.reference} again: {error}", 500), style="yellow")
            return
        if kept is not None:
            self.of[listed] = kept

    def take(self, ended: Ended[Listed]) -> None:
        """One has ended."""
        self.of[ended.order] = self._judged(ended)
        self.write()
        self.tell(ended.order)

    def _judged(self, ended: Ended[Listed]) -> Result:
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        said = ended.said.removeprefix("Error: ")
        if ended.code in (Exit.OK, Exit.ENVIRONMENT, Exit.UNJUDGED):
            with contextlib.suppress(ValueError, RecursionError, ForeignResultError):
                return self.results.keep(
                    ended.order,
                    json.loads(ended.out),
                    ended.folder / "page.html",
                    seconds=ended.seconds,
                    ended=now,
                )
        return Result(
            listed=ended.order,
            verdict=Verdict.UNJUDGED,
            seconds=ended.seconds,
            ended=now,
            said=said or f"it ended with {ended.code}, and gave no report",
        )

    def tell(self, listed: Listed, how: str = "") -> None:
        """One line about what is finished."""
        self._done.add(listed)
        one = self.of[listed]
        words = (
            f"[{len(self._done)}/{len(self.of)}] {one.verdict.value:<10} {listed.reference}",
            how or duration_text(one.seconds),
            *one.why,
        )
        say(safe_line("; ".join(words), 300), style=_COLOURS.get(one.verdict))

    def write(self) -> None:
        """Write the index."""
        results = list(self.of.values())
        self.results.write("index.json", json.dumps(index.document(results), indent=2) + "\n")
        self.results.write("index.html", index.page(results))

    def report(self, path: Path) -> None:
        """Write JUnit's file of all.

        Raises:
            UsageError: It cannot be written.
        """
        try:
            write(path, index.junit(self.of.values(), self.results.report))
        except OSError as error:
            raise UsageError(f"the report cannot be written: {error}") from error

    def print(self) -> None:
        """What did not pass, and how many did."""
        for one in index.ordered(self.of.values()):
            if one.verdict is not Verdict.PASSED:
                show(one.verdict.value, one.listed.reference, _COLOURS.get(one.verdict))
                for line in one.why:
                    show("", line, "dim")
        say(f"{index.told(self.of.values())}.")

    @property
    def exit(self) -> Exit:
        """What fails counts more than what could not be judged."""
        found = {one.verdict for one in self.of.values()}
        if Verdict.FAILED in found:
            return Exit.ENVIRONMENT
        return Exit.OK if found == {Verdict.PASSED} else Exit.UNJUDGED


def _listed(file: str) -> list[Listed]:
    if file == "-":
        return lines.read(sys.stdin.buffer, "stdin")
    try:
        with open(file, "rb") as opened:
            return lines.read(opened, file)
    except OSError as error:
        raise UsageError(f"--all {file} cannot be read: {error.strerror}") from error


def _policy(wanted: Wanted) -> bytes:
    try:
        return b"" if wanted.policy is None else wanted.policy.read_bytes()
    except OSError as error:
        raise UsageError(f"{wanted.policy} cannot be read: {error.strerror}") from error


def _jobs(wanted: Wanted) -> int:
    """How many are judged at once: by cores, and by what the limits of their jails add up to."""
    given = wanted.make.arguments()["policy"]
    says = {} if wanted.policy is None else policy(wanted.policy)
    one = policy_from(merged(says, given), None).limits.memory_bytes
    each, budget = _JAILS * one, opt.read_size("--memory-budget", wanted.memory_budget)
    needs = f"a judgement may take {size_text(each)}: {_JAILS} jails of {size_text(one)}"
    if budget is None:
        budget = max(each, free_bytes() or 0)
    elif budget < each:
        raise UsageError(
            f"--memory-budget {wanted.memory_budget} is too little: {needs}. "
            "Give more, or less to each by --memory"
        )
    asked = wanted.jobs or max(1, len(os.sched_getaffinity(0)) // 2)
    jobs = min(asked, budget // each)
    if wanted.jobs is not None and jobs < wanted.jobs:
        say(f"{jobs} at once: {needs}, of {size_text(budget)}; see --memory and --memory-budget.")
    return jobs


def _digest(arguments: Sequence[str], policy: bytes) -> str:
    """A digest of all that a verdict depends on beside the repository; of no secret."""
    stands_on = {name: text for name, text in versions().items() if name != "platform"}
    checks = [(one.id, one.severity.value) for one in CHECKS.values()]
    said = [*arguments, policy.decode("utf-8", "replace"), stands_on, checks]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _waiting(judged: Judged, make: opt.MakeOptions) -> Iterator[Listed]:
    """Those that have to be judged, each asked for its commit when its turn has come."""
    for one, kept in list(judged.of.items()):
        if kept.is_judged and _means(one, make) == kept.commit:
            judged.tell(one, "as it was judged before")
        else:
            yield one


def _means(listed: Listed, make: opt.MakeOptions) -> str:
    try:
        return commit_of(
            listed.reference,
            **{name: make.given[name] for name in ("hub_cache_dir", "token", "endpoint")},
        )
    except EnvHubError:
        return "nobody knows"  # whoever judges it says why


def _command(
    wanted: Wanted, listed: Listed, place: Path, ourselves: int, policy: Path
) -> list[str]:
    command = [sys.executable, "-I", "-m", "envhub_sandbox.cli.check.child", str(ourselves)]
    command += ["check", "--json", f"--html={place / 'page.html'}", *wanted.arguments]
    command += [f"--deadline={wanted.deadline}"]
    command += [] if wanted.policy is None else [f"--policy={policy}"]
    command += ["--debug"] if wanted.debug else []
    return [*command, "--", listed.reference]


def _variables(token: str | None) -> Mapping[str, Any]:
    """A token is handed on where no list of processes shows it."""
    return {} if token is None else {"HF_TOKEN": token, "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0"}
