"""``python -m tests.compliance.differential``: random cases, for as long as it is told.

::

    python -m tests.compliance.differential --seconds 3600 --seed 1   # an hour
    python -m tests.compliance.differential --kind rows               # send, recv, exceptions
    python -m tests.compliance.differential --kind sharing            # AsyncVectorEnv
    python -m tests.compliance.differential --only 1234               # one case again
    python -m tests.compliance.differential --tcp                     # over a server on loopback

Each case has a number, and is the same in each run. What differs is cut down to the fewest calls
that show it. The exit code is 1 if anything did.
"""

import argparse
import random
import sys
import tempfile
import time
from typing import Any

import pytest

from tests.compliance.differential import KINDS
from tests.compliance.theirs.__main__ import server
from tests.compliance.theirs.through_sandbox import options_of


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.compliance.differential")
    parser.add_argument("--kind", choices=KINDS, default="calls")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=None, help="the number of the first case")
    parser.add_argument("--only", type=int, default=None, help="the number of a single case")
    parser.add_argument("--calls", type=int, default=12, help="in each case")
    parser.add_argument("--tcp", action="store_true", help="over a server on loopback")
    options = parser.parse_args()
    seed = random.SystemRandom().randrange(2**31) if options.seed is None else options.seed
    first = seed if options.only is None else options.only
    kind = KINDS[options.kind]
    print(f"{options.kind} from case {first} on, {options.calls} calls each", flush=True)
    done, failed, until = 0, 0, time.monotonic() + options.seconds
    with (
        tempfile.TemporaryDirectory(prefix="envhub-cases-") as cache,
        pytest.MonkeyPatch.context() as patch,
        server("tcp" if options.tcp else "plain") as told,
    ):
        patch.setenv("ENVHUB_CACHE", cache)
        for name, value in told.items():
            patch.setenv(name, value)
        further = options_of("tcp") if options.tcp else {}
        while time.monotonic() < until and (options.only is None or not done):
            failed += not agrees(kind, first + done, options.calls, further)
            done += 1
    print(f"{done} cases, {failed} of them differ")
    return int(failed > 0)


def agrees(kind: Any, number: int, calls: int, further: dict[str, Any]) -> bool:
    """Whether there is no difference; what there is is printed, with the fewest calls."""
    drawn = kind.case(number)
    found = kind.difference(drawn, calls, further)
    if found is None:
        return True
    for fewer in range(calls):
        shorter = kind.difference(drawn, fewer, further)
        if shorter is not None:
            found, calls = shorter, fewer
            break
    print(f"{drawn}\n    {found}\n    again: --only {number} --calls {calls}", flush=True)
    return False


if __name__ == "__main__":
    sys.exit(main())
