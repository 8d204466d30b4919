"""The results of a rollout, as data for ``--json`` and as text for people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from envhub_sandbox.cli.shared.console import safe_line, show, show_rows

if TYPE_CHECKING:
    from envhub_sandbox.play.episodes import Rollout

_SHOWN_DIGITS = 12
_SHOWN_PACKAGES = ("gymnasium", "numpy")


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """The rollout of one task.

    Attributes:
        suite, task: The task's keys. Trust: input from the worker.
        autoreset_mode: ``"NextStep"``, ``"SameStep"``, ``"Disabled"`` or None.
        video: The written file, or None.
    """

    suite: str
    task: int | str
    num_envs: int
    autoreset_mode: str | None
    rollout: Rollout
    video: str | None


def statistics(values: Sequence[float]) -> dict[str, float] | None:
    """Return mean, population standard deviation, minimum and maximum; None without values."""
    import numpy as np

    if not values:
        return None
    with np.errstate(all="ignore"):  # an environment may return infinite rewards
        numbers = np.array(values, np.float64)
        return {name: float(getattr(numbers, name)()) for name in ("mean", "std", "min", "max")}


def returns_of(rollout: Rollout) -> list[dict[str, float] | None]:
    """Return statistics of the returns for each component of the reward."""
    components = zip(*(episode.returns for episode in rollout.episodes), strict=True)
    return [statistics(values) for values in components] or [None]


def success_rate(rollout: Rollout) -> float | None:
    """Return the share of successes among the episodes that report it; None if none does."""
    stated = [episode.success for episode in rollout.episodes if episode.success is not None]
    return sum(stated) / len(stated) if stated else None


def task_document(result: TaskResult) -> dict[str, Any]:
    """Return a task's result as data; ``return`` is a list if rewards are vectors."""
    rollout = result.rollout
    returns = returns_of(rollout)
    return {
        "suite": safe_line(result.suite),
        "task": result.task if isinstance(result.task, int) else safe_line(result.task),
        "num_envs": result.num_envs,
        "autoreset_mode": result.autoreset_mode,
        "complete": rollout.complete,
        "return": returns[0] if len(returns) == 1 else returns,
        "length": statistics([episode.length for episode in rollout.episodes]),
        "success_rate": success_rate(rollout),
        "steps": rollout.steps,
        "steps_per_s": rollout.steps_per_s,
        "first_step_s": rollout.first_step_s,
        "video": result.video,
        "episodes": [
            {
                "sub_env": episode.sub_env,
                "return": episode.returns[0] if len(returns) == 1 else episode.returns,
                "length": episode.length,
                "terminated": episode.terminated,
                "success": episode.success,
            }
            for episode in rollout.episodes
        ],
    }


def print_results(results: Sequence[TaskResult]) -> None:
    """Print a table with a row for each task, and for each component if rewards are vectors."""
    with_success = any(success_rate(result.rollout) is not None for result in results)
    heads = ["suite / task", "episodes", "return", "min", "max", "length", "steps/s"]
    heads += ["success"] if with_success else []
    rows = [row for result in results for row in _rows(result, with_success)]
    show_rows([heads, *rows], right=range(1, len(heads)))


def _rows(result: TaskResult, with_success: bool) -> list[list[str]]:
    rollout = result.rollout
    name = f"{safe_line(result.suite, 60)} / {safe_line(result.task, 60)}"
    count = str(len(rollout.episodes)) + ("" if rollout.complete else " (stopped)")
    length = _mean(statistics([episode.length for episode in rollout.episodes]))
    successes = success_rate(rollout)
    rate = "-" if successes is None else f"{successes:.0%}"
    rows = []
    for index, stats in enumerate(returns := returns_of(rollout)):
        first = index == 0
        label = name if first else ""
        if len(returns) > 1:
            label += f" [{index}]"
        row = [label, count if first else "", _mean(stats, spread=True)]
        row += ["-", "-"] if stats is None else [f"{stats['min']:.2f}", f"{stats['max']:.2f}"]
        row += [length, f"{rollout.steps_per_s:,.0f}"] if first else ["", ""]
        rows.append([*row, rate if first else ""])
    return rows if with_success else [row[:-1] for row in rows]


def _mean(stats: dict[str, float] | None, *, spread: bool = False) -> str:
    if stats is None:
        return "-"
    if spread:
        return f"{stats['mean']:.2f} ± {stats['std']:.2f}"
    return f"{stats['mean']:.1f}"


def print_provenance(provenance: dict[str, Any], *, in_process: bool) -> None:
    """Print the repository, the interpreter and packages, and the confinement of a run."""
    kind = provenance["repo_type"]
    word, dash, digits = provenance["commit"].rpartition("-")
    commit = f"{word}{dash}{digits[:_SHOWN_DIGITS]}" if dash else digits
    show("repository", f"{provenance['repository']} ({kind}) at {commit}, {provenance['path']}")
    for asset in provenance.get("assets") or ():
        show("could read", str(asset))
    interpreter = provenance.get("interpreter") or {}
    if interpreter:
        shown = {*_SHOWN_PACKAGES}
        if provenance["repo_type"] == "pypi":  # its version is at most in the reference
            shown.add(re.split(r"[\[@#]", provenance["repository"])[0])
        text = _interpreter(interpreter, provenance.get("packages") or {}, shown)
        show("ran on", text)
    for title, text in _confinement(provenance, in_process):
        show(title, text)


def _interpreter(interpreter: dict[str, str], packages: dict[str, str], names: set[str]) -> str:
    from packaging.utils import canonicalize_name

    installed = {canonicalize_name(name): release for name, release in packages.items()}
    wanted = {canonicalize_name(name) for name in names}
    shown = [f"{name} {installed[name]}" for name in sorted(wanted & installed.keys())]
    version, executable = interpreter.get("version", ""), interpreter.get("executable", "")
    return ", ".join([f"{version} ({executable})", *shown])


def _confinement(provenance: dict[str, Any], in_process: bool) -> list[tuple[str, str]]:
    """Return the rows about confinement, in the form of ``envhub check``."""
    if in_process:
        return [("confined by", "nothing: the code ran in this process")]
    if not provenance.get("layers"):
        return [("confined by", "nothing ran")]
    from envhub_sandbox.play.confinement import Confinement

    return list(Confinement.of(str(provenance.get("profile")), provenance, "").rows())
