"""The server takes a runner's steps: asks, hears and copies, and never waits for the runner."""

import errno
import itertools
import mmap
import os
import select
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from envhub_worker.protocol.shared_memory import words
from envhub_worker.supervisor import served_slabs
from envhub_worker.supervisor.served_slabs import ServedSlabs, ServedSteps
from tests.support import inside

LEAVES, ACTION = 1, b"actions!"
OBSERVATION = bytes(range(128))
HALF = (words.DTYPES - words.SPIN + LEAVES) * 8


class Runner:
    """The jail's end: what was deposited, mapped as a runner maps it."""

    def __init__(self, slabs: ServedSlabs, observation_bytes: int) -> None:
        self.fds, slabs.deposit = slabs.deposit, []
        request, reply, observations, self.bell, self.servers_bell = self.fds
        size = os.fstat(request).st_size
        self.request = mmap.mmap(request, size, prot=mmap.PROT_READ)
        self.reply = mmap.mmap(reply, words.REPLY_BYTES)
        self.observations = mmap.mmap(observations, observation_bytes)
        self.asked, self.tells = words.words(self.request), words.words(self.reply)

    def answer(self, outcome: int = words.DONE, length: int = 0, infos: bytes = b"") -> None:
        self.reply[words.HEADER_BYTES : words.HEADER_BYTES + len(infos)] = infos
        self.tells[words.OUTCOME], self.tells[words.LENGTH] = outcome, length
        self.tells[words.SEQUENCE] = self.asked[words.SEQUENCE]
        if self.asked[words.PARKED]:
            self.ring()

    def ring(self) -> None:
        os.eventfd_write(self.servers_bell, 1)


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Iterator[ServedSteps]:
    monkeypatch.setattr(*inside.MAY_SPIN, True)
    made = ServedSteps()
    yield made
    made.close()


def make(observation_bytes: int = len(OBSERVATION)) -> ServedSlabs:
    return ServedSlabs(LEAVES, words.HEADER_BYTES + 64 + words.INFO_BYTES, observation_bytes)


class Served(NamedTuple):
    """A runner that takes steps of the server."""

    slabs: ServedSlabs
    steps: ServedSteps
    runner: Runner

    def ask(self, **own: int) -> list[Any]:
        """Ask a step; what is taken of the answer."""
        taken: list[Any] = []
        self.slabs.ask(frame(**own), "owner")
        self.steps.owe(self.slabs, lambda: taken.append(self.slabs.take()))
        return taken


def serve(steps: ServedSteps, observation: bytes = OBSERVATION) -> Served:
    slabs = make(len(observation))
    steps.add(slabs)
    runner = Runner(slabs, len(observation))
    runner.observations[:] = observation
    return Served(slabs, steps, runner)


@pytest.fixture
def served(steps: ServedSteps) -> Served:
    return serve(steps)


