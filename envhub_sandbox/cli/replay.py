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
        help="Grant what the bundle needs beyond an ordinary run: its network, readable paths, "
        "variables, limits, interpreter, packages, Hub. Only for bundles that you trust.",
    ),
]


@opt.with_options("sandbox", "profile", "python", *opt.HUB)
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
    _Replay(bundle, grant, make, as_json=json).execute()


class _Replay:
    """One ``envhub replay``."""

    def __init__(self, folder: Path, grant: bool, make: opt.MakeOptions, *, as_json: bool) -> None:
        self._folder, self._grant, self._sandbox = folder, grant, make["sandbox"]
        given = {name: value for name, value in make.given.items() if name != "sandbox"}
        self._given = {name: value for name, value in given.items() if value is not None}
        self._as_json = as_json
        self._changed: list[str] = []

    def execute(self) -> None:
        """Read, check, repeat, print; the exit code is the verdict."""
        from envhub_sandbox.session.crash.bundle_reader import load_bundle
        from envhub_sandbox.session.crash.replay import Verdict

        bundle = load_bundle(self._folder)
        self._refuse_wishes(bundle)
        for doubt in bundle.doubts:
            show("not exact", doubt, "yellow", stderr=True)
        place = bundle.arguments.get("sandbox")
        if place != self._sandbox:
            show("sandbox", f"it died in {place}; this is {self._sandbox}", "yellow", stderr=True)
        with ProgressBar(quiet=self._as_json) as bar:
            replayed = self._run(bundle, bar)
        self._print(bundle, replayed)
        codes = {Verdict.SAME: Exit.OK, Verdict.DIFFERENT: Exit.DIFFERENT}
        raise typer.Exit(codes.get(replayed.verdict, Exit.SURVIVED))

    def _refuse_wishes(self, bundle: Bundle) -> None:
        from envhub_sandbox.session.crash.bundle_reader import wishes

        wanted = [wish for wish in wishes(bundle) if wish.partition("=")[0] not in self._given]
        if wanted and not self._grant:
            raise UsageError(
                f"the bundle needs more permissions than an ordinary run: {', '.join(wanted)}. If "
                "you trust its source, add --grant"
            )

    def _run(self, bundle: Bundle, bar: ProgressBar) -> ReplayResult:
        from envhub_sandbox.session.crash.replay import replay

        bar.begin(f"loading {safe_line(bundle.label)}")
        with contextlib.ExitStack() as stack:
            return replay(lambda: self._make(bundle, bar, stack), bundle)

    def _make(self, bundle: Bundle, bar: ProgressBar, stack: contextlib.ExitStack) -> Any:
        """The environment that the bundle is about; None if it is about ``make_env`` alone."""
        from envhub_sandbox.factory.make_env import make_env
        from envhub_sandbox.session.crash.replay import changed_files
        from envhub_sandbox.session.repository import Recipe

        recipe = Recipe(
            make_env=make_env,
            reference=bundle.reference,
            config=bundle.load.cfg,
            options=self._options(bundle),
        )
        envs = stack.enter_context(recipe.make())
        self._changed = list(changed_files(bundle.files, envs.provenance["files"]))
        if self._changed:
            show("changed", ", ".join(self._changed), "yellow", stderr=True)
        if bundle.task is None:
            opt.select_envs(envs, None, None)[0][2].np_random  # noqa: B018  # starts it, and changes nothing
            return None
        bar.begin(f"repeating {len(bundle.requests)} requests")
        return self._chosen(envs, bundle.task)

    def _chosen(self, envs: Any, task: dict[str, Any]) -> Any:
        env = envs.get(task["suite"], {}).get(task["task"])
        if env is None or env.num_envs != task["num_envs"]:
            name = safe_line(f"{task['suite']} / {task['task']}")
            raise UsageError(
                f"make_env gives no {name} of {task['num_envs']} sub-environments any more, so "
                "nothing can be repeated"
            )
        return env

    def _options(self, bundle: Bundle) -> dict[str, Any]:
        from envhub_sandbox.session.crash.bundle_reader import replayed_arguments

        options = replayed_arguments(bundle, granted=self._grant)
        given = dict(self._given)
        if "profile" in given:
            options["policy"] = {**options["policy"], "profile": given.pop("profile")}
        return {**options, **given, "sandbox": self._sandbox}

    # --- what is printed -----------------------------------------------------------------------

    def _print(self, bundle: Bundle, replayed: ReplayResult) -> None:
        if self._as_json:
            print_json(self._document(bundle, replayed))
            return
        show("repository", bundle.label, "bold")
        out()
        show_rows(
            [
                ("", "request", "step", "how it ended"),
                _row("recorded", len(bundle.requests), bundle.steps, bundle.death),
                _row("replayed", replayed.requests, replayed.steps, replayed.death),
            ],
            right=(1, 2),
        )
        out()
        if replayed.note:
            show("note", replayed.note)
        out(*_CONCLUSIONS[replayed.verdict.value])

    def _document(self, bundle: Bundle, replayed: ReplayResult) -> dict[str, Any]:
        return {
            "bundle": str(self._folder),
            "label": bundle.label,
            "verdict": replayed.verdict.value,
            "changed_files": [safe_line(path) for path in self._changed],
            "doubts": list(bundle.doubts),
            "recorded": {"requests": len(bundle.requests), **bundle.death},
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
