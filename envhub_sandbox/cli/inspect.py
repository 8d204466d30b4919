"""``envhub inspect``: the environments that a repository makes, without playing them.

With ``--static`` it reads the repository without running it. With ``--download`` it downloads
repository and packages for later use without network.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, out, print_json, safe_line, show
from envhub_sandbox.cli.shared.exits import UsageError
from envhub_sandbox.cli.shared.results import print_provenance
from envhub_sandbox.system import extras

_SPACES = ("single_observation_space", "single_action_space", "observation_space", "action_space")
_SPACE_TEXT = 2000
_OF_STATIC = {"sarif", "fail_on"}
_OF_DOWNLOAD = {"upgrade", "dependencies", "lock", "assets"}
_OF_ALL = {"ref", "json", "token", "endpoint", "hub_cache_dir", "allow_secrets", "debug"}
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
    fail_on: opt.FailOn = None,
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
        download_all = extras.required(
            "envhub_sandbox.extras.packages.commands.download", "download", "--download"
        )
        download_all(make, upgrade=upgrade, as_json=json)
        return
    if static:
        read = extras.required(
            "envhub_sandbox.extras.judge.command.static", "inspect_static", "--static"
        )
        read(ref, as_json=json, sarif=sarif, fail_on=fail_on, make=make)
        return
    arguments = make.arguments()
    from envhub_sandbox.factory.make_env import make_env

    with ProgressBar(quiet=json) as bar, make.explained():
        bar.begin(f"loading {make.ref} in a sandbox")
        with make_env(**arguments) as envs:
            described = [describe_env(*item) for item in opt.select_envs(envs, suite, task)]
            provenance = envs.provenance
    if json:
        print_json({"reference": make.ref, "envs": described, "provenance": provenance})
    else:
        _print(described, provenance, in_process=make.in_process)


def describe_env(suite: str, task: Any, env: Any) -> dict[str, Any]:
    """Describe an environment as data. Trust: all of it is input from the worker."""
    from envhub_sandbox.play.episodes import autoreset_mode

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


def _print(envs: list[dict[str, Any]], provenance: dict[str, Any], *, in_process: bool) -> None:
    for env in envs:
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


def _check_options(context: typer.Context, *, static: bool, download: bool) -> None:
    """Raise ``UsageError`` if an option has no meaning with the others."""
    if static:
        means, why = _OF_ALL | _OF_STATIC | {"static"}, "with --static nothing runs"
    elif download:
        means, why = _OF_ALL | _OF_DOWNLOAD | {"download"}, "--download does not run the repository"
    else:
        means = set(context.params) - _OF_STATIC - {"upgrade"}
        why = "it needs --static or --download"
    for parameter in context.command.params:
        if parameter.name not in means and opt.is_typed(context, parameter.name or ""):
            raise UsageError(f"{parameter.opts[0]} means nothing here: {why}")
