"""``envhub check``: judge a repository before it is trusted, for people and for CI."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    BAD,
    DOUBTFUL,
    GOOD,
    ProgressBar,
    out,
    print_json,
    safe_line,
    say,
    says_what_is_seen,
    show,
    show_rows,
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError, reported
from envhub_sandbox.extras.judge.command.deadline import DeadlineReached, deadline_alarm
from envhub_sandbox.extras.judge.command.findings import annotate, level, show_finding, write_report

if TYPE_CHECKING:
    from envhub_sandbox.extras.judge.findings import Finding, Report

SETTINGS = (
    *("steps", "resets", "slow_step", "seed", "fail_on", "allow", "policy", "n_envs"),
    *("timeout", "memory", "disk", "processes", "cpu_time"),
    "deadline",
)
"""The permitted keys in ``[check]`` of ``--settings FILE``, by their names in Python."""
_PANEL = "What it says"
_FILE = "FILE"
_MAY = "What it may do"
_LONG_S = 10.0
_FIGURES = ("suite / task", "episodes", "steps", "a step", "slowest")


def _with_settings(ctx: typer.Context, path: Path | None) -> Path | None:
    """Set the defaults of later options from the caller's file."""
    if path is not None and not ctx.resilient_parsing:  # completion parses resiliently
        from envhub_sandbox.extras.judge import settings

        with reported(debug=False):
            ctx.default_map = settings.read_settings(path, SETTINGS)
    return path


_HERE = ("lock", "num_workers", "trust_remote_code", "network", "gpu", "readable")
_OPTIONS = [key for key in opt.ALL if key not in (*_HERE, "environment", "output")]


@opt.with_options(*_OPTIONS, n_envs=2)
def check(
    *,
    ctx: typer.Context,
    ref: Annotated[
        str | None,
        typer.Argument(
            metavar="REF",
            help="A hub reference, 'org/repo@revision:path/env.py', or a folder, './my-env'; or "
            "none, with --all.",
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Vector steps of each play; there are up to six.")
    ] = 200,
    resets: Annotated[
        int,
        typer.Option(
            min=0, help="Resets in each of four rounds that look for leaks; 0 skips them."
        ),
    ] = 8,
    slow_step: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Longest permitted median step; resets may take five times as long.",
        ),
    ] = 1.0,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="The seed of each play.")] = 0,
    fail_on: opt.FailOn = "error",
    settings: Annotated[
        Path | None,
        typer.Option(
            metavar=_FILE,
            callback=_with_settings,
            is_eager=True,
            help="A TOML file of your own with options in [check]; the command line wins.",
        ),
    ] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option(
            "--allow",
            metavar="ID",
            help="A check whose findings do not change the exit code (repeatable).",
        ),
    ] = None,
    json: opt.Json = False,
    junit: Annotated[
        Path | None, typer.Option(metavar=_FILE, help="JUnit's XML.", rich_help_panel=_PANEL)
    ] = None,
    sarif: Annotated[
        Path | None, typer.Option(metavar=_FILE, help="SARIF 2.1.0.", rich_help_panel=_PANEL)
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            metavar=_FILE,
            help="One HTML page with pictures, plots and all findings.",
            rich_help_panel=_PANEL,
        ),
    ] = None,
    github: Annotated[
        bool,
        typer.Option(
            "--github",
            help="Annotations for a GitHub workflow, and its step summary.",
            rich_help_panel=_PANEL,
        ),
    ] = False,
    listed: Annotated[
        str | None,
        typer.Option(
            "--all", metavar="FILE", help="Judge a list of references, one per line; '-' is stdin."
        ),
    ] = None,
    deadline: Annotated[
        float,
        typer.Option(
            "--deadline",
            metavar="SECONDS",
            min=1,
            help="Time for one repository; after it the report names what was not judged.",
        ),
    ] = 900.0,
    suite: opt.Suite = None,
    task: opt.Task = None,
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar=_FILE,
            help="A TOML file with fields of Policy and [limits]; options win.",
            rich_help_panel=_MAY,
        ),
    ] = None,
    make: opt.MakeOptions,
    debug: opt.Debug = False,
) -> None:
    """Run a repository in a sandbox and report what is wrong with it.

    It reads the files, installs the packages, and plays each task several times, in one process
    and in others. docs/checks.md has every check. Exit code 0: nothing fails; 1: something
    fails; others: the repository could not be judged.

    [bold]envhub check org/repo@<commit> --junit report.xml[/bold]

    [bold]envhub check --all references.txt --json[/bold]
    """
    if not math.isfinite(deadline):
        raise UsageError(f"--deadline is {deadline}; it takes seconds, such as 900")
    least, allowed = level(str(fail_on)), _known(allow or ())
    files = {"--settings": settings, "--policy": policy}
    from envhub_sandbox.extras.judge.settings import no_report_but_ours, refuse_files_of_the_judged

    def judged(reference: str) -> Report:
        return judgement(
            replace(make, ref=reference),
            policy,
            deadline,
            quiet=json or github,
            seed=seed,
            steps=steps,
            resets=resets,
            slow_step_s=slow_step,
            tasks=lambda envs: [row[:2] for row in opt.select_envs(envs, suite, task)],
            pictures=html is not None,
        )

    def failing(report: Report) -> list[Finding]:
        return report.failures(least, allowed)

    if listed is not None:
        _refuse_beside_a_list(ref=ref, sarif=sarif, html=html)
        _arguments(make, policy)  # reject bad arguments before the first judgement
        from envhub_sandbox.extras.judge.command import list_run

        with no_report_but_ours([junit], "./"):
            results = list_run.judge_list(listed, judged, failing, files, debug=debug)
            if junit is not None:
                list_run.write_junit(junit, results)
        list_run.show_results(results, json=json, github=github)
        return
    if ref is None:
        raise UsageError("name a repository, or a list of them: --all FILE")
    refuse_files_of_the_judged(files, ref)
    with no_report_but_ours((junit, sarif, html), ref):
        report = judged(ref)
        failures = failing(report)
        _write(report, failures, junit, sarif, html)
    from envhub_sandbox.extras.judge import reports

    if github:
        _print_confinement(report)
        annotate(reports.workflow_commands(report), reports.summary(report, failures))
    if json:
        print_json(reports.document(report, failures))
    else:
        if not github:
            _print(report, failures)
        unsure = DOUBTFUL if report.is_unjudged(failures) else BAD
        say(f"{report.verdict(failures)}.", unsure if failures else GOOD)
    if failures:
        raise typer.Exit(Exit.UNJUDGED if report.is_unjudged(failures) else Exit.ENVIRONMENT)


