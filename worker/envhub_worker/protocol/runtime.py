"""What runs a repository: an interpreter of this machine, and the packages that it gets."""

from __future__ import annotations

from typing import NamedTuple


class Runtime(NamedTuple):
    """An interpreter and a folder of packages.

    No dataclass, for a server needs one before it starts its zygote: these import ``inspect``.

    Attributes:
        python: Absolute path of the interpreter. It belongs to the machine and is trusted; empty
            for the worker server's own.
        packages: Absolute path of a folder as ``uv pip install --target`` makes it, whose code is
            as little trusted as the repository's: nothing of it runs outside of a jail. Empty for
            the packages that the interpreter itself has, which are trusted as it is.
    """

    python: str
    packages: str = ""


RECORD = "environment.json"
"""A file beside a folder of packages. A process that uses these shares its lock, one that
removes them has it alone. No jail sees it."""

OWN = Runtime("")
"""The worker server's own interpreter, with its packages."""
