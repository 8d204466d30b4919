"""``envhub doctor tcp://...``: what a server says about itself, and whether it lets us in."""

import json
import subprocess
from pathlib import Path
from typing import Any

from envhub_worker.extras.access import keys
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.support.command_line import envhub
from tests.support.processes import eventually
from tests.support.started import started


def doctor(server: Listening, *options: str, **more: Any) -> subprocess.CompletedProcess[str]:
    key = {"ENVHUB_CLIENT_KEY": server.client_key}
    return envhub("doctor", f"{server.endpoint} {server.public}", *options, **key | more)


def looked(server: Listening) -> tuple[int, dict[str, Any]]:
    done = doctor(server, "--profile", "container", "--json")
    return done.returncode, json.loads(done.stdout)["server"]


def alone(used: dict[str, int]) -> bool:
    """Whether one environment of one client is all that there is."""
    return used["jails"] == used["sessions"] == 1


def test_a_server_says_what_it_can_and_permits(server: Listening, repository: Path) -> None:
    with started(repository, sandbox=server.sandbox()):
        # what others have left goes when the server notices that they have gone
        assert eventually(lambda: alone(looked(server)[1]["used"]))
        code, told = looked(server)
        assert (told["protocol"], told["quotas"]["jails"]) == (m.VERSION, Quotas().jails)
        assert (alone(told["used"]), told["draining"]) == (True, False)
        assert (code == 0) == (told["weakest_profile"] == "container")
        printed = doctor(server, "--profile", told["profile"], code=0).stdout
        [jails] = [line for line in printed.splitlines() if line.startswith("jails ")]
        assert jails.split()[1:] == [str(told["used"]["jails"]), str(Quotas().jails)]


def test_who_is_not_let_in_is_told_why(server: Listening) -> None:
    stranger = doctor(server, ENVHUB_CLIENT_KEY=key_text(keys.generate().secret), code=6)
    assert "does not know our key" in stranger.stderr
    other = f"{server.endpoint} {key_text(keys.generate().public)}"
    envhub("doctor", other, ENVHUB_CLIENT_KEY=server.client_key, code=6)
    envhub("doctor", "http://example", code=2)
    envhub("doctor", server.endpoint, "--profile", "lax", code=2)


def test_a_server_without_keys_can_be_asked(tmp_path: Path) -> None:
    """When it is said that it has none; a key beside that is a contradiction."""
    with listening(tmp_path / "server", "--insecure-loopback") as server:
        options = ["--insecure-loopback", "--profile", "container"]
        done = envhub("doctor", server.endpoint, *options, "--json")
        assert json.loads(done.stdout)["server"]["protocol"] == m.VERSION
        assert "it asks for no key" in envhub("doctor", server.endpoint, *options).stdout
        envhub("doctor", f"{server.endpoint} x", *options, code=2)
        envhub("doctor", "--insecure-loopback", code=2)
