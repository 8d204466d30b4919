"""Clients with a key who keep no other rule: other clients, and the server's machine, are safe."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.transport.connection import remote_session_id
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import Listening, listening
from tests.remote.peers import Peer, brought, peer
from tests.support import inside
from tests.support.processes import eventually
from tests.support.started import started

ALICE, MALLORY = keys.generate(), keys.generate()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """A server that Alice and Mallory use."""
    folder = tmp_path_factory.mktemp("shared")
    (folder / "clients").write_text(
        f"{key_text(ALICE.public)} alice\n{key_text(MALLORY.public)} mallory\n"
    )
    options = ("--authorized-clients", str(folder / "clients"), "--max-inflight", "1")
    with listening(folder / "server", *options) as server:
        yield server


@pytest.fixture
def alice(shared: Listening, repository: Path) -> Iterator[Any]:
    """Her environment, which goes on whatever Mallory does."""
    with started(repository, sandbox=shared.sandbox(client_key=key_text(ALICE.secret))) as env:
        yield env
        assert env.step(np.array([0]))[0].tolist() == [[1.0]]


@pytest.fixture
def mallory(shared: Listening) -> Iterator[Peer]:
    """She has said Hello, under Alice's session: what she claims to be is worth nothing."""
    with peer(shared, MALLORY) as found:
        assert isinstance(found.ask(m.Hello(m.VERSION, remote_session_id())), m.Welcome)
        yield found


def test_another_clients_jail_is_not_there(alice: Any, mallory: Peer) -> None:
    """By number and session, which are Alice's own; to Alice it is there, as the control."""
    jail = inside.jail(alice)
    for request in (
        m.StartRunners(jail.number, 1),
        m.CheckJail(jail.number, ""),
        m.KeepJail(jail.number, True, 1),
        m.ShareSlabs(jail.number, ()),
        m.FollowOutput(jail.number, 0),
        m.Relay(jail.number, "step", ((jail.runners[0], 1),)),
    ):
        payload = (b"x",) if isinstance(request, m.Relay) else ()
        assert "there is no jail" in mallory.refused(request, *payload).message
    assert isinstance(mallory.ask(m.CloseJail(jail.number)), m.Done)
    jail.check("", Deadline(60))
    status = mallory.ask(m.GetStatus())
    assert status.jails == ()


TOO_MUCH: list[tuple[dict[str, Any], str]] = [
    ({"snapshot": "/etc"}, "no such snapshot"),
    ({"snapshot": "sha256:../../../etc"}, "no such snapshot"),
    ({"python": "/bin/sh"}, "interpreter"),
    ({"entry": "../env.py"}, "entry file"),
    ({"entry": "/etc/passwd"}, "entry file"),
    ({"confinement": {}}, "malformed confinement"),
    ({"confinement": asdict(Confinement(readable=("/",)))}, "readable"),
    ({"confinement": asdict(Confinement(network="host"))}, "--allow-network"),
    ({"confinement": asdict(Confinement(profile="nothing"))}, "malformed confinement"),
    ({"runners": 10_000}, "runners"),
    ({"hub_copies": (("models--../x", "a" * 40, ("main",), ""),)}, "are malformed"),
]


def test_a_jail_cannot_be_asked_more_than_a_policy_may(mallory: Peer) -> None:
    """The server checks by itself what a client of ours would not even send."""
    order = {
        "name": "x",
        "python": "",
        "packages": "",
        "snapshot": "sha256:" + "0" * 64,
        "entry": "env.py",
        "confinement": asdict(Confinement()),
        "runners": 1,
    }
    for changes, complaint in TOO_MUCH:
        assert complaint in mallory.refused(m.OpenJail(**{**order, **changes})).message, changes


