"""``envhub diff``: shows the differences between two commits, before approval of a new pin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    DOUBTFUL,
    GOOD,
    ProgressBar,
    out,
    print_json,
    safe_line,
    say,
    show,
    show_rows,
)
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.extras.judge.command.findings import STYLES, level
from envhub_worker.protocol.text import MARGIN, counted

if TYPE_CHECKING:
    from envhub_sandbox.extras.judge.changes import Change


@opt.with_options("env_kwargs", *opt.SOURCE)
def diff(
    *,
    then: Annotated[
        str,
        typer.Argument(metavar="REF_A", help="The approved commit, org/repo@commit, or a folder."),
    ],
    now: Annotated[str, typer.Argument(metavar="REF_B", help="The commit to compare with it.")],
    run: Annotated[
        bool,
        typer.Option("--run", help="Load both, each in a sandbox, and compare tasks and spaces."),
    ] = False,
    fail_on: opt.FailOn = None,
    json: opt.Json = False,
    make: opt.MakeOptions,
) -> None:
    """Compare two commits: files, packages, imports and findings; with --run, tasks and spaces.

    Both commits are read as data; nothing runs without --run. Exit code 7 if something differs;
    with --fail-on only new findings count, and the exit code is 1.

    [bold]envhub diff org/repo@<approved> org/repo@<new> --fail-on note[/bold]
    """
    least = None if fail_on is None else level(fail_on)
    from envhub_sandbox.extras.judge import changes
    from envhub_sandbox.extras.judge.static import static

    with ProgressBar(quiet=json) as bar:
        read = []
        for ref in (then, now):
            bar.begin(f"reading {ref}")
            read.append(static(make.snapshot(ref)))
        changes_found = changes.changes(read[0], read[1])
        if run:
            from envhub_sandbox.extras.packages.locks import making
            from envhub_sandbox.factory.make_env import make_env

            kwargs = make["env_kwargs"]
            tasks = []
            for repository in read:
                bar.begin(f"loading {repository.reference} in a sandbox")
                reference = repository.snapshot.reference
                with make_env(reference, env_kwargs=kwargs, **make.source) as suites:
                    tasks.append(making.tasks_of(suites))
            changes_found += changes.environments(tasks[0], tasks[1])
    if json:
        print_json(changes.document(read[0], read[1], changes_found))
    else:
        _print(read[0].reference, read[1].reference, changes_found)
    if least is None and changes_found:
        raise typer.Exit(Exit.DIFFERENT)
    if least and any(change.weighs(least) for change in changes_found):
        raise typer.Exit(Exit.ENVIRONMENT)


def _print(then: str, now: str, found: list[Change]) -> None:
    show("from", then, "bold")
    show("to", now, "bold")
    if not found:
        say("Nothing differs.", GOOD)
        return
    out()
    rows, styles = [("change", "what", "details")], {}
    for change in found:
        what, text = change.what, change.text
        if change.finding is not None:
            what = change.finding.check.severity.value
            text = f"{change.finding.id}: {text}"
            styles[len(rows)] = STYLES[what]
        rows.append((change.how, what, text))
    show_rows(rows, styles=styles)
    for change in found:
        if change.lines:
            out()
            out(safe_line(change.text, 500), "bold")
        for line in change.lines:  # Trust: a stranger's text
            out(f"{MARGIN}{safe_line(line, 300)}", {"+": GOOD, "-": DOUBTFUL}.get(line[:1]))
    say(f"{counted(len(found), 'change')}.", DOUBTFUL)
