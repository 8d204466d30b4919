"""Which slot a batch is in, who may still write it, and what a hostile byte becomes."""

import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.transport.shared_memory.attachment import deposit
from envhub_sandbox.transport.shared_memory.client_slabs import (
    RING,
    JoinedColumns,
    ObservationSlab,
    Schema,
)
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.slabs import columns_of
from envhub_worker.supervisor import fd_store

COUNT = 2
BOX = spaces.Box(-1, 1, (3,), np.float32)
NESTED = spaces.Dict(seen=spaces.MultiBinary(4), both=spaces.Tuple((BOX, spaces.Discrete(9))))
MASK = spaces.Dict({"mask": spaces.Box(0, 1, (4,), np.bool_)})


@pytest.fixture
def slab_of() -> Iterator[Callable[..., ObservationSlab]]:
    made: list[ObservationSlab] = []

    def make(space: Any, slots: int = 1) -> ObservationSlab:
        layout = slabs.observation_layout(space, COUNT, slots)
        made.append(ObservationSlab(space, layout))
        return made[-1]

    yield make
    for one in made:
        one.close()


def write(slab: ObservationSlab, value: int) -> None:
    """As runners do: this number, into every leaf of the chosen slot."""
    base = slab.chosen * slab.layout.slot_bytes
    memory = np.memmap(f"/proc/self/fd/{slab.fd}", np.uint8, "r+", shape=slab.layout.total_bytes)
    for leaf in slab.layout.leaves:
        slabs.view(memory, leaf, base=base)[...] = value


@pytest.mark.parametrize("prepared", [False, True])
def test_one_slot_is_copied_out(slab_of: Callable[..., ObservationSlab], prepared: bool) -> None:
    slab = slab_of(NESTED)
    assert slab.choose() == 0
    if prepared:
        slab.prepare()
    write(slab, 1)
    first = slab.take()
    write(slab, 0)
    assert not slab.take()["seen"].any()
    assert not np.shares_memory(slab.results()[0], slab.results()[0])
    assert first["seen"].tolist() == [[1] * 4] * COUNT
    assert [leaf.shape for leaf in first["both"]] == [(COUNT, 3), (COUNT,)]
    assert [leaf.tolist() for leaf in first["both"]] == [[[1.0] * 3] * COUNT, [1] * COUNT]
    assert all(leaf.flags.owndata for leaf in (first["seen"], *first["both"]))


def test_a_slot_is_reused_when_no_array_is_held(slab_of: Callable[..., ObservationSlab]) -> None:
    """Views of views count; when all are held the batch is copied, and the lowest is hot."""
    slab = slab_of(BOX, RING + 1)
    held = []
    for number in range(1, RING + 1):
        assert slab.choose() == number
        write(slab, number)
        held.append(slab.take())
    assert slab.choose() == 0
    write(slab, 9)
    spare = slab.take()
    assert spare.flags.owndata
    assert [batch[0, 0] for batch in (*held, spare)] == [1, 2, 3, 4, 9]
    row = held[2][0][1:]
    held[2] = None
    assert slab.choose() == 0, "a view of it is held"
    del row
    assert slab.choose() == 3
    held[0] = None
    assert slab.choose() == 1
    slab.leave()
    assert slab.chosen == 0


@pytest.mark.parametrize("slots", [1, 2])
def test_no_byte_is_a_third_boolean(slab_of: Callable[..., ObservationSlab], slots: int) -> None:
    slab = slab_of(MASK, slots)
    slab.choose()
    layout = slab.layout
    memory = np.memmap(f"/proc/self/fd/{slab.fd}", np.uint8, "r+", shape=layout.total_bytes)
    memory[:] = 2
    mask = slab.take()["mask"]
    rewards, terminations, truncations = slab.results()
    for flags in (mask, terminations, truncations):
        assert flags.dtype == np.bool_
        assert set(flags.view(np.uint8).ravel().tolist()) == {1}
    assert rewards.shape == terminations.shape == truncations.shape == (COUNT,)
    memory[:] = 0
    assert terminations.all(), "they are copies"
    if slots == 1:
        assert mask.all()


# --- Descriptors on their way to the server: a connection that is lost in between is made again


