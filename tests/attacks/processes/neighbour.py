"""Another live jail of the same server, that attacks aim at."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tests.attacks.harness import Arena, Attacks, Run, run_in, token
from tests.attacks.processes.victim import Victim, victim
from tests.support.processes import eventually

_GRACE_S, _PATIENCE_S = 0.5, 60.0


@dataclass(frozen=True)
class Neighbour:
    """A live jail that holds a secret; the fields are a victim's."""

    env: Any
    secret: str
    pid: int
    address: int
    size: int
    fd: int
    path: str

    def state(self) -> dict[str, Any]:
        return dict(run_in(self.env, "be_victim", secret=None).value)


@contextmanager
def neighbour(arena: Arena, secret: str) -> Iterator[Neighbour]:
    with arena.environment() as env:
        run = run_in(env, "be_victim", secret=secret)
        assert run.value, run.error
        [pid] = run.pids()
        yield Neighbour(env, secret, pid, **run.value)


@dataclass(frozen=True)
class Pair:
    """Whom a payload aims at: a process of the caller's in the control, and another from inside."""

    outside: Victim
    inside: Victim | Neighbour

    def of(self, run: Run) -> Victim | Neighbour:
        """The one that a run aims at."""
        return self.inside if run.inside else self.outside

    def at(self, *names: str) -> dict[str, Any]:
        """Where they are, as ``attack`` takes it for both halves."""
        outside, inside = (
            {name: getattr(one, name) for name in names} for one in (self.outside, self.inside)
        )
        return {**outside, "inside": inside}

    @property
    def secret(self) -> str:
        return self.outside.secret

    def written(self, run: Run) -> bool:
        return "attacked" in self.of(run).state()["text"]

    def signal(
        self,
        place: Attacks,
        title: str,
        payload: str = "signal_one",
        kind: str = "signals",
        **more: Any,
    ) -> None:
        """Attack by a signal, which is counted; the control may reach both."""
        seen: dict[int, int] = {}

        def look() -> None:
            seen.update({one.pid: one.state()[kind] for one in (self.outside, self.inside)})

        def came(run: Run) -> bool:
            patience_s = _GRACE_S if run.inside else _PATIENCE_S
            return eventually(
                lambda: self.of(run).state()[kind] > seen[self.of(run).pid], patience_s
            )

        place.attack(title, payload, came, before=look, **more)


@contextmanager
def victims() -> Iterator[Pair]:
    """Two processes of the caller's: what the control does to one does not show in the other."""
    with victim(token()) as outside, victim(outside.secret) as inside:
        yield Pair(outside, inside)
