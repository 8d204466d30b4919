"""``python -m benchmarks``, and ``python -m benchmarks auto`` and ``async``."""

import sys

from benchmarks import auto, command, overlap

if __name__ == "__main__":
    if sys.argv[1:2] == ["auto"]:
        auto.main(sys.argv[2:])
    elif sys.argv[1:2] == ["async"]:
        overlap.main(sys.argv[2:])
    else:
        raise SystemExit(command.main())
