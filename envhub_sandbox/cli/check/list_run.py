"""``envhub check --all FILE``: a list of repositories, each judged in a process of its own."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from envhub_sandbox.check.checks import CHECKS
from envhub_sandbox.check.many import entries, index
from envhub_sandbox.check.many.judgements import Outcome, judgements
from envhub_sandbox.check.many.results import (
    FolderError,
    ForeignResultError,
    Result,
    Results,
    Verdict,
)
from envhub_sandbox.check.settings import (
    is_in_its_checkout,
    merged_settings,
    read_file,
    refuse_files_of_the_judged,
)
from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    BAD,
    DOUBTFUL,
    GOOD,
    print_json,
    safe_line,
    say,
    show,
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.cli.shared.findings import annotate, write_report
from envhub_sandbox.cli.shared.host import free_memory_bytes, versions
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.hub.git.checkout import read_checkout
from envhub_sandbox.hub.snapshot import commit_of
from envhub_sandbox.sandboxes.ray import cluster
from envhub_sandbox.settings.policy import policy_from
from envhub_sandbox.system.platform import IS_WINDOWS, cores
from envhub_worker.protocol.text import duration_text, parse_size, size_text

if TYPE_CHECKING:
    from envhub_sandbox.check.many.entries import ListEntry

_GRACE_S = 60.0
"""For a judgement that ends itself at its deadline and writes its report; then it is ended."""
_JAILS = 2
"""Of one judgement at once: the one that is played, and the one that it is compared with."""
_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.UNJUDGED: "yellow"}
OF_THE_LIST = frozenset(
    {
        *("ref", "listed", "output", "jobs", "max_memory", "deadline", "again"),
        *("json", "junit", "sarif", "html", "github", "settings", "policy", "token", "debug"),
    }
)
"""Options that are not handed on to each judgement, or in another way."""


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


@dataclass(kw_only=True)
class ListRun:
    """One ``envhub check --all``: its options, and what has come of each reference so far.

    Attributes:
        jobs, max_memory, deadline, again: As the options.
        make: The options of ``make_env``, for whatever reference.
        settings, policy: The caller's files.
        arguments: Options for each judgement, as words.
        of: What has come of each reference.
    """

    file: str
    output: Path | None
    jobs: int | None
    max_memory: str | None
    deadline: float
    again: bool
    make: opt.MakeOptions
    settings: Path | None
    policy: Path | None
    arguments: Sequence[str]
    debug: bool = False
    of: dict[ListEntry, Result] = field(default_factory=dict)
    _done: set[ListEntry] = field(default_factory=set)

    def judge(self) -> None:
        """Judge the list, but for what has been judged already.
        Raises ``UsageError``: an option cannot be, such as a folder for results with other things
        in it; ``HubReferenceError``: a line of the list; ``PolicyError``: the policy.
        """
        if self.output is None:
            raise UsageError("--all needs --output DIR, where reports and their index go")
        if IS_WINDOWS:
            raise UsageError(
                "--all starts processes that must end with this one, which Windows cannot ensure: "
                "check one reference after the other, or run it in WSL"
            )
        self.of = {one: Result(listed=one) for one in self._listed()}
        places = {"--settings": self.settings, "--policy": self.policy, "--output": self.output}
        for one in self.of:
            refuse_files_of_the_judged(places, one.reference, f" (line {one.line} of {self.file})")
        self._refuse_committed_results(self.output)
        try:
            policy = b"" if self.policy is None else self.policy.read_bytes()
        except OSError as error:
            raise UsageError(f"{self.policy} cannot be read: {error.strerror}") from error
        jobs = self._at_once()
        self._results = Results(self.output, self._digest(policy))
        try:
            with self._results.held() as running:
                copy = running / "policy.toml"  # what is digested is what each is judged by
                copy.write_bytes(policy)
                self._judge_in(running, jobs, copy)
        except FolderError as error:
            raise UsageError(f"--output {error}") from error

    def _refuse_committed_results(self, output: Path) -> None:
        """Who commits a repository beside results of it could say there that it has passed."""
        if self.again or not any(is_in_its_checkout(output, one.reference) for one in self.of):
            return
        checkout = read_checkout(output.resolve())
        if checkout is not None and checkout.files - checkout.untracked:
            raise UsageError(
                f"--output {output} has files of the commit that is judged, which could say that "
                "anything has passed: name another folder, or judge everything with --again"
            )

    def _judge_in(self, running: Path, jobs: int, policy: Path) -> None:
        for one in list(self.of):
            self._recall(one)
        self._write_index()
        token = self.make.given["token"]
        # a token is handed on where no list of processes shows it
        variables = {"HF_TOKEN": token, "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0"} if token else {}
        if self._is_on_ray:
            variables["RAY_ADDRESS"] = cluster.shared_address()
        ended = judgements(
            self._waiting(),
            lambda one, place, ourselves: self._command(one, place, ourselves, policy),
            folder=running,
            jobs=jobs,
            most_s=self.deadline + _GRACE_S,
            variables=variables,
        )
        try:
            with contextlib.closing(ended):
                for outcome in ended:
                    self.of[outcome.order] = self._judged(outcome)
                    self._write_index()
                    self._say(outcome.order)
        finally:
            self._write_index()

    def write(self, junit: Path | None) -> None:
        """Write the file of ``--junit``. Raises ``UsageError``: it cannot be written;
        ``PolicyError``: a repository of the list has put a link there.
        """
        if junit is not None:
            text = index.junit(list(self.of.values()), self._results.report)
            write_report(junit, text, (one.reference for one in self.of))

    def show(self, *, json: bool, github: bool) -> None:
        """Print what has come of it, and end with its code. Raises ``Exit``: not all passed."""
        results = list(self.of.values())
        if github:
            annotate(index.workflow_commands(results), index.summary(results))
        if json:
            print_json(index.index_document(results))
        elif not github:
            self._print(results)
        if self.exit is not Exit.OK:
            raise typer.Exit(self.exit)

    def _print(self, results: Sequence[Result]) -> None:
        """What did not pass, and how many did."""
        for one in index.ordered(results):
            if one.verdict is not Verdict.PASSED:
                show(one.verdict.value, one.listed.reference, _COLOURS.get(one.verdict))
                for line in one.why:
                    show("", line, "dim")
        style = {Exit.OK: GOOD, Exit.UNJUDGED: DOUBTFUL}.get(self.exit, BAD)
        say(f"{index.counts(results)}.", style)

    @property
    def exit(self) -> Exit:
        """What fails counts more than what could not be judged."""
        found = {one.verdict for one in self.of.values()}
        if Verdict.FAILED in found:
            return Exit.ENVIRONMENT
        return Exit.OK if found == {Verdict.PASSED} else Exit.UNJUDGED

    def _recall(self, listed: ListEntry) -> None:
        """What came of it before, unless all are judged again."""
        if self.again:
            self._results.forget(listed)
            return
        try:
            self.of[listed] = self._results.kept(listed) or self.of[listed]
        except ForeignResultError as error:
            say(safe_line(f"judging {listed.reference} again: {error}", 500), style="yellow")

    def _judged(self, outcome: Outcome[ListEntry]) -> Result:
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        if outcome.code in (Exit.OK, Exit.ENVIRONMENT, Exit.UNJUDGED):
            with contextlib.suppress(ValueError, RecursionError, ForeignResultError):
                return self._results.keep(
                    outcome.order,
                    json.loads(outcome.out),
                    outcome.folder / "page.html",
                    seconds=outcome.seconds,
                    ended=now,
                )
        return Result(
            listed=outcome.order,
            verdict=Verdict.UNJUDGED,
            seconds=outcome.seconds,
            ended=now,
            said=outcome.said.removeprefix("Error: ")
            or f"it ended with {outcome.code}, without a report",
        )

    def _say(self, listed: ListEntry, how: str = "") -> None:
        """One line about what is finished."""
        self._done.add(listed)
        one = self.of[listed]
        words = (
            f"[{len(self._done)}/{len(self.of)}] {one.verdict.value:<10} {listed.reference}",
            how or duration_text(one.seconds),
            *one.why,
        )
        say(safe_line("; ".join(words), 300), style=_COLOURS.get(one.verdict))

    def _write_index(self) -> None:
        results = list(self.of.values())
        self._results.write(
            "index.json", json.dumps(index.index_document(results), indent=2) + "\n"
        )
        self._results.write("index.html", index.page(results))

    def _listed(self) -> list[ListEntry]:
        if self.file == "-":
            return entries.read_entries(sys.stdin.buffer, "stdin")
        try:
            with open(self.file, "rb") as opened:
                return entries.read_entries(opened, self.file)
        except OSError as error:
            raise UsageError(f"--all {self.file} cannot be read: {error.strerror}") from error

    def _at_once(self) -> int:
        """How many are judged at once: by cores, and by the limits of their jails together."""
        if self._is_on_ray:  # which counts its nodes' cores, and has the others wait
            return self.jobs or cluster.cpus()
        given = self.make.arguments()["policy"]
        says = {} if self.policy is None else read_file(self.policy)
        one = policy_from(merged_settings(says, given), None).limits.memory_bytes
        each = _JAILS * one
        try:
            budget = None if self.max_memory is None else parse_size(self.max_memory)
        except ValueError as error:
            raise UsageError(f"--max-memory is {self.max_memory!r}; {error}") from None
        needs = f"a judgement may take {size_text(each)}: {_JAILS} jails of {size_text(one)}"
        if budget is None:
            budget = max(each, free_memory_bytes() or 0)
        elif budget < each:
            raise UsageError(
                f"--max-memory {self.max_memory} is too little: {needs}. "
                "Give more, or less to each by --memory"
            )
        asked = self.jobs or max(1, cores() // 2)
        jobs = min(asked, budget // each)
        if self.jobs is not None and jobs < self.jobs:
            of = f"{needs}, of {size_text(budget)}"
            say(f"{jobs} at once: {of}; see --memory and --max-memory.")
        return jobs

    @property
    def _is_on_ray(self) -> bool:
        return bool(self.make.given["sandbox"] == "ray")

    def _digest(self, policy: bytes) -> str:
        """A digest of all that a verdict depends on beside the repository; of no secret."""
        stands_on = {name: text for name, text in versions().items() if name != "platform"}
        checks = [(one.id, one.severity.value) for one in CHECKS.values()]
        said = [*self.arguments, policy.decode("utf-8", "replace"), stands_on, checks]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def _waiting(self) -> Iterator[ListEntry]:
        """Those that have to be judged, each asked for its commit when its turn has come."""
        for one, kept in list(self.of.items()):
            if kept.is_judged and self._commit_of(one) == kept.commit:
                self._say(one, "as it was judged before")
            else:
                yield one

    def _commit_of(self, listed: ListEntry) -> str | None:
        try:
            return commit_of(listed.reference, **self.make.source)
        except EnvHubError:
            return None  # what judges it says why

    def _command(self, listed: ListEntry, place: Path, ourselves: int, policy: Path) -> list[str]:
        command = [sys.executable, "-I", "-m", "envhub_sandbox.cli.check.child", str(ourselves)]
        command += ["check", "--json", f"--html={place / 'page.html'}", *self.arguments]
        command += [f"--deadline={self.deadline}"]
        command += [] if self.policy is None else [f"--policy={policy}"]
        command += ["--debug"] if self.debug else []
        return [*command, "--", listed.reference]
