"""The questions to one environment of a repository, which is played for them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError

from envhub_sandbox.check.findings import Report
from envhub_sandbox.check.play import frames, leaks, traces
from envhub_sandbox.check.play.plays import Play, facts_of, film
from envhub_sandbox.check.play.traces import Env, Trace
from envhub_sandbox.errors import EnvHubError, RemoteEnvError
from envhub_sandbox.vector.suites import EnvSuites
from envhub_worker.protocol.text import printable, size_text

_PICTURED = 12
"""Tasks of which a page has pictures: a suite may have hundreds."""
_MODES = ("NextStep", "SameStep", "Disabled")
_RESET = 5
"""How many slow steps a reset may take."""
_LARGE_INFO = 512 << 10
"""Bytes of info a step, for each sub-environment: more than a picture of 480 x 360."""
_UNSEEDED = 8
"""Resets without a seed that must not all begin the same episode."""
_EPISODE_S = 30.0
"""How long is looked for the end of an episode."""
_BEGUN = 4
"""Steps after each of the resets after which is counted what is left."""
_ALONE = 5
"""Steps of one sub-environment by itself."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What is judged, and how.

    Attributes:
        reference: The repository.
        arguments: Of ``make_env``, beyond the reference.
        seed, steps: Of each play.
        resets: In a row, four times: what they leave behind is counted. 0 asks nothing.
        slow_step_s: What half of the steps may take; a reset may take five times that.
        episode_steps: In which some episode has to end, if 30 seconds suffice for them.
        tasks: Chooses ``(suite, task)`` pairs of the environments.
        tell: Is called with what is done next.
        pictures: Also gather what only a page shows: frames, and memory over time.
    """

    reference: str
    arguments: Mapping[str, Any]
    seed: int = 0
    steps: int = 200
    resets: int = 8
    slow_step_s: float = 1.0
    episode_steps: int = 10_000
    tasks: Callable[[EnvSuites], list[tuple[str, Any]]] = field(
        default=lambda suites: [(suite, task) for suite in suites for task in suites[suite]]
    )
    tell: Callable[[str], None] = lambda what: None
    pictures: bool = False


class TaskJudge:
    """Asks one environment every question about how it runs.

    Args:
        asked: What is judged, and how.
        report: Takes what is found.
        make: Makes all environments once more, in fresh processes, with these arguments changed.
        env: The environment, whose system calls may be recorded.
        key: Its suite and its task.
        takes_render_mode: Whether ``make_env`` has such an argument.
    """

    def __init__(
        self,
        asked: Asked,
        report: Report,
        make: Callable[..., EnvSuites],
        env: Env,
        key: tuple[str, Any],
        *,
        takes_render_mode: bool,
    ) -> None:
        self._asked, self._report, self._make, self._env = asked, report, make, env
        self._suite, self._task = key
        self._takes_render_mode = takes_render_mode
        self._name = f"{self._suite} / {self._task}"
        self._play = self._report.plays[self._name] = Play(facts_of(self._env))
        self._denied: tuple[str, ...] | None = None
        self._pictured = self._asked.pictures and len(self._report.plays) <= _PICTURED

    def ask(self) -> None:
        """Everything, in the order in which one fault is told apart from what it causes."""
        mode = getattr(self._env.metadata.get("autoreset_mode"), "value", None)
        stated = mode in _MODES
        self._say("autoreset-stated", [] if stated else ["the metadata does not say"])
        self._say("num-envs", list(self._uncounted()))
        usage = getattr(self._env, "jail_usage", None)
        seen = {}
        if usage is not None and self._pictured:
            seen["observe"] = self._play.sampling(usage, self._asked.steps)
        self._tell("first play")
        first = self._played(self._env, mode, **seen)
        self._play.episodes = first.counted
        self._say("observation-finite", first.unbounded)
        self._say("rewards", first.bad_rewards)
        self._say("infos", first.infos)
        self._say("large-infos", list(_large(first)))
        if stated:
            self._say("autoreset", first.autoreset)
        self._tell("rendering")
        self._render()
        self._tell("one sub-environment by itself")
        self._alone()
        self._compare(first, mode)
        self._leaks()

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Keep what its jail was refused, where that ends: it is not known afterwards."""
        try:
            yield
        except EnvHubError as error:
            self._denied = error.denied
            raise

    def denied(self) -> tuple[str, ...] | None:
        """What was refused so far: also where it ended in an error."""
        told = getattr(self._env, "jail_denials", None)
        denied: tuple[str, ...] | None = None if told is None else told()
        return self._denied if denied is None else denied

    def film(self) -> None:
        """Last of all, so that no verdict depends on whether somebody looks."""
        if self._pictured and self._is_alive and self._env.render_mode == "rgb_array":
            self._tell("filming")
            self._play.film = film(self._env, seed=self._asked.seed)

    @property
    def _is_alive(self) -> bool:
        return not any(
            one.task == self._name and one.id == "survives" for one in self._report.findings
        )

    def _tell(self, what: str) -> None:
        self._asked.tell(f"{self._name}: {what}")

    def _say(self, check: str, found: list[str]) -> None:
        self._report.judged(check, found, self._name)

    def _uncounted(self) -> Iterator[str]:
        wanted = self._asked.arguments.get("n_envs", 1)
        if self._env.num_envs != wanted:
            yield f"make_env(n_envs={wanted}) gave {self._env.num_envs} sub-environments"

    # --- in fresh processes --------------------------------------------------------------------

    def _compare(self, first: Trace, mode: str | None) -> None:
        """In another process, in the same one again, and spread over two."""
        self._tell("the same play in another process")
        with self._make(num_workers=1) as suites:
            env = suites[self._suite][self._task]
            second = self._played(env, mode)
            self._note_times(second)
            at = first.differs_from(second)
            self._say("seeding", [] if at is None else [_difference(at, "in two processes")])
            if at is None:
                self._replay(env, mode, second)
        if at is None and self._env.num_envs > 1:
            self._tell("the same play, spread over two processes")
            with self._make(num_workers=2) as suites:
                spread = self._played(suites[self._suite][self._task], mode, like=second)
            at = first.differs_from(spread)
            here = _difference(at or 0, "with one worker and with two")
            self._say("workers", [] if at is None else [here])

    def _played(self, env: Env, mode: str | None, **changes: Any) -> Trace:
        given = {"seed": self._asked.seed, "steps": self._asked.steps, **changes}
        return traces.play(env, mode, **given)

    def _note_times(self, trace: Trace) -> None:
        self._report.figures[self._name] = {
            "steps": len(trace.steps) - 1,
            "episodes": trace.episodes,
            **trace.times,
        }
        self._play.step_s = trace.spent
        half, most = trace.times.get("step_median_s", 0.0), self._asked.slow_step_s
        slow = f"half of the steps take {half:.2f} s or more, where {most:g} s are set"
        self._say("slow-steps", [slow] if half > most else [])

    def _replay(self, env: Env, mode: str | None, before: Trace) -> None:
        """In one process: the same seed, another, none; other actions; and on to an end."""
        seed = self._asked.seed
        self._tell("the same play in the same process")
        again = self._played(env, mode, like=before)
        self._tell("another seed, and other actions")
        other = self._played(env, mode, seed=seed + 1, actions_seed=seed, like=before)
        acted = self._played(env, mode, actions_seed=seed + 1, like=before)
        self._other_seed(before, other)
        self._say("actions-ignored", list(self._unmoved(before, acted)))
        resets = [trace.times["reset_s"] for trace in (again, other, acted)]
        self._say("slow-resets", list(self._slow(min(resets))))
        self._tell("resets without a seed")
        at, is_drawn = before.differs_from(again), before.differs_from(other) == 0
        self._seeded(env, at, _UNSEEDED if is_drawn else 2)
        if any(trace.episodes for trace in (before, again, other, acted)):
            self._say("endless", [])
        else:
            self._tell("on to the end of an episode")
            self._on_to_an_end(env)

    def _seeded(self, env: Env, at: int | None, most: int) -> None:
        if at is not None:
            self._say("seed-ignored", [_difference(at, "in one process")])
            return
        begun, again = self._begun(env, most), self._begun(env, most)
        differ = "the resets without a seed after one with a seed differ in one process"
        self._say("seed-ignored", [differ] if begun != again else [])
        is_fixed = len(begun) == _UNSEEDED and len(set(begun)) == 1
        same = f"{_UNSEEDED} resets without a seed begin the same episode"
        self._say("seed-fixed", [same] if is_fixed else [])

    def _begun(self, env: Env, most: int) -> list[str]:
        """The episodes that follow a seeded one, up to one that differs.

        Followed: ``check_reset_seed_determinism`` of Gymnasium's ``check_env``.
        """
        env.reset(seed=self._asked.seed)
        begun: list[str] = []
        while len(begun) < most and len(set(begun)) < 2:
            begun.append(traces.digest(env.reset()[0]))
        return begun

    def _other_seed(self, before: Trace, other: Trace) -> None:
        seeds = f"{self._asked.seed} and {self._asked.seed + 1}"
        same = f"resets with the seeds {seeds} begin the same episode"
        self._say("seed-constant", [same] if before.differs_from(other) is None else [])

    def _unmoved(self, before: Trace, acted: Trace) -> Iterator[str]:
        space = self._env.single_action_space
        if _can_be_guessed(space) and before.differs_from(acted) is None:
            different = sum(a != b for a, b in zip(before.actions, acted.actions, strict=False))
            if different:
                yield f"{different} steps with other actions give the same results"

    def _slow(self, took: float) -> Iterator[str]:
        most = _RESET * self._asked.slow_step_s
        if took > most:
            yield f"a reset takes {took:.1f} s, where {most:g} s are set"

    def _on_to_an_end(self, env: Env) -> None:
        """Says nothing where there is no time to find out."""
        until = time.monotonic() + _EPISODE_S
        env.reset(seed=self._asked.seed)
        for _ in range(self._asked.episode_steps):
            _, _, terminations, truncations, _ = env.step(env.action_space.sample())
            if np.any(terminations) or np.any(truncations):
                self._say("endless", [])
                return
            if time.monotonic() > until:
                return
        self._say("endless", [f"no episode ended in {self._asked.episode_steps:,} steps"])

    # --- in the process that was played first --------------------------------------------------

    def _leaks(self) -> None:
        usage = getattr(self._env, "jail_usage", None)
        if usage is None or not self._asked.resets:
            return
        seen = leaks.watch(
            self._begin,
            self._play.counting(usage),
            self._asked.resets,
            self._tell,
        )
        if not seen:
            return  # a server on another host that does not count
        self._report.figures[self._name] |= {name: float(n) for name, n in seen[-1].items()}
        found = dict(leaks.grown(seen, self._asked.resets))
        for check in leaks.checks():
            self._say(check, [found[check]] if check in found else [])

    def _begin(self) -> None:
        self._env.reset(seed=self._asked.seed)
        for _ in range(min(_BEGUN, self._asked.steps)):
            _, _, terminations, truncations, _ = self._env.step(self._env.action_space.sample())
            if np.any(terminations) or np.any(truncations):
                return

    def _render(self) -> None:
        wrong: list[str] = []
        cause = ""
        try:
            wrong += self._renders()
        except RemoteEnvError as error:
            wrong.append(f"{error.type_name}: {error.message}")
            cause = error.type_name.rpartition(".")[2]
        self._report.judged("render", wrong, self._name, cause=cause)
        self._say("render-fps", list(self._unpaced()))

    def _unpaced(self) -> Iterator[str]:
        """LeRobot's evaluation reads the number, and so does Gymnasium's ``RecordVideo``."""
        fps = self._env.metadata.get("render_fps")
        is_rate = isinstance(fps, (int, float)) and not isinstance(fps, bool) and fps > 0
        if self._env.render_mode in frames.FILMED and not is_rate:
            yield f"metadata['render_fps'] is {printable(repr(fps), 100)}"

    def _renders(self) -> Iterator[str]:
        """In its own mode; in the others that it declares, where its make_env takes one."""
        yield from frames.wrong(self._env)
        given = self._asked.arguments.get("env_kwargs") or {}
        for mode in frames.others(self._env) if self._takes_render_mode else ():
            asked = {**given, "render_mode": mode}
            with self._make(env_kwargs=asked, num_workers=1) as suites:
                env = suites[self._suite][self._task]
                env.reset(seed=self._asked.seed)
                if env.render_mode != mode:
                    yield f"{mode}: it is declared and asked for, and is {env.render_mode!r}"
                yield from frames.wrong(env)

    def _alone(self) -> None:
        """What one sub-environment gives before Gymnasium writes it into a batch."""
        uncast: list[str] = []
        types: list[str] = []
        handles = getattr(self._env, "envs", None)
        # one that has none of its own that can be driven says so by one of these
        with contextlib.suppress(AttributeError, TypeError, ValueError, NotImplementedError):
            if handles:
                self._drive(handles[0], uncast, types)
        self._say("observation-dtype", uncast[:1])
        self._say("step-types", list(dict.fromkeys(types)))

    def _drive(self, handle: Any, uncast: list[str], types: list[str]) -> None:
        uncast += self._outside(handle.reset(seed=self._asked.seed)[0])
        for _ in range(min(_ALONE, self._asked.steps)):
            result = handle.step(self._env.single_action_space.sample())
            uncast += self._outside(result[0])
            types += _untyped(*result[1:])
            if np.any(result[2]) or np.any(result[3]):
                return

    def _outside(self, observation: Any) -> Iterator[str]:
        space = self._env.single_observation_space
        with contextlib.suppress(CustomSpaceError):  # whose code is not here to be asked
            if _would_be_cast(observation, space) or not space.contains(observation):
                given = frames.kind(observation)
                yield f"sub-environment 0 gave {given}, which is not in {space}"


