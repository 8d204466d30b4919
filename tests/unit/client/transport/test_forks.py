"""Whose an environment is: the process that made it, and no fork of it."""

from __future__ import annotations

import os

from envhub_sandbox.transport.forks import Owner, foreign


def test_a_fork_is_another_process() -> None:
    """And is told whose it is, and which one it is itself."""
    owner = Owner()
    assert owner.is_here
    child = os.fork()
    if child == 0:  # pragma: no cover
        os._exit(0 if not owner.is_here and str(os.getpid()) in foreign(owner.pid) else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert f"belongs to process {owner.pid}" in foreign(owner.pid)
    assert "belongs to another process" in foreign()
