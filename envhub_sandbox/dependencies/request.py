"""What packages a repository is to have: what it declares, and what the caller says.

One value, whichever place the repository runs in. Reading it runs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.files import may_declare
from envhub_sandbox.hub.snapshot import Snapshot

if TYPE_CHECKING:  # they cost time, and most repositories need none of them
    from envhub_sandbox.dependencies.declared import Wanted
    from envhub_sandbox.dependencies.guesses import Guess


@dataclass(frozen=True)
class PackageRequest:
    """What packages a repository is to have.

    Attributes:
        source: The file, or the argument, that says so.
        wanted: All requirements.
        supports: The versions of Python that the repository runs in; empty for any.
        python: The version or versions that the caller asks for, or a path; empty for none.
        exclude_newer: A date: packages of later are not seen.
        always: Whether it gets an environment of its own even where the place meets all of it.
        guesses: What it imports; what no other package brings is installed, too.
        constraints: What holds for packages if something needs them.
        without: Names of packages that are left out, whoever needs them.
        override: Requirements that hold instead of all others of the same package.
        fetch_python: Whether uv may download an interpreter that this machine lacks.
        gpu: Whether its jails are given one.
        runs_worker: Whether the worker runs with them, so that they hold what it needs, too.
    """

    source: str
    wanted: tuple[Wanted, ...]
    supports: str = ""
    python: str = ""
    exclude_newer: str | None = None
    always: bool = False
    guesses: tuple[Guess, ...] = ()
    constraints: tuple[Wanted, ...] = ()
    without: tuple[str, ...] = ()
    override: tuple[Wanted, ...] = ()
    fetch_python: bool = False
    gpu: bool = False
    runs_worker: bool = True

    def plus(self, guesses: tuple[Guess, ...]) -> PackageRequest:
        """The same with these as requirements, and no guesses."""
        wanted = (*self.wanted, *(one.wanted for one in guesses))
        return replace(self, wanted=wanted, guesses=())


def request_of(snapshot: Snapshot, choice: Choice, *, gpu: bool = False) -> PackageRequest | None:
    """What a repository is to have; None where the place's own packages are used as they are.

    Raises:
        RequirementError: What the repository declares cannot be taken.
    """
    if choice.where == "host":
        return None
    auto, found = choice.where == "auto", None
    if choice.only is None and may_declare(snapshot.root, snapshot.path):
        from envhub_sandbox.dependencies.declared import declared

        found = declared(snapshot.root, snapshot.path)
    guesses = _guesses(snapshot, choice)
    if auto and found is None and not guesses:
        return None
    says = choice.only if choice.only is not None else (found.wanted if found else ())
    return PackageRequest(
        source=found.source if found else _source(choice),
        wanted=(*says, *choice.extra),
        supports=found.python if found else "",
        python=choice.python,
        exclude_newer=choice.exclude_newer,
        always=not auto,
        guesses=guesses,
        constraints=found.constraints if found else (),
        without=choice.without,
        override=choice.override,
        fetch_python=choice.fetch_python,
        gpu=gpu,
    )


def _guesses(snapshot: Snapshot, choice: Choice) -> tuple[Guess, ...]:
    if not choice.infer:
        return ()
    from envhub_sandbox.dependencies.guesses import guessed

    left_out = set(choice.without)
    return tuple(one for one in guessed(snapshot) if left_out.isdisjoint(one.brought_by))


def _source(choice: Choice) -> str:
    return "what it imports" if choice.where == "auto" else "the argument dependencies"