def serving(path: Path, losses: int) -> threading.Thread:
    """A server that ends so many connections unheard, and answers the next."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(path))
    listener.listen(8)
    listener.settimeout(60)

    def run() -> None:
        with listener:
            try:
                for _ in range(losses):
                    listener.accept()[0].close()
                connection, _ = listener.accept()
            except TimeoutError:  # whoever brings gave up before, or never came
                return
            with connection:
                _, fds, _, _ = socket.recv_fds(connection, 4096, 5)
                socket.send_fds(connection, [b"k"], [fds[0]])
                for fd in fds:
                    os.close(fd)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("losses", [0, 2])
def test_it_connects_again(tmp_path: Path, losses: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # a socket's path has 108 bytes
    server = serving(Path("fds"), losses)
    ours, theirs = os.pipe()
    os.close(deposit("fds", bytes(16), 1, 2, [ours]))
    os.close(ours)
    os.close(theirs)
    server.join(60)
    assert not server.is_alive()


def test_who_knows_no_jail_is_asked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More often than one that fails: its zygote may be held up for a while."""
    monkeypatch.chdir(tmp_path)
    ours, theirs = os.pipe()
    fds = [os.dup(ours) for _ in range(fd_store.FDS)]
    known = [-1] * 10 + [ours]
    deposits = fd_store.FdStore("fds", lambda request: known.pop(0))

    def serve() -> None:
        while known:
            select.select([deposits], [], [], 60)
            deposits.accept()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    os.close(deposit("fds", bytes(16), 1, 2, fds))
    thread.join(60)
    assert not thread.is_alive()
    taken = deposits.take(1, 2)
    assert len(taken) == len(fds)
    for fd in (*fds, *taken, ours, theirs):
        os.close(fd)
    deposits.close()


def test_a_server_that_takes_nothing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    serving(Path("fds"), 50)
    with pytest.raises(ConnectionError):
        deposit("fds", bytes(16), 1, 2, [0])
    with pytest.raises(OSError, match="No such file"):
        deposit("nowhere", bytes(16), 1, 2, [0])


# --- Infos that came as columns from several shards


BOUNDS = [(0, 3), (3, 5)]


def infos(rows: int, first: float, **other: Any) -> dict[str, Any]:
    """Those of one shard: ``first`` and what follows it, and masks."""
    speeds = np.arange(first, first + rows)
    goal = np.full((rows, 2), first, np.float32)
    found = {"speed": speeds, "goal": goal, "steps": np.arange(rows), **other}
    masks = {f"_{key}": np.ones(rows, np.bool_) for key in found}
    return {
        name: one
        for key in found
        for name, one in ((key, found[key]), (f"_{key}", masks[f"_{key}"]))
    }


def schema(part: dict[str, Any]) -> Schema:
    """As a shard knows it, and with these values in its slab."""
    columns = columns_of(part)
    assert columns
    slab = bytearray(4096)
    made = [(column, column.view(slab, 0)) for column in columns]
    for column, view in made:
        view[...] = part[column.key]
    return made


def test_they_are_joined_as_parts_are() -> None:
    parts = [infos(3, 0.5), infos(2, 7.5)]
    joined = JoinedColumns([schema(part) for part in parts], BOUNDS)
    expected = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    found = joined.infos()
    assert list(found) == list(expected)
    for key, value in expected.items():
        assert (found[key].dtype, found[key].tolist()) == (value.dtype, value.tolist()), key
        assert not np.shares_memory(found[key], joined.infos()[key])


def test_bytes_of_a_mask_are_not_read_and_any_but_zero_are_true_in_a_value() -> None:
    parts = [infos(3, 0, done=np.ones(3, bool)), infos(2, 0, done=np.ones(2, bool))]
    schemas = [schema(part) for part in parts]
    for column, view in schemas[1]:
        if column.dtype == np.bool_:
            view[...] = (2, 0)
    joined = JoinedColumns(schemas, BOUNDS).infos()
    assert joined["done"].view(np.uint8).tolist() == [1, 1, 1, 1, 0]
    assert joined["_done"].view(np.uint8).tolist() == [1] * 5


@pytest.mark.parametrize(
    "second",
    [
        infos(2, 0, more=np.zeros(2)),
        infos(2, 0, steps=np.zeros(2)),
        infos(2, 0, goal=np.zeros((2, 3), np.float32)),
        infos(3, 0),
        {"x": np.zeros(2)},
    ],
    ids=["another key", "another dtype", "another shape", "too many rows", "other keys"],
)
def test_what_does_not_go_together_is_left_to_joining(second: dict[str, Any]) -> None:
    assert not JoinedColumns([schema(infos(3, 0)), schema(second)], BOUNDS).columns


def test_a_new_schema_of_one_shard_makes_another() -> None:
    schemas = [schema(infos(3, 0)), schema(infos(2, 0))]
    joined = JoinedColumns(schemas, BOUNDS)
    assert joined.is_of(list(schemas))
    assert not joined.is_of([schemas[0], schema(infos(2, 0))])
    assert not joined.is_of(schemas[:1])
    assert not JoinedColumns((), ()).is_of(schemas)
