"""``envhub replay``: repeats a crash bundle's requests and reports whether the jail dies again."""

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
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError

if TYPE_CHECKING:
    from envhub_sandbox.extras.crash.bundle_reader import Bundle
    from envhub_sandbox.extras.crash.replay import ReplayResult

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
        help="Replay a bundle that may be a stranger's, with its repository, policy, interpreter, "
        "packages and Hub. Only for bundles that you trust.",
    ),
]


@opt.with_options("sandbox", "profile", "python", *opt.SOURCE)
def replay(
    *, bundle: BundleFolder, grant: Grant = False, json: opt.Json = False, make: opt.MakeOptions
) -> None:
    """Repeat the requests of a crash bundle, and report whether it dies in the same way.

    It uses the same commit, seeds and actions, so an environment that depends on nothing else dies
    at the same step. Exit code 0: it died in the same way; 7: it died in another way or at another
    request; 8: it did not die.

    [bold]envhub replay ~/.cache/envhub-sandbox/crashes/20261121T081500-5f3a9c01[/bold]
    """
    from envhub_sandbox.extras.crash import bundle_reader
    from envhub_sandbox.extras.crash import replay as repeating

    sandbox, loaded = make["sandbox"], bundle_reader.load_bundle(bundle)
    given = {
        name: value for name, value in make.typed.items() if name != "sandbox" and value is not None
    }
    if not (grant or loaded.is_ours):
        raise UsageError(
            "the bundle may be a stranger's. If you trust its source, add --grant: a replay uses "
            f"{bundle_reader.wishes(loaded)}"
        )
    if (died_in := loaded.arguments.get("sandbox", "process")) != sandbox:
        show("sandbox", f"it died in {died_in}; this is {sandbox}", "yellow", stderr=True)
    options = bundle_reader.replayed_arguments(loaded) | {**given, "sandbox": sandbox}
    if "profile" in given:
        options["policy"] |= {"profile": options.pop("profile")}
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


def _made(
    bundle: Bundle,
    options: dict[str, Any],
    bar: ProgressBar,
    stack: contextlib.ExitStack,
    changed: list[str],
) -> Any:
    """Makes the bundle's environment; None if the jail died in ``make_env``."""
    from envhub_sandbox.extras.crash.replay import changed_files
    from envhub_sandbox.factory.make_env import make_env
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
    if bundle.task["single"]:
        env._apart(single=True)
    return env


def _print(bundle: Bundle, replayed: ReplayResult) -> None:
    show("repository", bundle.label, "bold")
    show("recorded", _row(bundle.count, bundle.steps, bundle.death))
    show("replayed", _row(replayed.requests, replayed.steps, replayed.death))
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


def _row(requests: int, steps: int, death: dict[str, Any] | None) -> str:
    """Describes an ending in few words. Trust: text from the bundle or the worker."""
    words = "nothing died" if death is None else safe_line(death["reason"], 100)
    if death is not None and death["signal"]:
        words += f" ({safe_line(death['signal'], 100)})"
    elif death is not None and death["exit_code"] is not None:
        words += f" (exit code {death['exit_code']})"
    return f"request {requests}, step {steps}: {words}" if requests else f"in make_env: {words}"
