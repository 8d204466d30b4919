"""``envhub run``: roll an environment out, and say what happened."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import logs
from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, print_json, safe_line, say
from envhub_sandbox.cli.shared.exits import code_for, describe
from envhub_sandbox.cli.shared.progress import Bar
from envhub_sandbox.cli.shared.report import (
    TaskResult,
    print_provenance,
    print_results,
    task_document,
)
from envhub_sandbox.errors import EnvHubError

if TYPE_CHECKING:
    from envhub_sandbox.rollouts.episodes import EpisodeCounter, Rollout
    from envhub_sandbox.rollouts.video import VideoWriter


class PolicyName(str, Enum):
    """Where actions come from."""

    RANDOM = "random"
    ZERO = "zero"


@opt.with_options(*opt.ALL)
def run(
    *,
    ref: opt.Ref,
    episodes: Annotated[
        int, typer.Option("--episodes", "-e", min=1, help="Episodes of each task, exactly.")
    ] = 10,
    policy: Annotated[
        PolicyName, typer.Option(help="Actions: sampled, or as near to zero as can be.")
    ] = PolicyName.RANDOM,
    seed: Annotated[
        int, typer.Option("--seed", "-s", min=0, help="The same seed gives the same result.")
    ] = 0,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Give up on a task after so many steps of each sub-environment."),
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
    verbose: logs.Verbose = False,
    suite: opt.Suite = None,
    task: opt.Task = None,
    make: opt.MakeOptions,
) -> None:
    """Play episodes of an environment and print returns, lengths, speed and provenance.

    The repository's code runs in a confined process of its own; see 'envhub doctor'.

    [bold]envhub run ./examples/cartpole --episodes 20 --n-envs 4 --video cartpole.mp4[/bold]
    """
    with logs.logged(verbose=verbose, worker_output=make.given["output"]):
        play = Play(episodes=episodes, policy=policy.value, seed=seed, steps=steps, video=video)
        _Run(make, play, suite, task, as_json=json).execute()


@dataclass(frozen=True, kw_only=True)
class Play:
    """What is played, as the options say."""

    episodes: int
    policy: str
    seed: int
    steps: int | None
    video: Path | None


class _Run:
    """One ``envhub run``. Tasks run one after the other, each closed before the next begins."""

    def __init__(
        self,
        make: opt.MakeOptions,
        play: Play,
        suites: list[str] | None,
        tasks: list[str] | None,
        *,
        as_json: bool,
    ) -> None:
        self._make, self._play = make, play
        self._suites, self._tasks = suites, tasks
        self._as_json = as_json
        self._results: list[TaskResult] = []
        self._provenance: dict[str, Any] | None = None
        self._begun = time.perf_counter()
        self._make_env_s: float | None = None

    def execute(self) -> None:
        """Run, print what there is to print even if it fails midway, and raise what failed."""
        try:
            self._check_video()
            with Bar(quiet=self._as_json) as bar, self._make.explained():
                self._run(bar)
        except EnvHubError as error:
            self._print(error)
            raise
        self._print(None)

    def _check_video(self) -> None:
        if self._play.video is not None:
            from envhub_sandbox.rollouts.video import check_target

            check_target(self._play.video)

    def _run(self, bar: Bar) -> None:
        arguments = self._make.arguments()
        bar.begin(f"loading {self._make.ref}")
        from envhub_sandbox.api import make_env

        with make_env(**arguments) as envs:
            self._make_env_s = time.perf_counter() - self._begun
            try:
                chosen = opt.select(envs, self._suites, self._tasks)
                for number, (suite, task, env) in enumerate(chosen, start=1):
                    video = self._video_path(number, len(chosen))
                    bar.begin(f"{suite} / {task}", self._play.episodes)
                    self._results.append(self._play_task(bar, suite, task, env, video))
                    env.close()
            finally:
                self._provenance = envs.provenance

    def _play_task(
        self, bar: Bar, suite: str, task: int | str, env: Any, video: Path | None
    ) -> TaskResult:
        from envhub_sandbox.rollouts.episodes import autoreset_mode

        if video is None:
            rollout = self._roll_out(env, bar, None)
        else:
            from envhub_sandbox.rollouts.video import VideoWriter, fps_of

            with VideoWriter(video, fps_of(env.metadata)) as writer:
                rollout = self._roll_out(env, bar, writer)
        return TaskResult(
            suite=suite,
            task=task,
            num_envs=env.num_envs,
            autoreset_mode=autoreset_mode(env),
            rollout=rollout,
            video=None if video is None else str(video),
        )

    def _roll_out(self, env: Any, bar: Bar, writer: VideoWriter | None) -> Rollout:
        from envhub_sandbox.rollouts.episodes import rollout
        from envhub_sandbox.rollouts.video import frame_of

        filming = writer is not None

        def observe(counter: EpisodeCounter) -> None:
            nonlocal filming
            if writer is not None and filming:
                writer.add(frame_of(env))
                filming = counter.wants(0)  # so that the last episode's last frame is in
            bar.update(counter)

        play = self._play
        return rollout(
            env,
            episodes=play.episodes,
            seed=play.seed,
            policy=play.policy,
            max_steps=play.steps,
            observe=observe,
        )

    def _video_path(self, number: int, count: int) -> Path | None:
        path = self._play.video
        if path is None or count == 1:
            return path
        return path.with_stem(f"{path.stem}-{number}")

    # --- what is printed -----------------------------------------------------------------------

    def _print(self, error: EnvHubError | None) -> None:
        if self._as_json:
            print_json(self._document(error))
        elif self._results:
            self._print_text()

    def _document(self, error: EnvHubError | None) -> dict[str, Any]:
        play = self._play
        document: dict[str, Any] = {
            "reference": self._make.ref,
            "sandbox": self._make.given["sandbox"],
            "policy": play.policy,
            "seed": play.seed,
            "episodes": play.episodes,
            "make_env_s": self._make_env_s,
            "time_to_first_step_s": self._time_to_first_step(),
            "tasks": [task_document(result) for result in self._results],
            "provenance": self._provenance,
            "error": None,
        }
        if error is not None:
            document["error"] = {
                "type": type(error).__name__,
                "message": describe(error),
                "exit_code": int(code_for(error)),
                "bundle": getattr(error, "bundle", None),
            }
        return document

    def _time_to_first_step(self) -> float | None:
        if self._make_env_s is None or not self._results:
            return None
        return self._make_env_s + self._results[0].rollout.first_step_s

    def _print_text(self) -> None:
        print_results(self._results)
        out()
        if self._provenance is not None:
            print_provenance(self._provenance, in_process=self._make.in_process)
        play = self._play
        out(
            f"{play.policy} actions, seed {play.seed}, --n-envs {self._make.given['n_envs']}; "
            f"first step after {self._time_to_first_step():.2f} s",
            "dim",
        )
        for result in self._results:
            if result.video is not None:
                out(f"wrote {safe_line(result.video)}")
        stopped = [result for result in self._results if not result.rollout.complete]
        if stopped:
            say(f"{len(stopped)} of {len(self._results)} tasks were stopped by --steps.")
