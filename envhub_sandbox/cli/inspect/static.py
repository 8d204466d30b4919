"""``envhub inspect --static``: what a repository would do, read without running it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from envhub_sandbox.cli.shared.console import print_json, show
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.cli.shared.findings import level, show_finding, write_report
from envhub_sandbox.cli.shared.options import MakeOptions, is_typed
from envhub_sandbox.cli.shared.progress import ProgressBar
from envhub_worker.protocol.text import size_text

if TYPE_CHECKING:
    from envhub_sandbox.check.findings import Finding
    from envhub_sandbox.check.static.static import Static
    from envhub_sandbox.hub.snapshot import Snapshot

_SHOWN = 40
_OF_STATIC = {"sarif", "fail_on"}
_OF_BOTH = {"ref", "static", "json", "token", "endpoint", "hub_cache_dir", "debug"}
_PLAIN = ("Python", "text")


def check_options(context: typer.Context, *, static: bool) -> None:
    """Refuse options that would mean nothing. Raises ``UsageError``: there is one."""
    means = _OF_BOTH | _OF_STATIC if static else set(context.params) - _OF_STATIC
    for one in context.command.params:
        if one.name not in means and is_typed(context, one.name or ""):
            why = "with --static nothing runs" if static else "it needs --static"
            raise UsageError(f"{one.opts[0]} means nothing here: {why}")


def inspect_static(
    ref: str,
    *,
    as_json: bool,
    sarif: Path | None,
    fail_on: str | None,
    make: MakeOptions,
) -> None:
    """Read a repository, and say what is in it."""
    least = None if fail_on is None else level(fail_on)
    with ProgressBar(quiet=as_json) as bar:
        bar.begin(f"reading {ref}")
        from envhub_sandbox.check.static.static import document, static

        snapshot = make.snapshot(ref)
        read = static(snapshot)
    failures = [one for one in read.findings if least and one.check.severity.reaches(least)]
    if sarif is not None:
        _write(sarif, snapshot, read.findings, failures)
    if as_json:
        print_json(document(read))
    else:
        _print(read)
    if failures:
        raise typer.Exit(Exit.ENVIRONMENT)


def _write(
    path: Path, snapshot: Snapshot, findings: Sequence[Finding], failures: list[Finding]
) -> None:
    from envhub_sandbox.check import reports
    from envhub_sandbox.check.findings import Report
    from envhub_sandbox.session.recipe import pinned

    write_report(path, reports.sarif(Report(pinned(snapshot), list(findings)), failures))


def _print(read: Static) -> None:
    show("repository", read.reference, "bold")
    for text, line in read.entries:
        show("entry", f"{read.snapshot.path}:{line}: make_env({text})")
    if not read.entries:
        show("entry", f"{read.snapshot.path}: no make_env is written at its top")
    _print_packages(read)
    _print_files(read)
    for one in read.findings:
        show_finding(one)
    if not read.findings:
        show("findings", "nothing that is worth a look")


def _print_packages(read: Static) -> None:
    says = read.declared
    if says is None:
        show("packages", "it declares none")
    else:
        python = f", for Python {says.python}" if says.python else ""
        show("packages", f"{len(says.wanted)} in {says.source}{python}")
    for one in says.wanted if says else ():
        show("  package", str(one))
    for name, place in sorted(read.modules.items()):
        known = "" if read.is_brought(name) else ", and no package of that name is declared"
        show("  import", f"{name}: {place.file}:{place.line}{known}")


def _print_files(read: Static) -> None:
    from envhub_sandbox.check.static.contents import LARGE

    kinds = Counter(one.kind for one in read.files)
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    total = size_text(sum(one.record.size for one in read.files))
    show("files", f"{len(read.files)}, {total}: {counts}")
    # first what is large or no text: a reader would miss it
    odd = [one for one in read.files if one.record.size >= LARGE or one.kind not in _PLAIN]
    rest = [one for one in read.files if one not in odd]
    for one in (shown := [*odd, *rest][:_SHOWN]):
        large = ", large" if one.record.size >= LARGE else ""
        show("  file", f"{one.record.path}: {one.kind}, {size_text(one.record.size)}{large}")
    if len(shown) < len(read.files):
        show("  file", f"and {len(read.files) - len(shown)} more, which --json has")
