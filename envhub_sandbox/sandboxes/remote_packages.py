"""A repository's packages on another host: what is asked of its server, and what it says.

The server's operator decides whether it installs any. What is declared is read here, and again
there; what is made lies there, and no file of it comes here.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

from envhub_sandbox.dependencies.packages import PackageSet
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import PolicyError, RemoteProtocolError
from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.declared import WantedPackage

_HELLO_S = 30.0
_MAKE_S = 2 * 3600.0
_POLL_S = 0.5
_NAME_CHARS = 64
_FACTS = ("lock", "packages")
_MAX_PINS = 10_000
_MAX_CHARS = 300


@dataclass(frozen=True)
class ServerPackages:
    """Packages that a server makes itself: a ``PackageTarget``.

    Attributes:
        use: Gives the server.
        orders: What each was made of, by the server's name for it; what is made is added.
    """

    use: Callable[[], ServerUse[WorkerServer]]
    orders: dict[str, m.NeedPackages]

    def meets(self, request: PackageRequest) -> bool:
        """Unknown here: the server looks at its own packages when it is asked for some."""
        return False

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet | None:
        """The packages that the server makes; None where its own are enough.

        Raises:
            DependencyError: They cannot be made; the text says what to change.
            PolicyError: The server's operator does not permit it.
            ServerBusyError: Others of the same key are at it.
        """
        order = order_of(request)
        use = self.use()
        server = use.server
        try:
            client = WorkerConnection(server.endpoint, server.process_fd, far=server.far)
            with contextlib.closing(client):
                client.hello(Deadline(_HELLO_S))
                made = request_packages(order, client, Deadline(_MAKE_S), tell)
        finally:
            use.release()
        if made is not None:
            self.orders[made.packages] = order
        return made


def order_of(request: PackageRequest) -> m.NeedPackages:
    """What a server is asked for. Raises ``PolicyError`` for a path of this machine."""
    if os.sep in request.python:
        raise PolicyError(
            f"python in dependencies is {request.python!r}, an interpreter of this machine, and a "
            "remote server has its own: name a version, such as '3.12'"
        )
    if request.fetch_python:
        raise PolicyError(
            "fetch_python in dependencies is for this machine; a server's operator installs its "
            "interpreters"
        )
    return m.NeedPackages(
        _rows(request.wanted),
        request.supports,
        request.python,
        request.exclude_newer or "",
        request.always,
        guesses=tuple(
            (str(one.wanted), one.wanted.where, one.module, " ".join(one.brought_by))
            for one in request.guesses
        ),
        constraints=_rows(request.constraints),
        override=_rows(request.override),
        without=request.without,
        gpu=request.gpu,
    )


def _rows(wanted: Sequence[WantedPackage]) -> tuple[tuple[str, str], ...]:
    return tuple((str(one), one.where) for one in wanted)


def request_packages(
    order: m.NeedPackages,
    client: WorkerConnection,
    deadline: Deadline,
    tell: Callable[[str], None] = lambda line: None,
) -> PackageSet | None:
    """Have packages made; None where the server's own do.
    Raises ``DependencyError``: they cannot be made; the text says what to change; ``PolicyError``:
    the server's operator does not permit it; ``ServerBusyError``: others of the same key are at it;
    ``WorkerTimeoutError``: it took too long.
    """
    shown = ""
    while True:
        reply, _ = client.request(order, deadline=deadline)
        found = expect_reply(reply, m.Packages)
        if found.state == "own":
            return None
        if found.state == "made":
            return PackageSet(_name(found.name), _facts(found.facts, order))
        if found.state != "making":
            raise RemoteProtocolError("the server has packages in a state that there is not")
        line = printable(found.progress[:_MAX_CHARS], _MAX_CHARS)
        if line != shown:
            tell(line)
            shown = line
        left = deadline.left_s()
        time.sleep(_POLL_S if left is None else min(_POLL_S, left))


def _name(name: str) -> str:
    """What we shall hand back. Trust: the server's word, for the server itself."""
    if not 0 < len(name) <= _NAME_CHARS or not name.isalnum():
        raise RemoteProtocolError("the server has packages of a name that is none")
    return name


def _facts(facts: dict[str, object], order: m.NeedPackages) -> dict[str, Any]:
    """What is kept for the provenance. Trust: the server's word, checked for its types alone."""
    lock, pins = (facts.get(name) for name in _FACTS)
    if not isinstance(lock, str) or not isinstance(pins, (list, tuple)) or len(pins) > _MAX_PINS:
        raise RemoteProtocolError("the server does not say which packages it has made")
    texts = [printable(str(pin)[:_MAX_CHARS], _MAX_CHARS) for pin in pins]
    kept = {"lock": printable(lock[:_MAX_CHARS], _MAX_CHARS), "packages": texts}
    inferred = _inferred(facts.get("inferred"), order)
    return {**kept, "inferred": inferred} if inferred else kept


def _inferred(said: object, order: m.NeedPackages) -> list[dict[str, str]]:
    """What was taken that nothing declares, of what we have guessed. Trust: the server's word."""
    rows = said if isinstance(said, (list, tuple)) else ()
    modules = {str(row.get("module")) for row in rows[:_MAX_PINS] if isinstance(row, dict)}
    return [
        {"module": module, "requirement": requirement, "where": where}
        for requirement, where, module, _ in cast("tuple[tuple[str, ...], ...]", order.guesses)
        if module in modules
    ]
