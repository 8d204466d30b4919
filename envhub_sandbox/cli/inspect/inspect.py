"""``envhub inspect``: the environments that a repository makes, without playing them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.inspect.static import check_options, inspect_static
from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, print_json, safe_line, show
from envhub_sandbox.cli.shared.findings import FailOn
from envhub_sandbox.cli.shared.progress import ProgressBar
from envhub_sandbox.cli.shared.results import print_provenance

_SPACES = ("single_observation_space", "single_action_space", "observation_space", "action_space")
_SPACE_TEXT = 2000


_OPTIONS = [key for key in opt.ALL if key not in ("num_workers", "validate", "output")]


@opt.with_options(*_OPTIONS)
def inspect(
    *,
    context: typer.Context,
    ref: opt.Ref,
    static: Annotated[
        bool, typer.Option("--static", help="Read the repository instead, and run nothing of it.")
    ] = False,
    sarif: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --static: SARIF 2.1.0 of what is worth a look."),
    ] = None,
    fail_on: FailOn = None,
    json: opt.Json = False,
    suite: opt.Suite = None,
    task: opt.Task = None,
    make: opt.MakeOptions,
) -> None:
    """Print suites, tasks, spaces, metadata and provenance, without stepping anything.

    The repository's make_env runs (in the sandbox) unless its answer is remembered. With --static
    nothing runs: files, entry, packages, imports, and what is worth a look are read.
    """
    check_options(context, static=static)
    if static:
        inspect_static(ref, as_json=json, sarif=sarif, fail_on=fail_on, make=make)
        return
    _inspect(make, suite, task, as_json=json)


def _inspect(
    make: opt.MakeOptions, suites: list[str] | None, tasks: list[str] | None, *, as_json: bool
) -> None:
    arguments = make.arguments()
    from envhub_sandbox.factory.make_env import make_env

    with ProgressBar(quiet=as_json) as bar, make.explained():
        bar.begin(f"loading {make.ref} in a sandbox")
        with make_env(**arguments) as envs:
            found = [describe_env(*item) for item in opt.select_envs(envs, suites, tasks)]
            provenance = envs.provenance
    if as_json:
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
            show(f"  {safe_line(name, 40)}", value, width=19)
    out()
    print_provenance(provenance, in_process=in_process)
