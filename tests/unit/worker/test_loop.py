"""The server's loop looks before each wait, and sleeps for as long as that permits."""

import os
import select

import zmq

from envhub_worker.loop import Loop


def test_it_looks_before_each_wait() -> None:
    failures: list[Exception] = []
    loop = Loop(failures.append)
    looked: list[int] = []
    waits = [0, 0, None, 0]
    heard, rings = os.pipe()
    loop.watch(heard, lambda: os.read(heard, 1))

    def look() -> int | None:
        looked.append(1)
        wait_ms = waits[len(looked) - 1]
        if wait_ms is None:
            os.write(rings, b"x")  # else it would sleep now
        if len(looked) == len(waits):
            loop.stop()
        return wait_ms

    loop.look_by(look)
    loop.run()
    assert len(looked) == len(waits)
    assert not failures
    os.close(heard)
    os.close(rings)


def test_a_look_that_fails_ends_nothing() -> None:
    failures: list[Exception] = []
    loop = Loop(failures.append)

    def fail() -> int | None:
        loop.stop()
        raise RuntimeError("ours")

    loop.look_by(fail)
    loop.run()
    assert [str(one) for one in failures] == ["ours"]


def test_a_message_that_the_descriptor_no_longer_shows_is_read_before_the_first_sleep() -> None:
    """Any call of a socket's functions silences its descriptor, such as the answer to another."""
    failures: list[Exception] = []
    loop = Loop(failures.append)
    looked, heard = list[int](), list[bytes]()
    with (
        zmq.Context() as context,
        context.socket(zmq.PULL) as pull,
        context.socket(zmq.PUSH) as push,
    ):
        pull.bind("inproc://messages")
        push.connect("inproc://messages")
        push.send(b"first")
        assert pull.poll(60_000)
        assert not select.select([pull.fileno()], [], [], 0)[0]  # silent by now

        def read() -> None:
            heard.append(pull.recv(zmq.NOBLOCK))
            loop.stop()

        loop.watch_messages(pull, read)
        loop.look_by(lambda: looked.append(1))
        loop.run()
    assert (heard, looked, failures) == ([b"first"], [1], [])
