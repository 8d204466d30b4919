"""Another live jail of the same server, that attacks aim at."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tests.attacks.harness import Arena, Run, call, new_alias


@dataclass(frozen=True)
class Neighbour:
    """A live jail that holds a secret.

    Attributes:
        env: Its environment.
        pid: Its process, as it is seen from here.
        address: Where in its memory the secret lies.
        size: Length of the secret.
        fd: Its descriptor of a file that holds the secret.
        path: That file, as the jail calls it.
    """

    env: Any
    pid: int
    address: int
    size: int
    fd: int
    path: str

    def state(self) -> dict[str, Any]:
        """``text``, what its memory holds now, ``signals`` and ``broadcasts`` that have come."""
        run = Run(new_alias(), True)
        call(self.env, run, "be_victim", {"secret": None})
        return dict(run.value)


@contextmanager
def neighbour(arena: Arena, secret: str) -> Iterator[Neighbour]:
    """Another jail, of the same server."""
    with arena.environment() as env:
        run = Run(new_alias(), True)
        call(env, run, "be_victim", {"secret": secret})
        assert run.value, run.error
        [pid] = run.pids()
        yield Neighbour(env, pid, **run.value)
