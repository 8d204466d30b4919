"""A client held by its descriptors: ``python -m tests.attacks.runner.held_client``.

argv: the repository, then one JSON object: ``policy``, ``options`` of ``make_env``, ``steps`` (the
actions of each), ``close`` (the thread that does it: ``"same"`` or ``"other"``) and
``head_start_s`` of the one that steps. Prints what became of each step, and ``closed`` at the end.
Whoever started it watches from outside whether that comes. A neighbour, another jail of the same
server, has to go on as if nothing had happened.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError

TIMEOUTS = {"step_s": 2.0, "close_s": 1.0}
"""Its environment turns on it in a step; what comes before that is answered, sooner or later."""


def outcome(act: Any) -> str:
    """What an act came to; only errors of our own tree, and Gymnasium's, are an answer."""
    try:
        act()
    except EnvHubError as error:
        return type(error).__name__
    return "done"


def main(repository: str, order: dict[str, Any]) -> int:
    """Step and close, as told."""
    neighbours = make_env(repository, policy=order["policy"])
    neighbours.env.reset()
    suites = make_env(repository, policy=order["policy"], timeouts=TIMEOUTS, **order["options"])
    env = suites.env
    env.reset()

    def drive() -> None:
        for actions in order["steps"]:
            print(outcome(lambda: env.step(actions)), flush=True)  # noqa: B023 - called at once

    if order["close"] == "same":
        drive()
    else:
        driver = threading.Thread(target=drive, daemon=True)
        driver.start()
        driver.join(order["head_start_s"])
    env.close()
    if order["close"] == "other":
        driver.join()
    suites.close()
    neighbours.env.step([0])
    neighbours.close()
    print("closed", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], json.loads(sys.argv[2])))
