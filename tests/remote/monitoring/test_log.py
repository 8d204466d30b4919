"""What a server writes down: a line an event, as an operator and his programs read it."""

import json
import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, ServerBusyError, WorkerDiedError
from envhub_worker.extras.access import keys
from envhub_worker.extras.access.audit.log import LEVELS
from envhub_worker.extras.access.keys import KeyPair
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started

LIVE, EXIT = 0, 1
# under nohup all that we start ignores the end of a terminal
_IGNORED = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
_HANGS_UP = signal.SIGINT if _IGNORED else signal.SIGHUP
_TEXT = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (\w+) (\w+)( \w+=(\"[ -~]*?\"|\S+))*")


@contextmanager
def logging_server(folder: Path, names: dict[str, KeyPair], *options: str) -> Iterator[Listening]:
    folder.mkdir(exist_ok=True)
    listed = folder / "clients"
    lines = [f"{key_text(pair.public)} {name}\n" for name, pair in names.items()]
    listed.write_text("".join(lines), "utf-8")
    with listening(folder / "server", "--authorized-clients", str(listed), *options) as server:
        yield server


def replace(path: Path, text: str) -> None:
    new = path.with_suffix(".new")
    new.write_text(text, "utf-8")
    os.replace(new, path)


def events(server: Listening) -> list[dict[str, Any]]:
    return [json.loads(line) for line in server.said().splitlines()]


def of(server: Listening, event: str, **fields: object) -> list[dict[str, Any]]:
    return [
        one
        for one in events(server)
        if one["event"] == event and all(one.get(name) == is_ for name, is_ in fields.items())
    ]


def test_the_life_of_two_clients_can_be_read(
    tmp_path: Path, wait_no_more: Callable[[], None]
) -> None:
    """Who came, what was opened for whom, what died of what, what was refused, and who left. That
    a list of clients is broken is told once, and that it is read again. The end of the server, also
    when its terminal is closed, is the end of its jails, its clients and its note."""
    names = {"Zoë": keys.generate(), "bob the builder": keys.generate()}
    with logging_server(tmp_path, names, "--log-format", "json", "--max-jails", "1") as server:
        zoe, bob = (server.sandbox(client_key=key_text(one.secret)) for one in names.values())
        listed = (tmp_path / "clients").read_text("utf-8")
        replace(tmp_path / "clients", f"{listed}no key\n")
        assert eventually(lambda: of(server, "clients_kept_as_they_were"))
        with started(sample("counter"), n_envs=2, sandbox=zoe) as env:
            env.step(env.action_space.sample())
            with pytest.raises(ServerBusyError), started(sample("mortal"), sandbox=zoe):
                pass
            with started(sample("mortal"), sandbox=bob) as others, pytest.raises(WorkerDiedError):
                others.step([EXIT])
            with pytest.raises(PolicyError):
                make_env(sample("mortal"), sandbox=bob, policy={"network": "host"})
        assert eventually(lambda: of(server, "jail_closed", client="Zoë"))
        replace(tmp_path / "clients", listed)
        assert eventually(lambda: of(server, "clients_read", clients=2))
        with started(sample("mortal"), sandbox=bob):
            server.process.send_signal(_HANGS_UP)
            assert server.process.wait(60) == 0
            wait_no_more()
    assert server.noted() == ""
    found = events(server)
    first, last = found[0], found[-1]
    assert (first["event"], last["event"]) == ("listening", "stopped")
    assert first["server_key"] == server.public
    assert all(one["level"] in LEVELS and one["time"].endswith("Z") for one in found)
    assert [one["time"] for one in found] == sorted(one["time"] for one in found)
    assert {one["client"] for one in of(server, "client_connected")} == set(names)
    [opened] = of(server, "jail_opened", client="Zoë")
    assert opened["environment"].endswith("counter:env.py")
    assert re.fullmatch("[0-9a-f]{64}", opened["snapshot"])
    assert opened["profile"] == "strict"
    assert opened["seconds"] > 0
    [closed] = of(server, "jail_closed", client="Zoë")
    assert (closed["jail"], closed["session"]) == (opened["jail"], opened["session"])
    assert closed["bytes_in"] > 0 < closed["bytes_out"]
    [upload] = of(server, "upload", client="Zoë", snapshot=opened["snapshot"])
    assert upload["bytes"] > 0
    busy = of(server, "refused", client="Zoë", error="ServerBusyError")
    assert {(one["quota"], one["used"], one["limit"]) for one in busy} == {("jails", 1, 1)}
    [died] = of(server, "jail_died", client="bob the builder")
    assert (died["reason"], died["level"]) == ("exit", "warning")
    assert died["environment"].endswith("mortal:env.py")
    [refused] = of(server, "refused", client="bob the builder")
    assert (refused["error"], "--allow-network" in refused["why"]) == ("PolicyError", True)
    [wrong] = of(server, "clients_kept_as_they_were")
    assert "line 3" in wrong["why"]
    running = of(server, "jail_opened", client="bob the builder")[-1]
    assert of(server, "jail_closed", jail=running["jail"], session=running["session"])
    assert of(server, "client_left", session=running["session"], why="the server ends")


def test_no_secret_is_in_a_log(tmp_path: Path) -> None:
    alice = keys.generate()
    with logging_server(tmp_path, {"alice": alice}, "--log-level", "debug") as server:
        secret = key_text(alice.secret)
        with started(sample("mortal"), sandbox=server.sandbox(client_key=secret)):
            pass
        assert eventually(lambda: "jail_closed" in server.said())
    lines = [line for line in server.said().splitlines() if _TEXT.match(line)]
    assert any(" jail_opened client=alice " in line for line in lines)
    own = (server.state / "server.key").read_text().strip()
    assert not any(key in server.said() for key in (secret, own))


def test_less_can_be_asked_for(tmp_path: Path) -> None:
    """Of an ordinary life nothing is as bad as a warning."""
    alice = keys.generate()
    options = ("--log-format", "json", "--log-level", "warning")
    with logging_server(tmp_path, {"alice": alice}, *options) as server:
        remote = server.sandbox(client_key=key_text(alice.secret))
        with started(sample("mortal"), sandbox=remote):
            pass
        assert eventually(lambda: server.jails() == 0)
    assert server.said() == ""