def _refuse_beside_a_list(*, ref: str | None, **files: Path | None) -> None:
    if ref is not None:
        raise UsageError(
            f"--all judges a list, and {ref} is one repository: give one of them, not both"
        )
    for name, path in files.items():
        if path is not None:
            raise UsageError(
                f"--{name} is about one repository; with --all, --json and --junit FILE have all"
            )


def _known(names: Sequence[str]) -> Sequence[str]:
    from envhub_sandbox.extras.judge.checks import CHECKS
    from envhub_sandbox.settings.options import nearest

    for name in names:
        if name not in CHECKS:
            raise UsageError(
                f"--allow {name!r}: there is no such check{nearest(name, CHECKS)}; there are: "
                f"{', '.join(CHECKS)}"
            )
    return names


def judgement(
    make: opt.MakeOptions, policy: Path | None, deadline_s: float, *, quiet: bool, **play: Any
) -> Report:
    """Judges a repository until the deadline; ``play`` holds further fields of ``JudgeOptions``."""
    from envhub_sandbox.extras.judge import settings
    from envhub_sandbox.extras.judge.findings import Report
    from envhub_sandbox.extras.judge.judge import judge

    arguments = _arguments(make, policy)
    del arguments["cfg"]
    arguments["policy"]["prewarm"] = 0  # a prewarmed jail would count as another jail
    report, doing = Report(make.ref, folder=settings.folder_below_here(make.ref)), ["starting"]
    with ProgressBar(quiet=quiet, long_s=_LONG_S) as bar, says_what_is_seen():

        def tell(what: str) -> None:
            doing.append(what)
            bar.begin(what)

        asked = settings.JudgeOptions(reference=make.ref, arguments=arguments, tell=tell, **play)
        try:
            with deadline_alarm(deadline_s):
                judge(asked, report)
        except DeadlineReached:
            report.stopped(deadline_s, doing[-1])
    return report


def _arguments(make: opt.MakeOptions, policy: Path | None) -> dict[str, Any]:
    """Returns arguments of ``make_env``. Raises ``UsageError``, ``PolicyError`` for the policy."""
    from envhub_sandbox.extras.judge import settings
    from envhub_sandbox.settings.policy import policy_from

    arguments = make.arguments()
    says = {} if policy is None else settings.read_policy(policy)
    arguments["policy"] = settings.merged_settings(says, arguments["policy"])
    policy_from(arguments["policy"], None)
    return arguments


def _write(report: Report, failures: list[Finding], *files: Path | None) -> None:
    """Write the files for ``--junit``, ``--sarif`` and ``--html``."""
    from envhub_sandbox.extras.judge import page, reports

    for path, form in zip(files, (reports.junit, reports.sarif, page.page), strict=True):
        if path is not None:
            write_report(path, form(report, failures), [report.reference])


def _print_confinement(report: Report) -> None:
    """Print the confinement, also in the log of a workflow."""
    for word, text in () if report.confinement is None else report.confinement.rows():
        show(word, text)


def _print(report: Report, failures: list[Finding]) -> None:
    out(safe_line(report.reference, 300), "bold")
    for finding in report.findings:
        show_finding(finding, fails=finding in failures)
    if report.figures:
        out()
        show_rows([_FIGURES, *map(_figures, report.figures.items())], right=range(1, 5))
    out()
    _print_confinement(report)


def _figures(of: tuple[str, Mapping[str, float]]) -> list[str]:
    task, figures = of
    means, most = 1e3 * figures["step_mean_s"], 1e3 * figures["step_slowest_s"]
    counts = [f"{int(figures[name]):,}" for name in ("episodes", "steps")]
    return [task, *counts, f"{means:.2f} ms", f"{most:.1f} ms"]
