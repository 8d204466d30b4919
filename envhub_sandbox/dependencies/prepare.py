"""From a repository's files to the environment that it runs in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies import progress
from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.files import may_declare
from envhub_sandbox.errors import DependencyError, name_source
from envhub_sandbox.hub.snapshot import Snapshot

if TYPE_CHECKING:  # they cost time, and most repositories need none of them
    from envhub_sandbox.dependencies.declared import Declared
    from envhub_sandbox.dependencies.environments import Environment
    from envhub_sandbox.dependencies.interpreters import Interpreter
    from envhub_sandbox.dependencies.resolve import Lock


@dataclass(frozen=True)
class Needs:
    """What is to be installed for a repository.

    Attributes:
        declared: What it declares; None for nothing.
        choice: What the caller says.
    """

    declared: Declared | None
    choice: Choice

    @property
    def source(self) -> str:
        """What says so."""
        return self.declared.source if self.declared else "the argument dependencies"


def needs(snapshot: Snapshot, choice: Choice) -> Needs | None:
    """What is to be installed; None where this interpreter is to be used as it is.

    Raises:
        RequirementError: What the repository declares cannot be taken.
    """
    if choice.where == "host" or (
        choice.where == "auto" and not may_declare(snapshot.root, snapshot.path)
    ):
        return None
    from envhub_sandbox.dependencies import host
    from envhub_sandbox.dependencies.declared import declared

    found = declared(snapshot.root, snapshot.path)
    if choice.where == "auto" and (found is None or host.lacks(found) is None):
        return None
    return Needs(found, choice)


def prepare(
    needed: Needs, tell: Callable[[str], None] = lambda line: None, *, upgrade: bool = False
) -> Environment:
    """The environment for what is needed: known, or resolved and made.

    Args:
        needed: What is to be in it.
        tell: Gets a line for each thing that happens.
        upgrade: Choose versions again, although it is known which were chosen before.

    Raises:
        DependencyError: It cannot be made; the text says what to change.
    """
    from envhub_sandbox.dependencies import environments, interpreters

    declares = needed.declared.python if needed.declared else ""
    interpreter = interpreters.find(needed.choice.python, declares)
    lock = versions(needed, interpreter, tell, upgrade=upgrade)
    return environments.provide(lock, interpreter, tell)


def versions(
    needed: Needs,
    interpreter: Interpreter,
    tell: Callable[[str], None] = lambda line: None,
    *,
    upgrade: bool = False,
) -> Lock:
    """The pins of all packages that are needed, remembered or chosen; raises as ``prepare``."""
    from envhub_sandbox.dependencies import resolutions
    from envhub_sandbox.dependencies.resolve import Target, resolve

    wanted = [*(needed.declared.wanted if needed.declared else ()), *needed.choice.extra]
    exclude_newer = needed.choice.exclude_newer
    key = resolutions.key_of(wanted, interpreter, exclude_newer)
    known = None if upgrade else resolutions.recall(key)
    if known is not None:
        return known
    tell(f"choosing versions for {needed.source}")
    target = Target(python=interpreter.path)
    lock = resolve(wanted, target, exclude_newer=exclude_newer, refresh=upgrade, tell=tell)
    resolutions.remember(key, lock)
    return lock


def provided(snapshot: Snapshot, choice: Choice, *, upgrade: bool = False) -> Environment | None:
    """The environment that a repository runs in; None for this interpreter as it is.

    Progress is shown where somebody looks.

    Raises:
        DependencyError: As ``needs`` and ``prepare``, with the repository's name.
    """
    try:
        needed = needs(snapshot, choice)
        if needed is None:
            return None
        with progress.shown("packages") as tell:
            return prepare(needed, tell, upgrade=upgrade)
    except DependencyError as error:
        name_source(error, snapshot.label)
        raise
