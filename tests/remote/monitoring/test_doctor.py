"""``envhub doctor tcp://...``: what a server says about itself, and whether it lets us in."""

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from envhub_sandbox.cli.app import app
from envhub_worker.extras.access import keys
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.support.processes import eventually
from tests.support.started import started

RUNNER = CliRunner()


def doctor(server: Listening, *options: str, key: str | None = None) -> tuple[int, str, str]:
    words = ["doctor", f"{server.endpoint} {server.public}", *options]
    done = RUNNER.invoke(app, words, env={"ENVHUB_CLIENT_KEY": key or server.client_key})
    return done.exit_code, done.stdout, done.stderr


def looked(server: Listening) -> tuple[int, dict[str, Any]]:
    code, out, _ = doctor(server, "--profile", "container", "--json")
    return code, json.loads(out)["server"]


def alone(used: dict[str, int]) -> bool:
    """Whether one environment of one client is all that there is."""
    return used["jails"] == used["sessions"] == 1


def test_a_server_says_what_it_can_and_permits(server: Listening, repository: Path) -> None:
    with started(repository, sandbox=server.sandbox()):
        # what others have left goes when the server notices that they have gone
        assert eventually(lambda: alone(looked(server)[1]["used"]))
        code, told = looked(server)
        assert told["protocol"] == m.VERSION
        assert told["quotas"]["jails"] == Quotas().jails
        assert alone(told["used"])
        assert not told["draining"]
        assert (code == 0) == (told["weakest_profile"] == "container")
        strict, printed, _ = doctor(server, "--profile", told["profile"])
        assert strict == 0
        [jails] = [line for line in printed.splitlines() if line.startswith("jails ")]
        assert jails.split()[1:] == [str(told["used"]["jails"]), str(Quotas().jails)]


def test_who_is_not_let_in_is_told_why(server: Listening) -> None:
    code, _, err = doctor(server, key=key_text(keys.generate().secret))
    assert code == 6
    assert "does not know our key" in err
    other = ["doctor", f"{server.endpoint} {key_text(keys.generate().public)}"]
    done = RUNNER.invoke(app, other, env={"ENVHUB_CLIENT_KEY": server.client_key})
    assert (done.exit_code, RUNNER.invoke(app, ["doctor", "http://example"]).exit_code) == (6, 2)
    assert RUNNER.invoke(app, ["doctor", server.endpoint, "--profile", "lax"]).exit_code == 2


def test_a_server_without_keys_can_be_asked(tmp_path: Path) -> None:
    """When it is said that it has none; a key beside that is a contradiction."""
    with listening(tmp_path / "server", "--insecure-loopback") as server:
        options = ["--insecure-loopback", "--profile", "container"]
        words = ["doctor", server.endpoint, *options]
        done = RUNNER.invoke(app, [*words, "--json"])
        assert json.loads(done.stdout)["server"]["protocol"] == m.VERSION
        assert "it asks for no key" in RUNNER.invoke(app, words).stdout
        assert RUNNER.invoke(app, ["doctor", f"{server.endpoint} x", *options]).exit_code == 2
        assert RUNNER.invoke(app, ["doctor", "--insecure-loopback"]).exit_code == 2
