"""One evaluation of a suite, in a process of its own: ``python -m benchmarks.evaluations --help``.

What LeRobot's ``eval_policy_all`` does to a suite of tasks, one after the other, each closed
before the next opens. Either LeRobot itself does it (``lerobot_eval.py``), or the loop that follows
it call by call (``tests/support/lerobot.py``); always with a policy of torch.

- ``lerobot-sync`` and ``lerobot-async`` have what the repository's ``make_env`` returns in this
  process, where LeRobot's own code asks for it as for any repository of the Hub; else vector
  environments that are built when they are first used.
- ``lerobot-lazy`` has what LeRobot makes of its own suites: such environments, by ``forkserver``.
- ``envhub-sync`` and ``envhub-async`` have this project's, for a pin whose manifest is known.
"""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import sys
from collections.abc import Callable, Mapping
from time import perf_counter
from typing import Any

VARIANTS = ("lerobot-sync", "lerobot-async", "envhub-sync", "envhub-async")
LAZY = "lerobot-lazy"
LOOP, LEROBOT = "loop", "lerobot"
N_ENVS = 4

Suites = Mapping[str, Mapping[Any, Any]]
Play = Callable[[], list[list[float]]]


def main() -> None:
    """Evaluate; a line once everything is imported, and a JSON object at the end."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evaluations", description=__doc__)
    parser.add_argument("variant", choices=(*VARIANTS, LAZY))
    parser.add_argument("folder")
    parser.add_argument("--tasks", type=int, default=10)
    parser.add_argument("--heavy", metavar="FOLDER", default="", help="where the simulator lies")
    parser.add_argument("--evaluator", choices=(LOOP, LEROBOT), default=LOOP)
    options = parser.parse_args()
    heavy = options.heavy
    given = {"tasks": options.tasks, "heavy": bool(heavy), "packages": heavy}
    prepare = _with_lerobot if options.evaluator == LEROBOT else _with_loop
    play = prepare(options.variant, options.folder, given)
    imports_cpu_s = _cpu_s()
    print("imported", flush=True)
    start = perf_counter()
    returns = play()
    seconds = perf_counter() - start
    print(json.dumps({"seconds": seconds, "imports_cpu_s": imports_cpu_s, "returns": returns}))


def _cpu_s() -> float:
    found = resource.getrusage(resource.RUSAGE_SELF)
    return found.ru_utime + found.ru_stime


def _with_lerobot(variant: str, folder: str, given: dict[str, Any]) -> Play:
    from benchmarks import lerobot_eval

    use_async = variant.endswith("async")
    if variant.startswith("envhub"):
        return _ours(folder, use_async, given, lambda e: lerobot_eval.evaluate_all(e, N_ENVS))
    if variant == LAZY:
        return lambda: lerobot_eval.evaluate_all(
            _built_later(folder, given, lerobot_eval.lazily), N_ENVS
        )
    return lambda: lerobot_eval.evaluate_all(
        lerobot_eval.from_hub(folder, N_ENVS, use_async, given), N_ENVS
    )


def _with_loop(variant: str, folder: str, given: dict[str, Any]) -> Play:
    import torch

    from tests.support import lerobot

    def evaluate(envs: Suites) -> list[list[float]]:
        torch.manual_seed(0)
        layer = torch.nn.Linear(4, 2)
        found = lerobot.evaluate_all(
            envs, lambda seen: layer(seen["observation.state"]), N_ENVS, 1, render=False
        )
        return [one["returns"] for one in found.values()]

    use_async = variant.endswith("async")
    if variant.startswith("envhub"):
        return _ours(folder, use_async, given, evaluate)
    import gymnasium as gym

    kind = gym.vector.AsyncVectorEnv if use_async else gym.vector.SyncVectorEnv
    return lambda: evaluate(_built_later(folder, given, lambda env_fns, _: Lazy(kind, env_fns)))


def _ours(
    folder: str, use_async: bool, given: dict[str, Any], evaluate: Callable[..., Any]
) -> Play:
    from envhub_sandbox import make_env

    def play() -> list[list[float]]:
        policy = {"readable": [given["packages"]] if given["packages"] else []}
        options: dict[str, Any] = {"policy": policy, "timeouts": {"startup_s": 300}}
        with make_env(folder, N_ENVS, use_async, env_kwargs=given, **options) as suites:
            return evaluate(suites)

    return play


def _built_later(folder: str, given: dict[str, Any], later: Callable[..., Any]) -> Suites:
    """The suite, of environments that are built when they are used."""
    sys.path[:0] = [folder, *([given["packages"]] if given["packages"] else [])]
    repository = importlib.import_module("env")
    like = repository.Reach(0)

    def makers(task: int) -> list[Callable[[], Any]]:
        heavy = given["heavy"]
        return [
            lambda index=index: repository.Reach(task, heavy and index == 0)
            for index in range(N_ENVS)
        ]

    return {"reach": {task: later(makers(task), like) for task in range(given["tasks"])}}


class Lazy:
    """A vector environment that is built when it is first looked into, as LeRobot's are."""

    def __init__(self, kind: Callable[[Any], Any], env_fns: list[Callable[[], Any]]) -> None:
        self._kind, self._env_fns = kind, env_fns
        self._env: Any = None

    def _ensure(self) -> None:
        if self._env is None:
            self._env = self._kind(self._env_fns)

    def __getattr__(self, name: str) -> Any:
        self._ensure()
        return getattr(self._env, name)

    @property
    def unwrapped(self) -> Any:
        """The vector environment itself."""
        self._ensure()
        return self._env

    def close(self) -> None:
        """Close what was built, and forget it."""
        if self._env is not None:
            self._env.close()
        self._env = None


if __name__ == "__main__":
    main()
