"""The client takes the reply to its own request out of whatever a server sends, and no other."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox import errors
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer

pytestmark = pytest.mark.short

_SOON_S = 0.02


@contextmanager
def connected() -> Iterator[tuple[WorkerConnection, zmq.Socket[bytes]]]:
    """A client, and the socket of a server that says what we like."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder, zmq.Context() as context:
        router = context.socket(zmq.ROUTER)
        router.bind(f"ipc://{folder}/server")
        never, end = os.pipe()
        client = WorkerConnection(f"ipc://{folder}/server", never)
        client.version = m.VERSION
        try:
            yield client, router
        finally:
            client.close()
            router.close(0)
            os.close(never)
            os.close(end)


def answer(number: int) -> list[Buffer]:
    return m.pack_header(m.Output(f"to {number}"), number)


# which earlier requests are answered late, and how often, before the next one is
late = st.lists(st.lists(st.integers(0, 7), max_size=4), min_size=1, max_size=8)


@given(late, st.data())
def test_late_replies_are_dropped_and_counted(plan: list[list[int]], data: st.DataObject) -> None:
    """Earlier requests' replies come late, twice or never: each request gets its own, or none."""
    with connected() as (client, router):
        dropped = 0
        for number, earlier in enumerate(plan):
            request = client.send(m.ReadOutput(0, str(number)))
            identity, frame = router.recv_multipart()
            assert m.unpack_header(frame)[0] == request
            stale = [one + 1 for one in earlier if one + 1 < request]
            for one in stale:
                router.send_multipart([identity, *answer(one)])
            answered = data.draw(st.booleans())
            if answered:
                router.send_multipart([identity, *answer(request)])
                reply, _ = client.receive(request, Deadline(60))
                assert reply == m.Output(f"to {request}")
                dropped += len(stale)
                assert client.stale_replies >= dropped
            else:
                with pytest.raises(errors.WorkerTimeoutError):
                    client.receive(request, Deadline(_SOON_S))
                dropped = client.stale_replies
