"""``python -m benchmarks``, and ``python -m benchmarks auto``."""

import sys

from benchmarks import auto, command

if __name__ == "__main__":
    if sys.argv[1:2] == ["auto"]:
        auto.main(sys.argv[2:])
    else:
        raise SystemExit(command.main())
