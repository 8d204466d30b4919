"""``envhub doctor tcp://...``: what a server says about itself, and whether it lets us in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from envhub_sandbox.cli.app import app
from envhub_sandbox.sandboxes import server_facts
from envhub_sandbox.sandboxes.server_facts import ServerFacts
from envhub_worker.access import keys
from envhub_worker.access.quotas import Quotas
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.support.processes import eventually
from tests.support.started import started

RUNNER = CliRunner()


def doctor(server: Listening, *options: str, key: str | None = None) -> tuple[int, str, str]:
    """The exit code of a look at a server, and what was printed on both streams."""
    words = ["doctor", server.endpoint, "--server-key", server.public, *options]
    done = RUNNER.invoke(app, words, env={"ENVHUB_CLIENT_KEY": key or server.client_key})
    return done.exit_code, done.stdout, done.stderr


def test_a_server_says_what_it_can_and_what_we_may_take(
    server: Listening, repository: Path
) -> None:
    """Versions, profiles and quotas; to look takes no place."""
    with started(repository, sandbox=server.sandbox()):
        code, out, _ = doctor(server, "--profile", "container", "--json")
        told = json.loads(out)["server"]
        assert told["protocol"] == m.VERSION
        assert told["quotas"]["jails"] == Quotas().jails
        assert told["used"]["jails"] >= 1
        assert told["used"]["sessions"] == 1
        assert not told["draining"]
        assert (code == 0) == (told["weakest_profile"] == "container")
        strict, printed, _ = doctor(server, "--profile", told["profile"])
        assert strict == 0
        [jails] = [line for line in printed.splitlines() if line.startswith("jails ")]
        assert jails.split()[1:] == [str(told["used"]["jails"]), str(Quotas().jails)]


def test_a_profile_that_is_not_permitted_is_the_exit_code(tmp_path: Path) -> None:
    """With why; what is to be had there is 0."""
    with listening(tmp_path / "server", "--weakest-profile", "strict") as server:
        code, out, _ = doctor(server, "--profile", "container")
        assert code == 6
        assert "no jail with the profile 'container'" in out


def test_who_is_not_let_in_is_told_why(server: Listening) -> None:
    """An unknown key, another server's, no address, nobody there."""
    code, _, err = doctor(server, key=key_text(keys.generate().secret))
    assert code == 6
    assert "does not know our key" in err
    other = ["doctor", server.endpoint, "--server-key", key_text(keys.generate().public)]
    done = RUNNER.invoke(app, other, env={"ENVHUB_CLIENT_KEY": server.client_key})
    assert done.exit_code == 6
    assert RUNNER.invoke(app, ["doctor", "http://example"]).exit_code == 2
    assert RUNNER.invoke(app, ["doctor", "--server-key", server.public]).exit_code == 2
    assert RUNNER.invoke(app, ["doctor", server.endpoint, "--profile", "lax"]).exit_code == 2


def test_a_server_without_keys_can_be_asked(tmp_path: Path) -> None:
    """When it is said that it has none; a key beside that is a contradiction."""
    with listening(tmp_path / "server", "--insecure-loopback") as server:
        words = ["doctor", server.endpoint, "--insecure-loopback", "--profile", "container"]
        done = RUNNER.invoke(app, [*words, "--json"])
        assert json.loads(done.stdout)["server"]["protocol"] == m.VERSION
        assert "it asks for no key" in RUNNER.invoke(app, words).stdout
        assert RUNNER.invoke(app, [*words, "--server-key", "x"]).exit_code == 2
        assert RUNNER.invoke(app, ["doctor", "--insecure-loopback"]).exit_code == 2


def test_a_server_that_drains_is_no_place_to_go(tmp_path: Path, repository: Path) -> None:
    """It still answers whoever asks."""
    with (
        listening(tmp_path / "server", "--drain-s", "600") as server,
        started(repository, sandbox=server.sandbox()),
    ):
        server.process.terminate()
        assert eventually(lambda: doctor(server)[0] == 5)
        assert "it drains" in doctor(server)[1]


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"profile": 5, "weakest_profile": ["strict"], "quotas": "many", "clients": 7},
        {
            "python": "\x1b[2J" * 1000,
            "quotas": {"\x1b[2J": 1, "jails": -1, "x": 1 << 70, "y": True},
        },
        {"quotas": {str(number): number for number in range(5000)}, "clients": {"a": None}},
    ],
)
def test_what_a_server_says_is_looked_at(told: dict[str, Any]) -> None:
    """Types and lengths, before it is printed."""
    facts: ServerFacts = server_facts.facts_of(m.Welcome(9, "\x1b[2J" * 100, 1), 0.1, told)
    assert not facts.enforces("strict")
    assert len(facts.quotas) <= 32
    assert set(facts.quotas) <= {str(number) for number in range(32)} | {"\\x1b[2J"}
    for text in (facts.version, facts.python, facts.profile):
        assert text.isprintable()
        assert len(text) < 400
