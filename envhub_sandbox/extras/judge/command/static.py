"""``envhub inspect --static``: shows the content of a repository without running it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, print_json, show
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.extras.judge import reports
from envhub_sandbox.extras.judge.command.findings import level, show_finding, write_report
from envhub_sandbox.extras.judge.contents import LARGE
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.settings import folder_below_here, no_report_but_ours
from envhub_sandbox.extras.judge.static import Static, document, static
from envhub_worker.protocol.text import size_text

_SHOWN = 40
_PLAIN = ("Python", "text")


def inspect_static(
    ref: str, *, as_json: bool, sarif: Path | None, fail_on: str | None, make: opt.MakeOptions
) -> None:
    """Read a repository and print a description of its content."""
    least = None if fail_on is None else level(fail_on)
    with no_report_but_ours([sarif], ref):
        with ProgressBar(quiet=as_json) as bar:
            bar.begin(f"reading {ref}")
            read = static(make.snapshot(ref))
        failures = [
            finding for finding in read.findings if least and finding.check.severity.reaches(least)
        ]
        if sarif is not None:
            report = Report(read.reference, read.findings, folder=folder_below_here(ref))
            write_report(sarif, reports.sarif(report, failures), [read.reference])
    if as_json:
        print_json(document(read))
    else:
        _print_static(read)
    if failures:
        raise typer.Exit(Exit.ENVIRONMENT)


def _print_static(read: Static) -> None:
    show("repository", read.reference, "bold")
    for text, line in read.entries:
        show("entry", f"{read.snapshot.path}:{line}: make_env({text})")
    if not read.entries:
        show("entry", f"{read.snapshot.path}: no make_env is written at its top")
    _print_packages(read)
    _print_files(read)
    for finding in read.findings:
        show_finding(finding)
    if not read.findings:
        show("findings", "none")


def _print_packages(read: Static) -> None:
    says = read.declared
    if says is None:
        show("packages", "it declares none")
    else:
        python = f", for Python {says.python}" if says.python else ""
        show("packages", f"{len(says.wanted)} in {says.source}{python}")
    for package in says.wanted if says else ():
        show("  package", str(package))
    for name, imported in sorted(read.modules.items()):
        note = "" if read.is_brought(name) else ", and no package of that name is declared"
        show("  import", f"{name}: {imported.file}:{imported.line}{note}")


def _print_files(read: Static) -> None:
    kinds = Counter(file.kind for file in read.files)
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    total = size_text(sum(file.record.size for file in read.files))
    show("files", f"{len(read.files)}, {total}: {counts}")
    # large and binary files first: a reader would miss them among the others
    odd = [file for file in read.files if file.record.size >= LARGE or file.kind not in _PLAIN]
    rest = [file for file in read.files if file not in odd]
    for file in (shown := [*odd, *rest][:_SHOWN]):
        large = ", large" if file.record.size >= LARGE else ""
        show("  file", f"{file.record.path}: {file.kind}, {size_text(file.record.size)}{large}")
    if len(shown) < len(read.files):
        show("  file", f"and {len(read.files) - len(shown)} more, which --json has")