def test_another_repository_is_a_snapshot_of_the_clients(alice: Any, mallory: Peer) -> None:
    """Not a path of the server, and not what is not hers; her own, as the control."""
    mine = brought(mallory, b"x = 1")

    def order(tree: str) -> m.OpenJail:
        copies = (("datasets--org--data", "a" * 40, ("main",), tree),)
        place = ("x", "", "", mine, "env.py", asdict(Confinement()), 1)
        return m.OpenJail(*place, hub_copies=copies)

    for tree in ("/etc", "sha256:../../etc", "sha256:" + "0" * 64):
        assert "no such snapshot" in mallory.refused(order(tree)).message
    assert isinstance(mallory.ask(order(mine)), m.JailOpened)


def test_what_breaks_a_rule_is_refused(alice: Any, mallory: Peer) -> None:
    """More bytes or runners than the quotas; of one request, too: nothing of it stays. Replies,
    descriptors, and messages for runners are no requests; she is shown her own sessions only."""
    reply = mallory.refused(m.Relay(1, "step", ((1, 1),)), bytes(2 << 20))
    assert "not answered yet" in reply.message
    for _ in range(2):  # of what is answered neither: it takes more than half each time
        reply = mallory.refused(m.Relay(1, "s", ((1, 1),)), bytes(600 << 10))
        assert "there is no jail" in reply.message
    assert "--max-runners" in mallory.refused(m.StartRunners(1, 10_000)).message
    replies = m.Done(), m.Welcome(2, "", 1), m.Sessions(({"client": "nobody"},), {})
    for message in (*replies, m.Deposit(b"", 1, 1), m.Close(1)):
        assert "is not a request" in mallory.refused(message).message
    assert "too long" in mallory.refused(m.Hello(m.VERSION, b"n" * 65)).message
    shown = mallory.ask(m.GetSessions())
    assert {one["client"] for one in shown.sessions if isinstance(one, dict)} == {"mallory"}
    assert set(shown.server["clients"]) == {"mallory"}
    assert shown.server.keys().isdisjoint({"pid", "disk", "connections"}), "the operator's"
    assert isinstance(mallory.ask(m.KeepAlive(({},))), m.Done)


def test_noise_with_a_key_is_dropped(shared: Listening, alice: Any) -> None:
    """The server goes on; who has not said Hello is told to."""
    with peer(shared, MALLORY) as found:
        for frames in ([b""], [b"\x80" + bytes(99)], [b"", b"", b""], [b"\x00" * 4] * 100):
            found.socket.send_multipart(frames)
        assert found.refused(m.GetStatus()).error == "HelloError"


def test_a_claimed_routing_id_is_nobodys_name(shared: Listening) -> None:
    """The same id under two keys, one after the other: the second is not taken for the first."""
    with peer(shared, ALICE, routing_id=b"the same") as first:
        assert isinstance(first.ask(m.Hello(m.VERSION, b"one")), m.Welcome)
        assert isinstance(first.ask(m.GetStatus()), m.Status)

    def is_refused() -> bool:
        with peer(shared, MALLORY, routing_id=b"the same") as second:
            second.tell(m.GetStatus())
            if not second.socket.poll(5_000):
                return False  # to libzmq the first one was still there, who alone may have the id
            reply = m.unpack_header(second.socket.recv_multipart()[0])[1]
        assert isinstance(reply, m.Refusal), reply
        assert reply.error == "HelloError"
        return True

    assert eventually(is_refused)


def test_a_key_has_so_many_sessions_and_no_more(tmp_path: Path) -> None:
    """Each Hello under a new name is one; the old ones are found again."""
    with listening(tmp_path / "server", "--max-sessions", "2") as server:
        pair = keys.load(server.state / "client.key")
        with peer(server, pair) as one, peer(server, pair) as two, peer(server, pair) as three:
            for found, name in ((one, b"one"), (two, b"two"), (three, b"one")):
                assert isinstance(found.ask(m.Hello(m.VERSION, name)), m.Welcome)
            assert "2 sessions" in three.refused(m.Hello(m.VERSION, b"three")).message
            assert len(server.sessions()) == 2
