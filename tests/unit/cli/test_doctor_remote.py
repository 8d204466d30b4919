"""``envhub doctor tcp://HOST:PORT``: a server's words become a verdict, and nothing but text."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest

from envhub_sandbox.cli.doctor.remote import examine
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_worker.protocol import messages as m
from tests.attacks.client.lying_server import LyingServer, lying

SAID: dict[Any, Any] = {
    "python": "3.12.1", "profile": "no-userns", "weakest_profile": "container", "network": True,
    "quotas": {"jails": 4000, "memory_bytes": 3 << 30, "other": 7}, "draining_s": None,
    "clients": {"alice": {"jails": 1200, "memory_limit_bytes": 1 << 30}},
}  # fmt: skip
Examine = Callable[..., Exit]


class _Place:
    """A server that is reached by a socket in a folder, without keys."""

    insecure_loopback = True

    def __init__(self, server: LyingServer) -> None:
        self.endpoint = server.endpoint

    def far(self) -> None:
        """It is here."""


@pytest.fixture
def looks() -> Iterator[Examine]:
    """``examine`` of a server that says this of itself."""
    with lying() as server:

        def run(said: dict[Any, Any], profile: str = "no-userns", *, json: bool = False) -> Exit:
            answer = m.Sessions((), said)
            server.lies[m.GetSessions] = lambda asked: [asked.answer(answer)]
            return examine(cast("RemoteSandbox", _Place(server)), profile, json=json)

        yield run


def test_quotas_stand_beside_what_is_used(
    looks: Examine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert looks(SAID) is Exit.OK
    text = capsys.readouterr().out
    rows = [line.split() for line in text.splitlines()]
    assert ["jails", "1,200", "4,000"] in rows
    assert ["other", "7"] in rows
    assert "permits network" in " ".join(text.split())
    [memory] = [row for row in rows if row[:1] == ["memory"]]
    assert memory[1][0] == "1"
    assert "3" in memory[-2] + memory[-1]


@pytest.mark.parametrize(
    ("changed", "profile", "code", "said"),
    [
        ({}, "strict", Exit.SANDBOX, "'no-userns' is the strongest"),
        ({"profile": "magic"}, "no-userns", Exit.SANDBOX, "no jail with the profile"),
        ({"draining_s": 3.0}, "no-userns", Exit.WORKER, "it drains"),
        ({"draining_s": 3.0}, "strict", Exit.WORKER, "it drains"),
    ],
)
def test_the_code_is_the_verdict(
    looks: Examine,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any],
    profile: str,
    code: Exit,
    said: str,
) -> None:
    assert looks(SAID | changed, profile) is code
    assert said in " ".join(capsys.readouterr().out.split())
    assert looks(SAID | changed, profile, json=True) is code
    document = json.loads(capsys.readouterr().out)
    assert (document["code"], document["profile"]) == (code, profile)
    assert said in document["problem"]
    assert document["server"]["quotas"] == SAID["quotas"]


def test_a_server_that_says_nothing_is_older(
    looks: Examine, capsys: pytest.CaptureFixture[str]
) -> None:
    """That is no reason to refuse it; and a hostile name is one line of text."""
    assert looks({}) is Exit.OK
    assert "older than this client" in capsys.readouterr().out
    looks(SAID | {"quotas": {"a\n\x1b[2J[red]b_bytes": 1}})
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert "[red]b" in text.splitlines()[-1]
