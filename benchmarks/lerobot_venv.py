"""What LeRobot 0.6 needs done to its virtual environment where there is no torch for Python 3.12.

It asks for 3.12, for three classes and functions that name type parameters in its syntax. In an
older interpreter these are written as before; nothing that is executed in an evaluation changes.
torchvision's compiled part fits only the torch of its own release; what LeRobot imports of it is
Python, so that registering operators that are not there is left out.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

_FUTURE = "from __future__ import annotations\n"
_PARAMETERS = re.compile(r"^(class|def) (\w+)\[([^\]]+)\]", re.MULTILINE)
_ALIAS = re.compile(r"^type (\w+) = ", re.MULTILINE)
_GENERIC = "class DataProcessorPipeline(HubMixin)"


def adapt(packages: Path) -> None:
    """Rewrite what an interpreter before 3.12 cannot read, below a ``site-packages``."""
    if sys.version_info >= (3, 12):
        return
    for path in (packages / "lerobot").rglob("*.py"):
        text = path.read_text()
        plain = _ALIAS.sub(r"\1 = ", _PARAMETERS.sub(r"\1 \2", text))
        if plain != text:
            generic = _GENERIC[:-1] + ', __import__("typing").Generic[TInput, TOutput])'
            path.write_text(_deferred(plain.replace(_GENERIC, generic)))
    (packages / "torchvision" / "_meta_registrations.py").write_text("")


def _deferred(text: str) -> str:
    """The same with annotations that nobody evaluates."""
    if _FUTURE in text:
        return text
    first = re.search(r"^(from|import) ", text, re.MULTILINE)
    at = first.start() if first else 0
    return text[:at] + _FUTURE + text[at:]


if __name__ == "__main__":
    adapt(Path(sys.argv[1]))
