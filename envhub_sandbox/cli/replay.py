"""``envhub replay``: repeat what a crash bundle holds, and say whether the jail dies again."""

from __future__ import annotations

import contextlib
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
    show,
    show_rows,
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.errors import RepositoryUnavailableError

if TYPE_CHECKING:
    from envhub_sandbox.session.crash.bundle_reader import Bundle
    from envhub_sandbox.session.crash.replay import ReplayResult

BundleFolder = Annotated[
    Path,
    typer.Argument(
        metavar="BUNDLE",
        help="The folder of a crash bundle, which the error of the death names.",
        show_default=False,
    ),
]
Grant = Annotated[
    bool,
    typer.Option(
        "--grant",
        help="Use the bundle's own policy, limits, timeouts, interpreter, packages and Hub, where "
        "they differ from an ordinary run. Only for bundles that you trust.",
    ),
]


@opt.with_options("sandbox", "profile", "python", *opt.SOURCE)
def replay(
    *,
    bundle: BundleFolder,
    grant: Grant = False,
    json: opt.Json = False,
    make: opt.MakeOptions,
) -> None:
    """Repeat the requests of a crash bundle, and report whether it dies in the same way.

    It uses the same commit, seeds and actions, so an environment that depends on nothing else dies
    at the same step. Exit code 0: it died in the same way; 7: it died in another way or at another
    request; 8: it did not die.

    [bold]envhub replay ~/.cache/envhub-sandbox/crashes/20261121T081500-5f3a9c01[/bold]
    """
    from envhub_sandbox.hub.snapshot import is_here
    from envhub_sandbox.session.crash import bundle_reader
    from envhub_sandbox.session.crash import replay as repeating

    sandbox, loaded = make["sandbox"], bundle_reader.load_bundle(bundle)
    given = {
        name: value for name, value in make.given.items() if name != "sandbox" and value is not None
    }
    wishes = bundle_reader.wishes(loaded)
    wanted = [wish for wish in wishes if wish.partition("=")[0] not in given]
    if wanted and not grant:
        raise UsageError(
            f"the bundle needs more than an ordinary run: {', '.join(wanted)}. If you trust its "
            "source, add --grant"
        )
    for doubt in loaded.doubts:
        show("not exact", doubt, "yellow", stderr=True)
    options = bundle_reader.replayed_arguments(loaded, granted=grant)
    if "profile" in given:
        options["policy"] = {**options["policy"], "profile": given.pop("profile")}
    options |= {**given, "sandbox": sandbox}
    hub = {name: options[name] for name in opt.SOURCE if name in options}
    if not (grant or loaded.is_ours or "token" in given or is_here(loaded.reference)):
        _require_public(loaded, hub)
    changed: list[str] = []
    with ProgressBar(quiet=json) as bar, contextlib.ExitStack() as stack:
        bar.begin(f"loading {safe_line(loaded.label)}")
        replayed = repeating.replay(lambda: _made(loaded, options, bar, stack, changed), loaded)
    if json:
        print_json(_document(bundle, loaded, replayed, changed))
    else:
        _print(loaded, replayed)
    codes = {repeating.Verdict.SAME: Exit.OK, repeating.Verdict.DIFFERENT: Exit.DIFFERENT}
    raise typer.Exit(codes.get(replayed.verdict, Exit.SURVIVED))


def _require_public(bundle: Bundle, hub: dict[str, Any]) -> None:
    """Refuse a repository that only the user's login brings: a stranger may have named it."""
    from envhub_sandbox.hub.snapshot import snapshot_named

    try:
        snapshot_named(bundle.reference, **hub, public=True)
    except RepositoryUnavailableError as error:
        why = "What a bundle names is had without a login. If you trust its source, add --grant"
        error.args = (f"{error}\n{why}",)
        raise


def _made(
    bundle: Bundle,
    options: dict[str, Any],
    bar: ProgressBar,
    stack: contextlib.ExitStack,
    changed: list[str],
) -> Any:
    """The environment that the bundle is about; None if it is about ``make_env`` alone."""
    from envhub_sandbox.factory.make_env import make_env
    from envhub_sandbox.session.crash.replay import changed_files
    from envhub_sandbox.session.repository import Recipe

    recipe = Recipe(
        make_env=make_env, reference=bundle.reference, config=bundle.load.cfg, options=options
    )
    envs = stack.enter_context(recipe.make())
    changed += changed_files(bundle.files, envs.provenance["files"])
    if changed:
        show("changed", ", ".join(changed), "yellow", stderr=True)
    if bundle.task is None:
        opt.select_envs(envs, None, None)[0][2].np_random  # noqa: B018  # starts it, and changes nothing
        return None
    bar.begin(f"repeating {bundle.count} requests")
    suite, task = bundle.task["suite"], bundle.task["task"]
    env = envs.get(suite, {}).get(task)
    if env is None or env.num_envs != bundle.task["num_envs"]:
        raise UsageError(
            f"make_env gives no {safe_line(f'{suite} / {task}')} of {bundle.task['num_envs']} "
            "sub-environments any more, so nothing can be repeated"
        )
    return env


def _print(bundle: Bundle, replayed: ReplayResult) -> None:
    show("repository", bundle.label, "bold")
    out()
    show_rows(
        [
            ("", "request", "step", "how it ended"),
            _row("recorded", bundle.count, bundle.steps, bundle.death),
            _row("replayed", replayed.requests, replayed.steps, replayed.death),
        ],
        right=(1, 2),
    )
    out()
    if replayed.note:
        show("note", replayed.note)
    out(*_CONCLUSIONS[replayed.verdict.value])


def _document(
    folder: Path, bundle: Bundle, replayed: ReplayResult, changed: list[str]
) -> dict[str, Any]:
    return {
        "bundle": str(folder),
        "label": bundle.label,
        "verdict": replayed.verdict.value,
        "changed_files": [safe_line(path) for path in changed],
        "doubts": list(bundle.doubts),
        "recorded": {"requests": bundle.count, **bundle.death},
        "replayed": {
            "requests": replayed.requests,
            "steps": replayed.steps,
            "death": replayed.death,
            "note": replayed.note,
        },
    }


_CONCLUSIONS = {
    "same": ("It died again, in the same way and at the same request.", GOOD),
    "different": ("It ended in another way, or at another request.", BAD),
    "survived": ("It did not die.", DOUBTFUL),
}


def _row(run: str, requests: int, steps: int, death: dict[str, Any] | None) -> tuple[str, ...]:
    ended = "nothing died" if death is None else _how(death)
    where = (str(requests), str(steps)) if requests else ("-", "-")
    return (run, *where, ended if requests else f"{ended}, in make_env")


def _how(death: dict[str, Any]) -> str:
    """An ending in few words. Trust: from the bundle, or from the worker."""
    words = safe_line(death["reason"], 100)
    if death["signal"]:
        words += f" ({safe_line(death['signal'], 100)})"
    elif death["exit_code"] is not None:
        words += f" (exit code {death['exit_code']})"
    return words
