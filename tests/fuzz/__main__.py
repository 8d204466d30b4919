"""``python -m tests.fuzz``: lies to the client for as long as it is told.

::

    python -m tests.fuzz --seconds 3600 --seed 1        # an hour, shared by all targets
    python -m tests.fuzz --examples 500 results lane    # so many of each of these
    python -m tests.fuzz --seed 1 --only 1234 results   # one of them again, with its traceback

The lies are told in a child process of limited memory, which is killed if one takes too long. What
is printed at the end: for each target how many lies were taken, refused, or could not be sent, the
slowest, and the most memory. The exit code is 1 if anything came out that must not.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.fuzz import traffic

ROOT = Path(__file__).parents[2]


def main() -> int:
    options = parse()
    options.seed = random.SystemRandom().randrange(2**32) if options.seed is None else options.seed
    print(f"seed {options.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="envhub-fuzz-") as folder:
        if options.corpus is None:
            options.corpus = str(Path(folder) / "traffic")
            record = [sys.executable, "-m", traffic.__name__, options.corpus]
            subprocess.run(record, cwd=ROOT, check=True)
        note = Path(folder) / "note"
        job = json.dumps(vars(options) | {"note": str(note)})
        child = subprocess.run(
            [sys.executable, "-m", "tests.fuzz.child", job], cwd=ROOT, check=False
        )
        if child.returncode < 0:
            how = signal.Signals(-child.returncode).name
            told = note.read_bytes().rstrip(b"\0").decode()
            hung = f" (no lie may take {options.patience} s)" if how == "SIGALRM" else ""
            print(f"FAILED: {told} ended the process by {how}{hung}; seed {options.seed}")
            return 1
    return child.returncode


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help="all if none is named")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--examples", type=int, default=None, help="of each target")
    parser.add_argument("--seconds", type=float, default=60.0, help="if no number is given")
    parser.add_argument("--only", type=int, default=None, help="the number of one example")
    parser.add_argument("--corpus", default=None, help="a recording of tests.fuzz.traffic")
    parser.add_argument("--memory", type=int, default=1 << 30, help="bytes beyond the start's")
    parser.add_argument("--patience", type=int, default=60, help="seconds for a single lie")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    return parser.parse_args()


if __name__ == "__main__":
    os.environ.setdefault("PYTHONFAULTHANDLER", "1")
    sys.exit(main())
