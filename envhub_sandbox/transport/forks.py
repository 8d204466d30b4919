"""Which process an object belongs to, so that a fork leaves it alone: interruption.md, rule 14."""

from __future__ import annotations

import os


class Owner:
    """The process that made this.

    Attributes:
        pid: Its number. Where each step asks, this is compared without a call.
    """

    def __init__(self) -> None:
        self.pid = os.getpid()

    @property
    def is_here(self) -> bool:
        """Whether it is this one, and no fork of it."""
        return os.getpid() == self.pid


def fork_error_text(owner: int | None = None) -> str:
    """The text of the error of an environment that is used in a fork of its owner."""
    whose = "this environment belongs to another process"
    if owner is not None:
        whose = f"this environment belongs to process {owner}"
    return (
        f"{whose}, and this is a fork of it ({os.getpid()}); call make_env here to get one of its "
        "own"
    )
