"""Judges one environment of a repository by playing it."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError

from envhub_sandbox.errors import EnvHubError, LoadError, RemoteEnvError, RemoteEnvWarning
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.play import probes, traces
from envhub_sandbox.extras.judge.play.film import Play, facts_of, film
from envhub_sandbox.extras.judge.play.traces import Env, Trace
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.manifest.names import CONVERTED
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.text import printable, size_text

_PICTURED = 12
"""Tasks that a page shows with pictures: a suite may have hundreds."""
_SAMPLES = 10
_MODES = ("NextStep", "SameStep", "Disabled")
_RESET = 5
"""The limit of a reset's time, in slow steps."""
_LARGE_INFO = 512 << 10
"""Bytes of info per step and sub-environment: more than a picture of 480 x 360."""
_UNSEEDED = 8
"""Resets without a seed, which must not all begin the same episode."""
_EPISODE_S = 30.0
"""Seconds to search for the end of an episode."""
_BEGUN = 4
"""Steps after each reset, before resources are counted."""
_STATISTICS = ("obs_rms", "return_rms")
"""The running statistics of Gymnasium's NormalizeObservation and NormalizeReward."""


class TaskJudge:
    """Checks everything about how one environment runs.

    Args:
        asked, report: The settings of the judgement; the report that receives findings.
        make: Makes all environments again, in new processes, with changed arguments.
        env: The environment; its jail may record system calls.
        takes_render_mode: Whether ``make_env`` takes this argument.
    """

    def __init__(
        self,
        asked: JudgeOptions,
        report: Report,
        make: Callable[..., EnvSuites],
        env: Env,
        key: tuple[str, Any],
        *,
        takes_render_mode: bool,
    ) -> None:
        self._asked, self._report, self._make, self._env = asked, report, make, env
        self._sandbox = env.sandbox if isinstance(env, SandboxVectorEnv) else None
        self._suite, self._task = key
        self._takes_render_mode = takes_render_mode
        self._name = f"{self._suite} / {self._task}"
        self._play = report.plays[self._name] = Play(facts_of(env))
        self._denied: tuple[str, ...] | None = None
        self._pictured = asked.pictures and len(report.plays) <= _PICTURED

    def ask(self) -> None:
        """Make all checks; keep the jail's denials, since an error may end the jail too."""
        try:
            self._ask()
        except EnvHubError as error:
            self._denied = error.denied
            raise

    def _ask(self) -> None:
        """Make the checks in an order that separates a fault from its consequences."""
        mode = getattr(self._env.metadata.get("autoreset_mode"), "value", None)
        stated = mode in _MODES
        self._holds("autoreset-stated", stated, "the metadata does not say")
        wanted = self._asked.arguments.get("n_envs", 1)
        gave = f"make_env(n_envs={wanted}) gave {self._env.num_envs} sub-environments"
        self._holds("num-envs", self._env.num_envs == wanted, gave)
        self._converted()
        seen = {"observe": self._sample} if self._sandbox is not None and self._pictured else {}
        self._tell("first play")
        first = self._played(self._env, mode, **seen)
        self._play.episodes = first.counted
        for check in ("observation-finite", "rewards", "infos"):
            self._say(check, first.notes[check])
        self._say("info-types", first.notes["info-types"][:1])
        self._large(first)
        if stated:
            self._say("autoreset", first.notes["autoreset"])
        self._tell("rendering")
        self._render()
        self._say("lerobot", probes.lerobot_lacks(self._env, first.counted, first.ends))
        self._tell("one sub-environment by itself")
        self._alone()
        self._compare(first, mode)
        self._leaks()

    def _converted(self) -> None:
        """Raise the sandbox's note if it converted an environment that Gymnasium cannot call."""
        if isinstance(self._env, SandboxVectorEnv):
            try:
                told = self._env.get_attr(CONVERTED)
            except RemoteEnvError:  # the normal case: nothing was converted
                return
            if isinstance(told[0], str):  # a custom class may have a value for every name
                raise RemoteEnvError("TypeError", told[0])

    def denied(self) -> tuple[str, ...] | None:
        """Returns the denials so far, also after an error."""
        denied = None if self._sandbox is None else self._sandbox.denials()
        return self._denied if denied is None else denied

    def film(self) -> None:
        """Film the environment last, so that no verdict depends on the pictures."""
        findings = self._report.findings
        dead = ("survives", self._name) in {(finding.id, finding.task) for finding in findings}
        if self._pictured and not dead and self._env.render_mode == "rgb_array":
            self._tell("filming")
            self._play.film = film(self._env, seed=self._asked.seed)

    def _tell(self, what: str) -> None:
        self._asked.tell(f"{self._name}: {what}")

    def _say(self, check: str, found: Iterable[str]) -> None:
        self._report.judged(check, found, self._name)

    def _holds(self, check: str, holds: bool, otherwise: str) -> None:
        self._say(check, [] if holds else [otherwise])

    def _large(self, trace: Trace) -> None:
        half = int(np.median(trace.heavy)) if trace.heavy else 0
        large = f"half of the steps have infos of {size_text(half)} a sub-environment, or more"
        self._holds("large-infos", half < _LARGE_INFO, large)

    # --- in new processes ----------------------------------------------------------------------

    def _of(self, suites: EnvSuites) -> Env:
        """Returns this task's environment. Raises ``LoadError``: make_env now has other names."""
        tasks: Mapping[Any, Env] = suites.get(self._suite, {})
        if self._task not in tasks:
            raise LoadError(f"there is no {self._name} any more")
        return tasks[self._task]

    def _compare(self, first: Trace, mode: str | None) -> None:
        """Compare plays: in another process, again in the same process, and over two processes."""
        self._tell("the same play in another process")
        with self._make(num_workers=1) as suites:
            env = self._of(suites)
            second = self._played(env, mode)
            self._note_times(second)
            differs = self._same("seeding", first, second, "in two processes")
            if not differs:
                self._replay(env, mode, second)
        if not differs and self._env.num_envs > 1:
            self._tell("the same play, spread over two processes")
            with warnings.catch_warnings(), self._make(num_workers=2) as suites:
                # of a number that the caller did not choose; the check says what depends on it
                warnings.simplefilter("ignore", RemoteEnvWarning)
                spread = self._played(self._of(suites), mode, like=second)
            self._same("workers", first, spread, "with one worker and with two")

    def _same(self, check: str, trace: Trace, other: Trace, where: str) -> bool:
        """Judges whether two plays are the same; returns whether they differ."""
        at = trace.differs_from(other)
        if at is None:
            self._say(check, [])
            return False
        step = f"step {at}" if at else "the reset"
        self._say(check, [f"{step} differs {where}{trace.difference(other, at)}"])
        return True

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
        self._holds("slow-steps", half <= most, slow)

    def _replay(self, env: Env, mode: str | None, before: Trace) -> None:
        """Play again in one process: same seed, another, none; other actions; and until an end."""
        seed, learning = self._asked.seed, self._learning(env)
        if learning is not None:
            before = self._played(env, mode)
        self._tell("the same play in the same process")
        again = self._played(env, mode, like=before)
        self._tell("another seed, and other actions")
        other = self._played(env, mode, seed=seed + 1, actions_seed=seed, like=before)
        acted = self._played(env, mode, actions_seed=seed + 1, like=before)
        same = f"resets with the seeds {seed} and {seed + 1} begin the same episode"
        self._holds("seed-constant", before.differs_from(other) is not None, same)
        self._say("actions-ignored", self._unmoved(before, acted))
        took = min(trace.times["reset_s"] for trace in (again, other, acted))
        most = _RESET * self._asked.slow_step_s
        slow = f"a reset takes {took:.1f} s, where {most:g} s are set"
        self._holds("slow-resets", took <= most, slow)
        self._tell("resets without a seed")
        if before.differs_from(again) is None:
            self._unseeded(env, _UNSEEDED if before.differs_from(other) == 0 else 2)
        elif not learning:
            self._same("seed-ignored", before, again, "in one process")
        if any(trace.episodes for trace in (before, again, other, acted)):
            for check in ("endless", "endless-unknown"):
                self._say(check, [])
        else:
            self._tell("on to the end of an episode")
            self._endless(env)

    def _learning(self, env: Env) -> int | None:
        """Stops Gymnasium's running statistics. Returns how many still learn; None if it has none.

        They outlive each reset by design, so they are stopped while plays are compared. Of nested
        wrappers this process can stop only the outermost.
        """
        learning = sum(probes.is_statistics(env, name) for name in _STATISTICS)
        if learning and probes.has(env, "update_running_mean"):  # older releases lack it
            env.set_attr("update_running_mean", [False] * env.num_envs)  # type: ignore[attr-defined]
            return learning - 1
        return learning or None

    def _endless(self, env: Env) -> None:
        """Search for the end of an episode; if the time runs out, for a declared limit."""
        most, limit = self._asked.episode_steps, probes.step_limit(env)
        ended, played = self._ends(env, most, time.monotonic() + _EPISODE_S)
        text = f"no episode ended in {played:,} steps"
        known = ended or played == most or limit is not None
        self._holds("endless-unknown", known, f"{text}, for which there were {_EPISODE_S:g} s")
        if known:
            will_end = limit is not None and played < limit <= most
            limited = "" if limit is None else f", where its limit is {limit:,}"
            self._holds("endless", ended or will_end, f"{text}{limited}")

    def _unseeded(self, env: Env, most: int) -> None:
        """Judge the resets without a seed."""
        begun, again = self._begun(env, most), self._begun(env, most)
        at = begun.differs_from(again)
        words = "the resets without a seed after one with a seed differ in one process"
        self._holds("seed-ignored", at is None, f"{words}{begun.difference(again, at or 0)}")
        is_fixed = len(begun.steps) == _UNSEEDED and len(set(begun.steps)) == 1
        same = f"{_UNSEEDED} resets without a seed begin the same episode"
        self._holds("seed-fixed", not is_fixed, same)

    def _begun(self, env: Env, most: int) -> Trace:
        """Plays the episodes after a seeded one, until one differs.

        The check follows ``check_reset_seed_determinism`` of Gymnasium's ``check_env``.
        """
        env.reset(seed=self._asked.seed)
        begun = Trace()
        while len(begun.steps) < most and len(set(begun.steps)) < 2:
            begun.add([env.reset()[0]])
        return begun

    def _unmoved(self, before: Trace, acted: Trace) -> Iterator[str]:
        space = self._env.single_action_space
        if _can_be_guessed(space) and before.differs_from(acted) is None:
            different = sum(a != b for a, b in zip(before.actions, acted.actions, strict=False))
            if different:
                yield f"{different} steps with other actions give the same results"

    def _ends(self, env: Env, steps: int, until: float = math.inf) -> tuple[bool, int]:
        """Tells whether an episode ends within ``steps``, and how many steps were made."""
        env.reset(seed=self._asked.seed)
        for played in range(1, steps + 1):
            _, _, terminations, truncations, _ = env.step(env.action_space.sample())
            if np.any(terminations) or np.any(truncations):
                return True, played
            if time.monotonic() > until:
                return False, played
        return False, steps

    # --- in the process of the first play ------------------------------------------------------

    def _leaks(self) -> None:
        if self._sandbox is None or not self._asked.resets:
            return
        resets, steps = self._asked.resets, min(_BEGUN, self._asked.steps)
        begin = partial(self._ends, self._env, steps)
        seen = probes.usage_per_round(begin, self._used, resets, self._tell)
        if not seen:
            return  # a server on another host that counts nothing
        self._report.figures[self._name] |= {name: float(n) for name, n in seen[-1].items()}
        grown, words = probes.leak(seen, resets) or ("", "")
        for check in probes.LEAK_CHECKS:
            self._holds(check, check != grown, words)

    def _used(self) -> dict[str, int]:
        assert self._sandbox is not None
        return self._play.count(self._sandbox.usage())

    def _sample(self, number: int) -> None:
        """Count after some of the steps: a server limits how often it counts (``CountLimit``)."""
        if number % -(-self._asked.steps // _SAMPLES) == 0:
            self._used()
            self._play.played = len(self._play.memory)

    def _render(self) -> None:
        try:
            wrong = [*self._renders()]
        except RemoteEnvError as error:
            self._report.raised("render", error, self._name)
        else:
            self._say("render", wrong)
        # LeRobot's evaluation and Gymnasium's RecordVideo read this number
        fps = self._env.metadata.get("render_fps")
        is_rate = isinstance(fps, (int, float)) and not isinstance(fps, bool) and fps > 0
        holds = is_rate or self._env.render_mode not in probes.FILMED
        self._holds("render-fps", holds, f"metadata['render_fps'] is {printable(repr(fps), 100)}")

    def _renders(self) -> Iterator[str]:
        """Yields render's faults: in the current mode, and in other modes if make_env takes one."""
        yield from probes.wrong_frames(self._env)
        given = self._asked.arguments.get("env_kwargs") or {}
        for mode in probes.other_modes(self._env) if self._takes_render_mode else ():
            asked = {**given, "render_mode": mode}
            with self._make(env_kwargs=asked, num_workers=1) as suites:
                env = self._of(suites)
                env.reset(seed=self._asked.seed)
                if env.render_mode != mode:
                    yield f"{mode}: it is declared and asked for, and is {env.render_mode!r}"
                yield from probes.wrong_frames(env)

    def _alone(self) -> None:
        """Check the results of one sub-environment before Gymnasium writes them into a batch."""
        uncast: list[str] = []
        types: dict[str, str] = {}  # the first fault of each part
        env: Any = self._env
        try:
            self._drive(env.envs[0], uncast, types)
        # a vector class without sub-environments that can be stepped raises one of these
        except (AttributeError, IndexError, TypeError, ValueError, NotImplementedError):
            self._drive_batch(uncast, types)
        self._say("observation-dtype", uncast[:1])
        self._say("step-types", types.values())

    def _drive(self, handle: Any, uncast: list[str], types: dict[str, str]) -> None:
        """Play one episode, because many a fault is in its last step alone."""
        space, who = self._env.single_observation_space, "sub-environment 0"
        uncast += _outside(who, space, handle.reset(seed=self._asked.seed)[0])
        for _ in range(self._asked.steps):
            result = handle.step(self._env.single_action_space.sample())
            uncast += _outside(who, space, result[0])
            for part, text in _untyped(*result[1:]):
                types.setdefault(part, text)
            if np.any(result[2]) or np.any(result[3]):
                return

    def _drive_batch(self, uncast: list[str], types: dict[str, str]) -> None:
        """Step once: what a vector class of the repository's own returns is not cast."""
        space = self._env.observation_space
        uncast += _outside("reset", space, self._env.reset(seed=self._asked.seed)[0])
        observations, rewards, *_ = self._env.step(self._env.action_space.sample())
        uncast += _outside("step", space, observations)
        if np.ndim(rewards) > 1 and np.size(rewards) == self._env.num_envs:
            types["reward"] = f"the rewards are {_seen(rewards)}, not one number each"


def _outside(who: str, space: spaces.Space[Any], observation: Any) -> Iterator[str]:
    with contextlib.suppress(CustomSpaceError):  # the space's code is not in this process
        if _would_be_cast(observation, space) or not space.contains(observation):
            yield f"{who} gave {batches.shown(observation)}, which is not in {space}"


def _would_be_cast(value: Any, space: spaces.Space[Any]) -> bool:
    """Tells whether a Box's membership test would cast the value to an array first."""
    if isinstance(space, spaces.Dict) and isinstance(value, Mapping):
        return any(_would_be_cast(value[name], space[name]) for name in space if name in value)
    if isinstance(space, spaces.Tuple) and isinstance(value, tuple):
        return any(map(_would_be_cast, value, space))
    return isinstance(space, spaces.Box) and isinstance(value, (list, tuple, int, float))


def _untyped(reward: Any, terminated: Any, truncated: Any, info: Any) -> Iterator[tuple[str, str]]:
    """Yields parts with a fault that Gymnasium's ``check_env`` refuses, and a text for each.
    Trust: input from the worker.
    """
    is_vector = isinstance(reward, np.ndarray) and reward.size > 1  # as mo-gymnasium's
    if not is_vector and not isinstance(reward, (int, float, np.integer, np.floating)):
        yield "reward", f"the reward is {_seen(reward)}, not a number"
    for name, value in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, (bool, np.bool_)):
            yield name, f"{name} is {_seen(value)}, not a bool"
    if not isinstance(info, Mapping):
        yield "info", f"the info is {_seen(info)}, not a dict"


def _seen(value: Any) -> str:
    return f"{'an array: ' if isinstance(value, np.ndarray) else ''}{batches.shown(value)}"


def _can_be_guessed(space: spaces.Space[Any]) -> bool:
    """Tells whether random actions have an effect: a random text has no meaning."""
    if isinstance(space, spaces.Dict):
        return all(map(_can_be_guessed, space.values()))
    if isinstance(space, spaces.Tuple):
        return all(map(_can_be_guessed, space))
    known = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    return isinstance(space, known)
