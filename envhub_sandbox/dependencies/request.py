"""What packages a repository is to have: what it declares, and what the caller says.

One value, whichever place the repository runs in. Reading it runs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.files import may_declare
from envhub_sandbox.hub.snapshot import Snapshot

if TYPE_CHECKING:  # they cost time, and most repositories need none of them
    from envhub_sandbox.dependencies.declared import Wanted


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
    """

    source: str
    wanted: tuple[Wanted, ...]
    supports: str = ""
    python: str = ""
    exclude_newer: str | None = None
    always: bool = False


def request_of(snapshot: Snapshot, choice: Choice) -> PackageRequest | None:
    """What a repository is to have; None where the place's own packages are used as they are.

    Raises:
        RequirementError: What the repository declares cannot be taken.
    """
    auto = choice.where == "auto"
    if choice.where == "host" or (auto and not may_declare(snapshot.root, snapshot.path)):
        return None
    from envhub_sandbox.dependencies.declared import declared

    found = declared(snapshot.root, snapshot.path)
    if found is None and auto:
        return None
    return PackageRequest(
        source=found.source if found else "the argument dependencies",
        wanted=(*(found.wanted if found else ()), *choice.extra),
        supports=found.python if found else "",
        python=choice.python,
        exclude_newer=choice.exclude_newer,
        always=not auto,
    )
