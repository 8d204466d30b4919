"""``envhub inspect``: the environments that a repository makes, without playing them.

With ``--static``: what it would do, read without running it. With ``--download``: for later use
without network.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, out, print_json, safe_line, show
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.cli.shared.findings import FailOn, level, show_finding, write_report
from envhub_sandbox.cli.shared.results import print_provenance
from envhub_worker.protocol.text import size_text

if TYPE_CHECKING:
    from envhub_sandbox.check.static import Static

_SPACES = ("single_observation_space", "single_action_space", "observation_space", "action_space")
_SPACE_TEXT = 2000
_SHOWN = 40
_OF_STATIC = {"sarif", "fail_on"}
_OF_DOWNLOAD = {"upgrade", "dependencies", "lock", "assets"}
_OF_ALL = {"ref", "json", "token", "endpoint", "hub_cache_dir", "allow_secrets", "debug"}
_PLAIN = ("Python", "text")
_OPTIONS = [key for key in opt.ALL if key not in ("num_workers", "output")]


@opt.with_options(*_OPTIONS)
def inspect(
    *,
    context: typer.Context,
    ref: opt.Ref,
    static: Annotated[
        bool, typer.Option("--static", help="Read the repository as data, and run nothing.")
    ] = False,
    sarif: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --static: the findings as SARIF 2.1.0."),
    ] = None,
    fail_on: FailOn = None,
    download: Annotated[
        bool,
        typer.Option(
            "--download",
            help="Only download it and install its packages; the printed reference then works "
            "without network.",
        ),
    ] = False,
    upgrade: Annotated[
        bool,
        typer.Option(
            "--upgrade", help="With --download: choose versions again, the newest that fit."
        ),
    ] = False,
    json: opt.Json = False,
    suite: opt.Suite = None,
    task: opt.Task = None,
    make: opt.MakeOptions,
) -> None:
    """Print suites, tasks, spaces, metadata and provenance, without stepping anything.

    The repository's make_env runs in the sandbox, unless its answer is cached. With --static
    nothing runs: files, entry, packages and imports are read as data, and findings are printed.
    With --download nothing of the repository runs either.
    """
    _check_options(context, static=static, download=download)
    if download:
        from envhub_sandbox.cli.download import download as download_all

        download_all(make, upgrade=upgrade, as_json=json)
        return
    if static:
        inspect_static(ref, as_json=json, sarif=sarif, fail_on=fail_on, make=make)
        return
    arguments = make.arguments()
    from envhub_sandbox.factory.make_env import make_env

    with ProgressBar(quiet=json) as bar, make.explained():
        bar.begin(f"loading {make.ref} in a sandbox")
        with make_env(**arguments) as envs:
            found = [describe_env(*item) for item in opt.select_envs(envs, suite, task)]
            provenance = envs.provenance
    if json:
        print_json({"reference": make.ref, "envs": found, "provenance": provenance})
    else:
        _print(found, provenance, in_process=make.in_process)


def describe_env(suite: str, task: Any, env: Any) -> dict[str, Any]:
    """One environment as data. Trust: all of it is input from the worker."""
    from envhub_sandbox.check.play.episodes import autoreset_mode

    metadata = dict(getattr(env, "metadata", None) or {})
    metadata.pop("autoreset_mode", None)
    spec = getattr(env, "spec", None)
    return {
        "suite": safe_line(suite),
        "task": task if isinstance(task, int) else safe_line(task),
        "num_envs": env.num_envs,
        "spec_id": None if spec is None else safe_line(spec.id),
        "autoreset_mode": autoreset_mode(env),
        "render_mode": env.render_mode and safe_line(env.render_mode),
        "metadata": metadata,
        **{name: safe_line(getattr(env, name), _SPACE_TEXT) for name in _SPACES},
    }


def _print(found: list[dict[str, Any]], provenance: dict[str, Any], *, in_process: bool) -> None:
    for env in found:
        title = f"{env['suite']} / {env['task']}"
        out(title if env["spec_id"] is None else f"{title}  ({env['spec_id']})", "bold")
        lines = {
            "sub-environments": env["num_envs"],
            "observations": env["single_observation_space"],
            "actions": env["single_action_space"],
            "autoreset mode": env["autoreset_mode"] or "not stated",
            "render mode": env["render_mode"] or "None",
        }
        for name, value in (*lines.items(), *env["metadata"].items()):
            show(f"  {safe_line(name, 40):17}", value)
    out()
    print_provenance(provenance, in_process=in_process)


# --- --static ---------------------------------------------------------------------------------


def _check_options(context: typer.Context, *, static: bool, download: bool) -> None:
    """Refuse options that would mean nothing. Raises ``UsageError``: there is one."""
    if static:
        means, why = _OF_ALL | _OF_STATIC | {"static"}, "with --static nothing runs"
    elif download:
        means, why = _OF_ALL | _OF_DOWNLOAD | {"download"}, "--download does not run the repository"
    else:
        means = set(context.params) - _OF_STATIC - {"upgrade"}
        why = "it needs --static or --download"
    for one in context.command.params:
        if one.name not in means and opt.is_typed(context, one.name or ""):
            raise UsageError(f"{one.opts[0]} means nothing here: {why}")


def inspect_static(
    ref: str,
    *,
    as_json: bool,
    sarif: Path | None,
    fail_on: str | None,
    make: opt.MakeOptions,
) -> None:
    """Read a repository, and say what is in it."""
    least = None if fail_on is None else level(fail_on)
    from envhub_sandbox.check.settings import folder_below_here, no_report_but_ours

    with no_report_but_ours([sarif], ref):
        with ProgressBar(quiet=as_json) as bar:
            bar.begin(f"reading {ref}")
            from envhub_sandbox.check import reports
            from envhub_sandbox.check.findings import Report
            from envhub_sandbox.check.static import document, static

            read = static(make.snapshot(ref))
        failures = [one for one in read.findings if least and one.check.severity.reaches(least)]
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
    for one in read.findings:
        show_finding(one)
    if not read.findings:
        show("findings", "none")


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
    from envhub_sandbox.check.contents import LARGE

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
