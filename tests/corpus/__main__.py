"""``python -m tests.corpus [PART ...]`` judges the entries whose names contain a part, or all.

It prints what is found, and ends with 1 where that is not what stands there.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from tests.corpus.faults import FAULTS
from tests.corpus.honest import HONEST


def main(parts: list[str]) -> int:
    """Judge them one after the other."""
    wrong = []
    for name, entry in {**HONEST, **FAULTS}.items():
        if parts and not any(part in name for part in parts):
            continue
        with tempfile.TemporaryDirectory(prefix="envhub-corpus-") as folder:
            Path(folder).chmod(0o755)
            begun = time.monotonic()
            found = entry.judged(Path(folder))
        is_right = set(found) == entry.expected
        wrong += [] if is_right else [name]
        words = "as expected" if is_right else "NOT SO"
        print(f"{words:12} {name} ({time.monotonic() - begun:.1f} s)", flush=True)
        for check, text in found.items():
            print(f"             {check}: {text[:200]}".replace("\n", " "))
    print(f"{len(wrong)} are not as they stand here: {', '.join(wrong)}" if wrong else "all so")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
