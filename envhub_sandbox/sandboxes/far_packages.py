"""A repository's packages on another host: what is asked of its server, and what it says.

The server's operator decides whether it installs any. What is declared is read here, and again
there; what is made lies there, and no file of it comes here.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.files import may_declare
from envhub_sandbox.errors import (
    DependencyError,
    PolicyError,
    RemoteProtocolError,
    name_source,
)
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.transport.connection import WorkerClient
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import printable

_POLL_S = 0.5
_NAME_CHARS = 64
_FACTS = ("lock", "packages")
_MAX_PINS = 10_000
_MAX_CHARS = 300


@dataclass(frozen=True)
class FarEnvironment:
    """An environment that a server has made.

    Attributes:
        packages: What the server calls it.
        facts: What is in it, by the server's word.
        python: Nothing: the interpreter is the server's to know.
    """

    packages: str
    facts: dict[str, Any]
    python: str = ""


@dataclass(frozen=True)
class Order:
    """What a repository needs.

    Attributes:
        label: The repository, for errors.
        message: As it travels.
    """

    label: str
    message: m.NeedPackages

    def bring(
        self,
        client: WorkerClient,
        deadline: Deadline,
        tell: Callable[[str], None] = lambda line: None,
    ) -> FarEnvironment | None:
        """Have it made; None where the server's own packages do.

        Raises:
            DependencyError: It cannot be made; the text says what to change.
            PolicyError: The server's operator does not permit it.
            ServerBusyError: Others of the same key are at it.
            WorkerTimeoutError: It took too long.
        """
        try:
            return self._made(client, deadline, tell)
        except (DependencyError, PolicyError) as error:
            name_source(error, self.label)
            raise

    def _made(
        self, client: WorkerClient, deadline: Deadline, tell: Callable[[str], None]
    ) -> FarEnvironment | None:
        told = ""
        while True:
            reply, _ = client.request(self.message, deadline=deadline)
            found = expect(reply, m.Packages)
            if found.state == "own":
                return None
            if found.state == "made":
                return FarEnvironment(_name(found.name), _facts(found.facts))
            if found.state != "making":
                raise RemoteProtocolError("the server has packages in a state that there is not")
            line = printable(found.told[:_MAX_CHARS], _MAX_CHARS)
            if line != told:
                tell(line)
                told = line
            left = deadline.left_s()
            time.sleep(_POLL_S if left is None else min(_POLL_S, left))


def order_of(snapshot: Snapshot, choice: Choice) -> Order | None:
    """What is to be asked for; None for nothing.

    Raises:
        RequirementError: What the repository declares cannot be taken.
        PolicyError: The choice names a path of this machine.
    """
    if choice.where == "host" or (
        choice.where == "auto" and not may_declare(snapshot.root, snapshot.path)
    ):
        return None
    from envhub_sandbox.dependencies.declared import declared

    try:
        found = declared(snapshot.root, snapshot.path)
    except DependencyError as error:
        name_source(error, snapshot.label)
        raise
    if choice.where == "auto" and found is None:
        return None
    if os.sep in choice.python:
        raise PolicyError(
            f"python in dependencies is {choice.python!r}, an interpreter of this machine, and a "
            "remote server has its own: name a version, such as '3.12'"
        )
    wanted = [*(found.wanted if found else ()), *choice.extra]
    rows = tuple((str(one), one.where) for one in wanted)
    supports = found.python if found else ""
    until, always = choice.exclude_newer or "", choice.where == "own"
    return Order(snapshot.label, m.NeedPackages(rows, supports, choice.python, until, always))


def _name(name: str) -> str:
    """What we shall hand back. Trust: the server's word, for the server itself."""
    if not 0 < len(name) <= _NAME_CHARS or not name.isalnum():
        raise RemoteProtocolError("the server has packages of a name that is none")
    return name


def _facts(facts: dict[str, object]) -> dict[str, Any]:
    """What is kept for the provenance. Trust: the server's word, checked for its types alone."""
    lock, pins = (facts.get(name) for name in _FACTS)
    if not isinstance(lock, str) or not isinstance(pins, (list, tuple)) or len(pins) > _MAX_PINS:
        raise RemoteProtocolError("the server does not say which packages it has made")
    texts = [printable(str(pin)[:_MAX_CHARS], _MAX_CHARS) for pin in pins]
    return {"lock": printable(lock[:_MAX_CHARS], _MAX_CHARS), "packages": texts}
