"""One run of a repository in a sandbox: ``python -m benchmarks.reach.play ORDER``.

The order, a file of JSON, names the repository, the arguments of ``make_env`` and the folder for
what comes: actions, results, and what was installed. It is a process of its own, so that none that
was interrupted disturbs the next.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.reach.control import SEED, line, plain
from envhub_sandbox import make_env

STEPS = 40


def main(order: str) -> None:
    """Play, and write down what came."""
    asked = json.loads(Path(order).read_text())
    folder = Path(asked["into"])
    with make_env(asked["repository"], n_envs=1, **asked["arguments"]) as suites:
        env = next(iter(next(iter(suites.values())).values()))
        lines, actions = _played(env)
        provenance = suites.provenance
    (folder / "actions.json").write_text(json.dumps(actions))
    (folder / "results.txt").write_text("\n".join(lines))
    (folder / "provenance.json").write_text(json.dumps(provenance, default=str))


def _played(env: Any) -> tuple[list[str], list[Any]]:
    env.action_space.seed(SEED)
    lines, actions = [line(env.reset(seed=SEED)[0])], []
    for _ in range(STEPS):
        action = env.action_space.sample()
        actions.append(plain(action))
        lines.append(line(*env.step(action)[:4]))
    return lines, actions


if __name__ == "__main__":
    main(sys.argv[1])
