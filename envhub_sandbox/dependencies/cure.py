"""What to do where a module is missing, in the words of the place where the repository ran."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.errors import RequirementError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.option_names import option_name

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.declared import Declared

_SHOWN = 20


def cure(
    snapshot: Snapshot,
    place: str,
    choice: Choice,
    python: str | Path | None,
    own: bool,
) -> str:
    """Two sentences: what the repository declares, and the one thing that helps.

    Args:
        snapshot: Its files.
        place: The sandbox's name.
        choice: Where its packages were to come from.
        python: The interpreter that the caller named.
        own: Whether it ran in an environment that was made for it.
    """
    from envhub_sandbox.dependencies.declared import declared

    try:
        found = declared(snapshot.root, snapshot.path)
    except RequirementError as error:
        return f"What it declares cannot be taken: {error}"
    return f"{_what(found)}. {_advice(place, choice, python, own, found)}"


def _what(found: Declared | None) -> str:
    if found is None or not found.wanted:
        return "It declares no packages"
    names = [str(wanted.requirement) for wanted in found.wanted]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"Its {found.source} declares {', '.join(names[:_SHOWN])}{more}"


def _advice(
    place: str,
    choice: Choice,
    python: str | Path | None,
    own: bool,
    found: Declared | None,
) -> str:
    extra = option_name("dependencies", {"extra": ["NAME-OF-THE-PACKAGE"]})
    if place == "docker":
        if own:
            return (
                f"It ran in a container, with packages of its own; this one joins them with {extra}"
            )
        return (
            f"It ran in a container, with the image's packages: it gets others with {extra}, or "
            "with an image that has them (envhub image build REF, then "
            f"{option_name('sandbox', 'docker:IMAGE')})"
        )
    if place == "remote":
        if own:
            return (
                "It ran on another host, in an environment of its own; the package joins it with "
                f"{extra}"
            )
        return (
            "It ran on another host, with the packages of its server: whoever runs that installs "
            "the package into its interpreter, or starts it with --dependencies, and the package "
            f"comes with {extra}"
        )
    if python is not None:
        return f"It ran in {python}: install the package there, or leave out that argument"
    if own:
        return f"It ran in an environment of its own; the package joins it with {extra}"
    if choice.where == "host" and found is not None and found.wanted:
        return (
            f"It ran in this interpreter ({sys.executable}), as "
            f"{option_name('dependencies', 'host')} says; leave that out, and it gets an "
            "environment of its own"
        )
    return (
        f"It ran in this interpreter ({sys.executable}); it gets an environment of its own, and "
        f"the package in it, with {extra}"
    )