def frame(*, spin_ns: int = 0, known: int = 0) -> bytes:
    own = [0] * (HALF // 8)
    own[0], own[words.KNOWN - words.SPIN], own[-1] = spin_ns, known, 7
    return struct.pack(f"<{len(own)}Q", *own) + ACTION


def test_a_step_is_written_and_answered(served: Served) -> None:
    served.runner.tells[words.PARKED] = 1
    taken = served.ask()
    assert os.read(served.runner.bell, 8) == (1).to_bytes(8, "little")
    assert (served.runner.asked[words.SEQUENCE], served.runner.asked[words.DTYPES]) == (1, 7)
    start = words.HEADER_BYTES
    assert served.runner.request[start : start + len(ACTION)] == ACTION
    assert served.steps.look() is None
    assert taken == []
    served.runner.answer()
    served.steps.look()
    assert taken == [("owner", [struct.pack("<QQ", words.DONE, 0) + OBSERVATION])]
    assert served.slabs.owner is None
    served.steps.look()
    assert len(taken) == 1


def test_a_runner_awake_is_not_rung(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long this test is not given a core: the clock goes on only where it is read."""
    monkeypatch.setattr(served_slabs, "perf_counter_ns", itertools.count(0, 15_000).__next__)
    os.set_blocking(served.runner.bell, False)
    taken = served.ask(spin_ns=60_000_000_000)
    with pytest.raises(BlockingIOError):
        os.read(served.runner.bell, 8)
    assert served.steps.look() == 0, "a server that is awake sleeps"
    assert served.runner.asked[words.PARKED] == 0
    served.runner.answer()
    served.steps.look()
    assert len(taken) == 1
    assert not select.select([served.steps.fileno()], [], [], 0)[0]


def test_a_server_sleeps_when_an_answer_takes_long(served: Served) -> None:
    """It looks once more soon, for the ring may cross with that; then it is rung."""
    taken = served.ask(spin_ns=1)
    assert (served.steps.look(), served.runner.asked[words.PARKED]) == (2, 1)
    assert served.steps.look() is None
    served.runner.answer()
    assert select.select([served.steps.fileno()], [], [], 60)[0]
    served.steps.rung()
    served.steps.look()
    assert len(taken) == 1


def test_no_client_keeps_a_server_awake(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may ask for that, up to a bound: the server is others', too."""
    monkeypatch.setattr(served_slabs, "perf_counter_ns", itertools.count(0, 15_000).__next__)
    served.ask(spin_ns=2**64 - 1)
    assert any(served.steps.look() != 0 for _ in range(1000))


def test_both_sleep_where_none_may_spin(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """On one core, or on one that may see the announcement before what is announced."""
    monkeypatch.setattr(*inside.MAY_SPIN, False)
    served.ask(spin_ns=60_000_000_000)
    assert (served.runner.asked[words.SPIN], served.runner.asked[words.PARKED]) == (0, 1)
    assert served.steps.look() is None


@pytest.mark.parametrize("rings", [0, 1, 1000])
def test_rings_that_announce_nothing_are_not_heard_for_long(served: Served, rings: int) -> None:
    """A server that woke at each of them would be the jail's; its answer is found without."""
    taken = served.ask()
    heard = 0
    for _ in range(rings):
        served.runner.ring()
        if select.select([served.steps.fileno()], [], [], 0)[0]:
            heard += 1
            served.steps.rung()
            served.steps.look()
    assert heard == min(rings, 17)
    assert taken == []
    served.runner.answer()
    served.steps.look()
    assert len(taken) == 1


@pytest.mark.parametrize("length", [1, words.INFO_BYTES, words.INFO_BYTES + 1, 2**64 - 1])
def test_infos_are_as_long_as_they_may_be(served: Served, length: int) -> None:
    taken = served.ask()
    served.runner.answer(length=length, infos=b"\xff" * words.INFO_BYTES)
    served.steps.look()
    [(_, [first])] = taken
    infos = b"\xff" * min(length, words.INFO_BYTES)
    assert first == struct.pack("<QQ", words.DONE, length) + infos + OBSERVATION


@pytest.mark.parametrize("known", [0, 24, words.INFO_BYTES, 2**64 - 1])
def test_columns_are_as_long_as_the_client_knows(served: Served, known: int) -> None:
    taken = served.ask(known=known)
    served.runner.answer(words.COLUMNS, length=7)
    served.steps.look()
    [(_, [first])] = taken
    assert len(first) == 16 + min(known, words.INFO_BYTES) + len(OBSERVATION)


def test_a_large_batch_comes_in_pieces(steps: ServedSteps) -> None:
    observation = os.urandom((3 << 19) + 8)
    served = serve(steps, observation)
    taken = served.ask()
    served.runner.answer()
    steps.look()
    [(_, [head, *pieces])] = taken
    assert (len(head), [len(piece) for piece in pieces]) == (16, [1 << 19] * 3 + [8])
    assert b"".join(pieces) == observation
    steps.forget(served.slabs)
    assert bytes(pieces[0]) == observation[: 1 << 19], "they are sent after the end, too"


@pytest.mark.parametrize("size", [0, HALF - 1, HALF + 64 + words.INFO_BYTES + 1])
def test_what_is_no_half_of_a_request_slab_is_none(size: int) -> None:
    slabs = make()
    assert not slabs.fits(bytes(size))
    assert slabs.fits(bytes(HALF))
    assert slabs.fits(bytes(HALF + 64 + words.INFO_BYTES))


def test_nothing_is_owed_by_what_is_forgotten(served: Served) -> None:
    taken = served.ask()
    served.steps.forget(served.slabs)
    served.runner.answer()
    assert served.steps.look() is None
    assert taken == []
    assert not select.select([served.steps.fileno()], [], [], 0)[0]


def test_an_answer_may_be_the_end_of_others(steps: ServedSteps) -> None:
    """As where what one runner said ends its jail: the answers of the others are not taken."""
    made = [make(8) for _ in range(2)]
    ended: list[ServedSlabs] = []

    def end() -> None:
        for slabs in made:
            ended.append(slabs)
            steps.forget(slabs)

    for slabs in made:
        steps.add(slabs)
        slabs.ask(frame(), "owner")
        steps.owe(slabs, end)
    for slabs in made:
        Runner(slabs, 8).answer()
    assert steps.look() is None
    assert ended == made


def test_a_server_without_descriptors_loses_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that asks again and again would otherwise take the last ones for good."""
    dup, made = os.dup, list[int]()

    def scarce(fd: int) -> int:
        if len(made) == 3:
            raise OSError(errno.EMFILE, "Too many open files")
        made.append(dup(fd))
        return made[-1]

    monkeypatch.setattr(os, "dup", scarce)
    with pytest.raises(OSError, match="Too many"):
        make()
    assert len(made) == 3
    for fd in made:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(fd)