def _would_be_cast(value: Any, space: spaces.Space[Any]) -> bool:
    """Whether a Box would make an array of it to look whether it is a member."""
    if isinstance(space, spaces.Dict) and isinstance(value, Mapping):
        return any(_would_be_cast(value[name], space[name]) for name in space if name in value)
    if isinstance(space, spaces.Tuple) and isinstance(value, tuple):
        return any(map(_would_be_cast, value, space))
    return isinstance(space, spaces.Box) and isinstance(value, (list, tuple, int, float))


def _untyped(reward: Any, terminated: Any, truncated: Any, info: Any) -> Iterator[str]:
    """What Gymnasium's ``check_env`` refuses of a step. Trust: input from the worker."""
    is_vector = isinstance(reward, np.ndarray) and reward.size > 1  # as mo-gymnasium's
    if not is_vector and not isinstance(reward, (int, float, np.integer, np.floating)):
        yield f"the reward is {frames.kind(reward)}, and no number"
    for name, value in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, (bool, np.bool_)):
            yield f"{name} is {frames.kind(value)}, and no bool"
    if not isinstance(info, Mapping):
        yield f"the info is {frames.kind(info)}, and no dict"


def _large(trace: Trace) -> Iterator[str]:
    half = float(np.median(trace.heavy)) if trace.heavy else 0.0
    if half >= _LARGE_INFO:
        yield f"half of the steps have infos of {size_text(int(half))} a sub-environment, or more"


def _can_be_guessed(space: spaces.Space[Any]) -> bool:
    """Whether actions by lot do something; a word by lot means nothing to whom it is said."""
    if isinstance(space, spaces.Dict):
        return all(map(_can_be_guessed, space.values()))
    if isinstance(space, spaces.Tuple):
        return all(map(_can_be_guessed, space))
    known = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    return isinstance(space, known)


def _difference(at: int, where: str) -> str:
    return f"{'the reset' if at == 0 else f'step {at}'} differs {where}"
