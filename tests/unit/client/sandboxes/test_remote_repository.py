"""What a server says of packages that it makes: bounded, of the right types, and asked politely."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from envhub_sandbox.dependencies.declared import parse_requirement
from envhub_sandbox.dependencies.modules import Guess
from envhub_sandbox.dependencies.packages import PackageSet
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import (
    DependencyError,
    PolicyError,
    RemoteProtocolError,
    WorkerTimeoutError,
)
from envhub_sandbox.sandboxes.remote_repository import ServerPackages, order_of, request_packages
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from tests.attacks.client.lying_server import Asked, Frames, LyingServer, LyingUse, lying

GUESS = Guess("cv2", parse_requirement("opencv-python", "env.py, line 1"), ())
REQUEST = PackageRequest("org/repo", (parse_requirement("numpy<3", "a.txt"),), guesses=(GUESS,))
FACTS: dict[str, object] = {"lock": "abc", "packages": ("numpy==2.0",)}


@pytest.fixture
def server() -> Iterator[LyingServer]:
    with lying() as found:
        yield found


def says(server: LyingServer, *answers: m.Message) -> None:
    left = list(answers)

    def lie(asked: Asked) -> list[Frames]:
        return [asked.answer(left.pop(0) if len(left) > 1 else left[0])]

    server.lies[m.NeedPackages] = lie


def packages(state: str, name: str = "", progress: str = "", **facts: object) -> m.Packages:
    return m.Packages(state, name, facts, progress)


def make(server: LyingServer, lines: list[str]) -> tuple[PackageSet | None, ServerPackages]:
    """What the server makes; its use is released, whatever it says."""
    use = LyingUse(server)
    target = ServerPackages(lambda: use, {})  # type: ignore[arg-type,return-value]
    try:
        return target.make(REQUEST, lines.append), target
    finally:
        assert not use.live


def test_it_is_asked_until_they_are_made(server: LyingServer) -> None:
    """Each new line of progress is shown once, without what would paint."""
    inferred = [{"module": "cv2", "requirement": "evil"}, {"module": "never asked"}, "none"]
    half = packages("making", progress="\x1b[2J" + "x" * 900)
    says(server, half, half, packages("made", "k1", inferred=inferred, **FACTS))
    lines: list[str] = []
    made, target = make(server, lines)
    assert made is not None
    own = {"module": "cv2", "requirement": "opencv-python", "where": "env.py, line 1"}
    assert made.facts == {"lock": "abc", "packages": ["numpy==2.0"], "inferred": [own]}
    assert target.orders == {"k1": order_of(REQUEST)}
    [line] = lines
    assert line.isprintable()
    assert len(line) <= 310


def test_its_own_packages_are_no_set(server: LyingServer) -> None:
    """Nothing is to be handed back; a refusal is raised as what it is."""
    says(server, packages("own"))
    made, target = make(server, [])
    assert (made, target.orders) == (None, {})
    says(server, m.Refusal("DependencyError", "no such version", "", ""))
    with pytest.raises(DependencyError, match="no such version"):
        make(server, [])


@pytest.mark.parametrize(
    "lie",
    [
        packages("ready"),
        packages("made", "", **FACTS),
        packages("made", "../etc", **FACTS),
        packages("made", "k" * 65, **FACTS),
        packages("made", "k1"),
        packages("made", "k1", **{**FACTS, "lock": 7}),
        packages("made", "k1", **{**FACTS, "packages": "numpy"}),
        packages("made", "k1", **{**FACTS, "packages": ("a",) * 10_001}),
        m.Done(),
    ],
)
def test_other_answers_break_the_protocol(server: LyingServer, lie: m.Message) -> None:
    says(server, lie)
    with pytest.raises(RemoteProtocolError):
        make(server, [])


def test_a_server_that_never_ends_is_given_up(server: LyingServer) -> None:
    says(server, packages("making"))
    client = WorkerConnection(server.endpoint, server.process_fd)
    try:
        with pytest.raises(WorkerTimeoutError):
            request_packages(order_of(REQUEST), client, Deadline(0.05))
    finally:
        client.close()


@pytest.mark.parametrize("given", [{"python": "/usr/bin/python3"}, {"fetch_python": True}])
def test_what_is_of_this_machine_is_not_asked_for(given: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match="dependencies"):
        order_of(PackageRequest("org/repo", (), **given))
