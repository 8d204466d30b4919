"""A client held by its descriptors: ``python -m tests.attacks.runner.held_client``.
argv: the repository, then one JSON object: ``acts`` (each for an environment of its own) and
``every``, as ``abuser`` takes them, ``policy``, ``options`` of ``make_env``, ``steps`` (the actions
of each), and ``close`` (the thread that does it: ``"same"`` or ``"other"``). Prints each act with
what became of its steps, and ``closed`` at the end. Whoever started it watches from outside whether
that comes. A neighbour, another jail of the same server, has to go on as if nothing had happened.
"""

import json
import sys
import threading
from typing import Any

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError

TIMEOUTS = {"step_s": 1.0, "close_s": 1.0}
"""Its environment turns on it in a step; what comes before that is answered, sooner or later."""
HEAD_START_S = 1.0


def outcome(act: Any) -> str:
    """What an act came to; only errors of our own tree, and Gymnasium's, are an answer."""
    try:
        act()
    except EnvHubError as error:
        return type(error).__name__
    return "done"


def suffer(repository: str, order: dict[str, Any], act: str) -> None:
    """Step and close an environment that does this, as told."""
    suites = make_env(repository, policy=order["policy"], timeouts=TIMEOUTS, **order["options"])
    env = suites.env
    env.reset(options={"act": act, "every": order["every"]})

    def drive() -> None:
        for actions in order["steps"]:
            print(act, outcome(lambda: env.step(actions)), flush=True)  # noqa: B023 - called at once

    driver = threading.Thread(target=drive, daemon=True)
    if order["close"] == "same":
        drive()
    else:
        driver.start()
        driver.join(HEAD_START_S)
    env.close()
    if order["close"] == "other":
        driver.join()
    suites.close()


def main(repository: str, order: dict[str, Any]) -> int:
    neighbours = make_env(repository, policy=order["policy"])
    neighbours.env.reset()
    for act in order["acts"]:
        suffer(repository, order, act)
        neighbours.env.step([0])
    neighbours.close()
    print("closed", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], json.loads(sys.argv[2])))
