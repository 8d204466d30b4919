"""Writing into the log of a server that many share, what never happened there."""

import json
import re
from dataclasses import asdict
from pathlib import Path

import pytest

from envhub_worker.extras.access import keys
from envhub_worker.extras.access.audit.log import FORMS, Log
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.remote.peers import Peer, brought, peer
from tests.support.processes import eventually

MALLORY = keys.generate()
_TIME = "2026-01-31T12:00:00.000Z"
FORGED = {
    "text": f"{_TIME} info jail_opened client=admin",
    "json": json.dumps({"time": _TIME, "level": "info", "event": "jail_opened", "client": "admin"}),
}
BREAKS = ("\n", "\r\n", "\r", "\x85", "\u2028", "\x0b", "\x0c", "\x1b[2K\x1b[1G")
# writes to all that it might share with the server, and dies
ENVIRONMENT = """
import os
for line in {forged!r}:
    for place in (1, 2, "/dev/stderr", "/proc/1/fd/2", "/dev/kmsg"):
        try:
            fd = place if isinstance(place, int) else os.open(place, os.O_WRONLY)
            os.write(fd, ("\\n" + line + "\\n").encode())
        except OSError:
            pass
os._exit(3)
"""


def forged(written: str, form: str) -> list[str]:
    """The lines, to whoever may break them, that say that the admin opened a jail."""
    told = re.compile(r"\S+Z info jail_opened client=admin\b").match
    believes = said_by_admin if form == "json" else told
    return [line for line in written.splitlines() if believes(line)]


def said_by_admin(line: str) -> bool:
    """Whether a program that reads JSON would believe it."""
    try:
        told = json.loads(line)
    except ValueError:
        return False
    return isinstance(told, dict) and told.get("client") == "admin"


def naively(event: str, **fields: str) -> str:
    """The twin: a log that writes what it is told."""
    return f"{_TIME} info {event} " + " ".join(f"{key}={text}" for key, text in fields.items())


def lies(form: str) -> list[str]:
    """Values that hold a line of their own, or the rest of the one that they are in."""
    return [
        *(f"x{mark}{FORGED[form]}{mark}" for mark in BREAKS),
        '", "client": "admin", "x": "',
        '" client=admin x="',
    ]


@pytest.mark.parametrize("form", ["text", "json"])
def test_no_name_ends_a_line(form: str) -> None:
    control = "\n".join(naively("jail_died", client="x", environment=lie) for lie in lies(form))
    assert forged(control, form)
    assert "\x1b" in control
    written = list[str]()
    log = Log(written.append, form=FORMS[form])
    for lie in lies(form):
        log.say("jail_died", whose="k", client=lie, environment=lie, detail=lie)
    assert len(written) == len(lies(form))
    assert all(line.isascii() and line.isprintable() for line in written)
    assert not forged("\n".join(written), form)


def test_a_hostile_client_and_its_environment_forge_nothing(tmp_path: Path) -> None:
    """By the client's name in the list, what it asks for, and what its environment writes."""
    form = "text"
    assert forged(naively("jail_died", client=lies(form)[0]), form)
    listed, code = tmp_path / "clients", ENVIRONMENT.format(forged=list(FORGED.values())).encode()
    name = "mallory\x1b[2K\x1b[1G" + '" client=admin x="'
    listed.write_text(f"{key_text(MALLORY.public)} {name}\n")
    options = ("--authorized-clients", str(listed), "--log-format", form)
    with listening(tmp_path / "server", *options) as server, peer(server, MALLORY) as mallory:
        assert isinstance(
            mallory.ask(m.Hello(m.VERSION, b"\n" + FORGED[form].encode()[:40])), m.Welcome
        )
        snapshot = brought(mallory, code)
        died_in(mallory, server, lies(form)[0], snapshot)
        died_in(mallory, server, lies(form)[-1], snapshot)
        for lie in lies(form):
            mallory.refused(m.OpenJail("x", "", "", snapshot, lie, asdict(Confinement()), 1))
            mallory.refused(m.OpenJail("x", "", "", lie, "env.py", asdict(Confinement()), 1))
            weak = {**asdict(Confinement()), "profile": lie}
            mallory.refused(m.OpenJail("x", "", "", snapshot, "env.py", weak, 1))
    said = server.said()
    assert not forged(said, form)
    assert said.isascii()
    assert "\x1b" not in said


def died_in(client: Peer, server: Listening, name: str, snapshot: str) -> None:
    """A jail of this name was opened, ran the file, and died of it."""
    before = server.said().count("jail_died")
    opened = client.ask(m.OpenJail(name, "", "", snapshot, "env.py", asdict(Confinement()), 1))
    assert isinstance(opened, m.JailOpened), opened
    load = [bytes(frame) for frame in m.pack(m.Load(1, False, None, {}))]
    client.tell(m.Relay(opened.jail, "make_env", ((opened.runners[0], len(load)),)), *load)
    assert client.socket.poll(60_000)
    client.socket.recv_multipart()
    assert eventually(lambda: server.said().count("jail_died") > before)
