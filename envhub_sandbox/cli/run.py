"""``envhub run``: plays episodes of an environment and prints the results."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    ProgressBar,
    out,
    print_json,
    safe_line,
    safe_text,
    say,
    says_what_is_seen,
)
from envhub_sandbox.cli.shared.exits import code_for, describe
from envhub_sandbox.cli.shared.results import (
    TaskResult,
    print_provenance,
    print_results,
    task_document,
)
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.settings.options import OPTIONS

if TYPE_CHECKING:
    from envhub_sandbox.play.episodes import EpisodeCounter

Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose",
        "-v",
        help="Log jails and downloads on stderr.",
        rich_help_panel=OPTIONS["output"].panel,
    ),
]


class ActionSource(str, Enum):
    """The source of actions."""

    RANDOM = "random"
    ZERO = "zero"


@opt.with_options(*opt.ALL)
def run(
    *,
    ref: opt.Ref,
    episodes: Annotated[
        int, typer.Option("--episodes", "-e", min=1, help="Episodes of each task, exactly.")
    ] = 10,
    actions: Annotated[
        ActionSource, typer.Option(help="Random samples, or the values nearest to zero.")
    ] = ActionSource.RANDOM,
    seed: Annotated[
        int, typer.Option("--seed", "-s", min=0, help="The same seed gives the same result.")
    ] = 0,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Stop a task after this many steps of each sub-environment."),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="out.mp4",
            help="Write what the first sub-environment renders; with several tasks out-1.mp4, "
            "out-2.mp4 and so on.",
        ),
    ] = None,
    json: opt.Json = False,
    verbose: Verbose = False,
    suite: opt.Suite = None,
    task: opt.Task = None,
    make: opt.MakeOptions,
) -> None:
    """Play episodes of an environment and print returns, lengths, speed and provenance.

    The repository's code runs in a separate, confined process; see 'envhub doctor'.

    [bold]envhub run ./examples/cartpole --episodes 20 --n-envs 4 --video cartpole.mp4[/bold]
    """
    with _logged(verbose=verbose, worker_output=make.typed["output"]):
        _Run(
            make=make,
            episodes=episodes,
            actions=actions.value,
            seed=seed,
            steps=steps,
            video=video,
            suites=suite,
            tasks=task,
            as_json=json,
        ).execute()


@dataclass(kw_only=True)
class _Run:
    """One ``envhub run``. Tasks run one after the other, each closed before the next begins."""

    make: opt.MakeOptions
    episodes: int
    actions: str
    seed: int
    steps: int | None
    video: Path | None
    suites: list[str] | None
    tasks: list[str] | None
    as_json: bool
    results: list[TaskResult] = field(default_factory=list)
    provenance: dict[str, Any] | None = None
    begun: float = field(default_factory=time.perf_counter)
    make_env_s: float | None = None

    def execute(self) -> None:
        """Run and print the results, also those before an error; then raise the error."""
        try:
            if self.video is not None:
                from envhub_sandbox.play.video import check_target

                check_target(self.video)
            with ProgressBar(quiet=self.as_json) as bar, says_what_is_seen(), self.make.explained():
                self._run(bar)
        except EnvHubError as error:
            self._print(error)
            raise
        self._print(None)

    def _run(self, bar: ProgressBar) -> None:
        arguments = self.make.arguments()
        bar.begin(f"loading {self.make.ref}")
        from envhub_sandbox.factory.make_env import make_env

        with make_env(**arguments) as envs:
            self.make_env_s = time.perf_counter() - self.begun
            try:
                chosen = opt.select_envs(envs, self.suites, self.tasks)
                for number, (suite, task, env) in enumerate(chosen, start=1):
                    video = self.video
                    if video is not None and len(chosen) > 1:
                        video = video.with_stem(f"{video.stem}-{number}")
                    bar.begin(f"{suite} / {task}", self.episodes)
                    self.results.append(self._play_task(bar, suite, task, env, video))
                    env.close()
            finally:
                self.provenance = envs.provenance

    def _play_task(
        self, bar: ProgressBar, suite: str, task: int | str, env: Any, video: Path | None
    ) -> TaskResult:
        from envhub_sandbox.play.episodes import autoreset_mode, rollout
        from envhub_sandbox.play.video import fps_of, frame_of, video_writer

        add: Callable[[Any], None] | None = None

        def observe(counter: EpisodeCounter) -> None:
            nonlocal add
            if add is not None:
                add(frame_of(env))
                if not counter.wants(0):  # the video has the last episode's last frame
                    add = None
            bar.update(counter)

        with contextlib.ExitStack() as stack:
            if video is not None:
                add = stack.enter_context(video_writer(video, fps_of(env.metadata)))
            played = rollout(
                env,
                episodes=self.episodes,
                seed=self.seed,
                actions=self.actions,
                max_steps=self.steps,
                observe=observe,
            )
        return TaskResult(
            suite=suite,
            task=task,
            num_envs=env.num_envs,
            autoreset_mode=autoreset_mode(env),
            rollout=played,
            video=None if video is None else str(video),
        )

    # --- what is printed -----------------------------------------------------------------------

    def _print(self, error: EnvHubError | None) -> None:
        if not self.as_json:
            if self.results:
                self._print_text()
            return
        document: dict[str, Any] = {
            "reference": self.make.ref,
            "sandbox": self.make.typed["sandbox"],
            "actions": self.actions,
            "seed": self.seed,
            "episodes": self.episodes,
            "make_env_s": self.make_env_s,
            "time_to_first_step_s": self._time_to_first_step(),
            "tasks": [task_document(result) for result in self.results],
            "provenance": self.provenance,
            "error": None,
        }
        if error is not None:
            document["error"] = {
                "type": type(error).__name__,
                "message": describe(error),
                "exit_code": int(code_for(error)),
                "bundle": getattr(error, "bundle", None),
            }
        print_json(document)

    def _time_to_first_step(self) -> float | None:
        if self.make_env_s is None or not self.results:
            return None
        return self.make_env_s + self.results[0].rollout.first_step_s

    def _print_text(self) -> None:
        print_results(self.results)
        out()
        if self.provenance is not None:
            print_provenance(self.provenance, in_process=self.make.in_process)
        out(
            f"{self.actions} actions, seed {self.seed}, --n-envs {self.make.typed['n_envs']}; "
            f"first step after {self._time_to_first_step():.2f} s",
            "dim",
        )
        for result in self.results:
            if result.video is not None:
                out(f"wrote {safe_line(result.video)}")
        stopped = [result for result in self.results if not result.rollout.complete]
        if stopped:
            say(f"{len(stopped)} of {len(self.results)} tasks were stopped by --steps.")


# --- logs on stderr for --verbose and --worker-output ------------------------------------------


class _SafeFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return safe_text(super().format(record))


@contextlib.contextmanager
def _logged(*, verbose: bool, worker_output: str | None) -> Iterator[None]:
    """Within this context, show logs on stderr."""
    from envhub_sandbox.system.log import MESSAGES, OUTPUT, ROOT

    with contextlib.ExitStack() as shown:
        if verbose:
            handler = _show(shown, ROOT, "%(asctime)s %(message)s")
            handler.addFilter(lambda record: record.name not in (OUTPUT.name, MESSAGES.name))
            shown.callback(OUTPUT.setLevel, OUTPUT.level)
            OUTPUT.setLevel(logging.INFO)  # otherwise no jail's output is read
        if worker_output == "-":
            _show(shown, OUTPUT, "%(message)s")
        yield


def _show(shown: contextlib.ExitStack, logger: logging.Logger, form: str) -> logging.Handler:
    handler = logging.StreamHandler()
    handler.setFormatter(_SafeFormatter(form, "%H:%M:%S"))
    shown.callback(logger.setLevel, logger.level)
    shown.callback(logger.removeHandler, handler)
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    return handler
