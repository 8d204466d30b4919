"""Which connections a server knows to be there, and how it stops to look."""

import multiprocessing
import socket
from collections.abc import Iterator

import pytest
import zmq

from envhub_worker.extras.access.audit.log import Log
from envhub_worker.extras.access.curve_port import CurvePort
from envhub_worker.loop import Loop
from envhub_worker.server.sessions import Sessions
from tests.remote.strangers import greeting, knock, say
from tests.support.processes import eventually


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    with zmq.Context() as made:
        yield made


def open_to_all(router: zmq.Socket[bytes]) -> CurvePort:
    loop, log = Loop(lambda error: None), Log(lambda line: None)
    return CurvePort(router, loop, None, lambda key, address: True, log, 10)


@pytest.mark.parametrize("goes", [False, True])
def test_who_has_gone_before_its_greeting_is_read_holds_no_session(
    goes: bool, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    """A server that was busy meanwhile would keep that place for ever. The control stays."""
    router, client = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    with router, client:
        port = open_to_all(router)
        router.bind("tcp://127.0.0.1:*")
        client.connect(router.get_string(zmq.LAST_ENDPOINT))
        client.send_multipart([b"", b"greeting"])
        assert router.poll(60_000)
        if goes:
            client.close()
            assert eventually(lambda: not port.connections.open_wires())
        came = port.receive(router)
        sessions = Sessions()
        session = sessions.connect(
            came.identity, came.key, b"one", port.connections.wire(came.header)
        )
        sessions.disconnect(port.connections.open_wires())
        assert bool(session.connections) is not goes
        port.close()


def test_a_flood_that_nobody_has_read_does_not_keep_a_port_open() -> None:
    """A server that ends reads nothing meanwhile, and libzmq's thread waits with what it holds."""
    process = multiprocessing.get_context("spawn").Process(target=_flood_and_close)
    process.start()
    process.join(240)
    process.kill()
    process.join()
    assert process.exitcode == 0


def _flood_and_close() -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        port = open_to_all(router)
        number = router.bind_to_random_port("tcp://127.0.0.1")
        for _ in range(2_000):
            with knock(number) as stranger:
                say(stranger, greeting(b"CURVE"))
                if not _is_ended(stranger):  # the control: it waits now
                    break
        port.close()


def _is_ended(stranger: socket.socket) -> bool:
    stranger.settimeout(2)
    try:
        while stranger.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True
