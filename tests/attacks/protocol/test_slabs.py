"""A jail holds the descriptors of the fast lane's slabs: what can it do to the client with them?
The hostile side is another process with exactly those descriptors; the verdict is the client's
own memory, and whether the client is still alive."""

import mmap
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.extras.remote.served_lane import ReceivedBatch, ServedShard
from envhub_sandbox.transport.shared_memory.client_slabs import LaneShard, ObservationSlab, SlotRing
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.shared_memory.packets import packet_bytes, write_packet

pytestmark = pytest.mark.short
WAIT_S = 60
SLOT = 1 << 17
Asked = tuple[SlotRing, LaneShard]


@pytest.fixture
def observations() -> Iterator[ObservationSlab]:
    space = spaces.Box(0, 1, (8,), np.bool_)
    layout = slabs.observation_layout(space, 2, 1)
    made = ObservationSlab(space, layout)
    yield made
    made.close()


@pytest.fixture
def shard(observations: ObservationSlab) -> Iterator[LaneShard]:
    layout = slabs.layout_of(spaces.Box(-1, 1, (2,)), 2)
    made = LaneShard(layout, observations.fd)
    yield made
    made.close()


@pytest.fixture
def asked() -> Iterator[Asked]:
    """A step of an own vector that has no answer yet, and the ring that gets it."""
    layout = slabs.message_layout(spaces.Box(-1, 1, (2,)), 2)
    ring = SlotRing(1, SLOT, SLOT)
    shard = LaneShard(layout, ring.fd)
    shard.write_message(m.pack(m.Step(1, np.zeros((2, 2)))), (0, 0, 0), ring)
    yield ring, shard
    shard.close()
    ring.close()


def attack(shard: LaneShard, code: str) -> str:
    """Run code in a process that holds ``request``, ``reply`` and ``observations``."""
    request, reply, observations = shard.fds[:3]
    layout = shard.layout
    head = f"""
import ctypes, errno, mmap, os, struct
request, reply, observations = {request}, {reply}, {observations}
request_bytes, reply_bytes = {layout.request_bytes}, {slabs.REPLY_BYTES}
def outcome(call, *arguments, **keywords):
    try:
        call(*arguments, **keywords)
        print("done")
    except OSError as error:
        print(errno.errorcode[error.errno])
"""
    done = subprocess.run(
        [sys.executable, "-c", head + code],
        pass_fds=(request, reply, observations),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=True,
    )
    return done.stdout.strip()


def test_unsealed_memory_kills_its_reader() -> None:
    """Control: without seals, whoever shares the memory can end the reader with SIGBUS."""
    code = """
import mmap, os
fd = os.memfd_create("open", os.MFD_ALLOW_SEALING)
os.ftruncate(fd, 1 << 16)
mapped = mmap.mmap(fd, 1 << 16)
os.ftruncate(fd, 0)
mapped[0]
"""
    done = subprocess.run([sys.executable, "-c", code], timeout=WAIT_S, check=False)
    assert done.returncode == -signal.SIGBUS


@pytest.mark.parametrize("name", ["request", "reply", "observations"])
@pytest.mark.parametrize("size", ["0", "1 << 30"])
def test_a_slab_cannot_be_cut_or_grown(shard: LaneShard, name: str, size: str) -> None:
    before = [os.fstat(fd).st_size for fd in shard.fds[:3]]
    assert attack(shard, f"outcome(os.ftruncate, {name}, {size})") == "EPERM"
    assert [os.fstat(fd).st_size for fd in shard.fds[:3]] == before


def test_the_seals_cannot_be_taken_off(shard: LaneShard) -> None:
    for name in ("request", "reply", "observations"):
        assert attack(shard, f"import fcntl; outcome(fcntl.fcntl, {name}, 1033, 8)") == "EPERM"


def test_actions_cannot_be_rewritten(shard: LaneShard) -> None:
    assert attack(shard, "outcome(os.pwrite, request, b'x', 0)") == "EPERM"
    assert attack(shard, "outcome(mmap.mmap, request, request_bytes)") == "EPERM"


def test_the_reply_slab_is_theirs_to_write(shard: LaneShard) -> None:
    """Control of the test above: the same calls succeed on the reply slab."""
    assert attack(shard, "outcome(os.pwrite, reply, b'x', 4096)") == "done"
    assert attack(shard, "outcome(mmap.mmap, reply, reply_bytes)") == "done"


def test_a_punched_hole_is_zeros(shard: LaneShard, observations: ObservationSlab) -> None:
    os.pwrite(shard.fds[1], b"\xff" * mmap.PAGESIZE, 0)
    os.pwrite(observations.fd, b"\xff" * observations.layout.total_bytes, 0)
    code = """
libc = ctypes.CDLL(None, use_errno=True)
libc.fallocate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_long, ctypes.c_long]
for slab in (reply, observations):
    print(libc.fallocate(slab, 3, 0, 4096), errno.errorcode.get(ctypes.get_errno()))
"""
    assert attack(shard, code) == "0 None\n0 None"
    rewards, terminations, truncations = observations.results()
    assert rewards.tolist() == [0.0, 0.0]
    assert not terminations.any()
    assert not truncations.any()
    with pytest.raises(RemoteProtocolError, match="impossible reply"):
        shard.outcome()


BOTH = [(99, 0), (slabs.DONE, slabs.INFO_BYTES + 1), (slabs.DONE, 2**64 - 1)]


@pytest.mark.parametrize(
    ("asked", "outcome", "length"),
    [
        *(("outcome", *words) for words in (*BOTH, (0, 0))),
        *(("answer", *words) for words in (*BOTH, (slabs.COLUMNS, 0), (slabs.DONE, 0))),
    ],
)
def test_impossible_headers_refused(
    shard: LaneShard, asked: str, outcome: int, length: int
) -> None:
    """Words out of range never become a slice or an allocation, of steps or messages."""
    if asked == "outcome":
        shard.write([np.zeros((2, 2), np.float32)], (0, 0, 0))
    else:
        shard.write_message(m.pack(m.Render(1)), (0, 0, 0))
    words = f"struct.pack('QQ', {outcome}, {length})"
    attack(shard, f"os.pwrite(reply, {words}, {slabs.OUTCOME * 8})")
    with pytest.raises(RemoteProtocolError):
        getattr(shard, asked)()


def _packets(*frames: bytes) -> str:
    return repr(b"".join(_packet(frame) for frame in frames))


def _packet(*frames: bytes) -> bytes:
    packet = bytearray(packet_bytes(frames))
    assert write_packet(packet, 0, len(packet), frames) == len(packet)
    return bytes(packet)


def answers(shard: LaneShard, answer: str) -> None:
    """Tell the jail something; it answers with these bytes, a Python literal."""
    shard.write_message(m.pack(m.Render(1)), (0, 0, 0))
    attack(
        shard,
        f"answer = {answer}\n"
        f"os.pwrite(reply, answer, {slabs.ANSWER})\n"
        f"os.pwrite(reply, struct.pack('QQ', {slabs.DONE}, len(answer)), {slabs.OUTCOME * 8})",
    )


@pytest.mark.parametrize(
    "answer",
    [
        repr(bytes(64)),
        repr(b"\xff" * 64),
        _packets(b"\x80\x04."),
        _packets(*[bytes(m.pack(m.Value(1))[0])] * 2),
        repr(b"\x01\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0" + b"\xff" * 7 + b"\x0f"),
    ],
    ids=["zeros", "ones", "pickle", "two", "endless"],
)
def test_garbage_for_an_answer_is_refused(shard: LaneShard, answer: str) -> None:
    """It is cut into frames and decoded by the same suspicious code as a message's reply."""
    answers(shard, answer)
    with pytest.raises(RemoteProtocolError):
        shard.answer()


def test_an_honest_answer_is_read(shard: LaneShard) -> None:
    """The control of the two above."""
    answer = _packets(bytes(m.pack(m.Value((1, "two")))[0]))
    answers(shard, answer)
    assert shard.answer() == m.Value((1, "two"))


@pytest.mark.parametrize("bytes_", ["b'\\x80\\x04.'", "os.urandom(64)", "b'\\xff' * 64"])
def test_garbage_for_infos_is_refused(shard: LaneShard, bytes_: str) -> None:
    """What lies in the info area is decoded by the same suspicious code as a message."""
    shard.write([np.zeros((2, 2), np.float32)], (0, 0, 0))
    attack(
        shard,
        f"os.pwrite(reply, {bytes_}, {slabs.INFOS})\n"
        f"os.pwrite(reply, struct.pack('QQ', {slabs.DONE}, 64), {slabs.OUTCOME * 8})",
    )
    with pytest.raises(RemoteProtocolError):
        shard.outcome()


def test_columns_without_a_schema_are_refused(shard: LaneShard) -> None:
    shard.write([np.zeros((2, 2), np.float32)], (0, 0, 0))
    attack(shard, f"os.pwrite(reply, struct.pack('QQ', {slabs.COLUMNS}, 0), {slabs.OUTCOME * 8})")
    kind, message = shard.outcome()
    assert (kind, message) == (slabs.COLUMNS, None)
    with pytest.raises(RemoteProtocolError, match="before their schema"):
        shard.columns()


def test_values_of_columns_are_the_workers_and_masks_are_ours(shard: LaneShard) -> None:
    """The values are the control: they lie before the mask in the same bytes."""
    shard.write([np.zeros((2, 2), np.float32)], (0, 0, 0))
    infos = bytes(m.pack(m.Value({"a": np.zeros(2), "_a": np.ones(2, bool)}))[0])
    attack(
        shard,
        f"os.pwrite(reply, {infos!r}, {slabs.INFOS})\n"
        f"os.pwrite(reply, struct.pack('QQ', {slabs.DONE}, {len(infos)}), {slabs.OUTCOME * 8})",
    )
    shard.outcome()
    attack(shard, f"os.pwrite(reply, struct.pack('dd48xBB', 7, 8, 2, 0), {slabs.INFOS})")
    columns = shard.columns()
    assert columns["a"].tolist() == [7, 8]
    assert columns["_a"].tobytes() == b"\1\1"


def test_other_bytes_become_booleans(shard: LaneShard, observations: ObservationSlab) -> None:
    os.pwrite(observations.fd, b"\x02" * 4, observations.layout.results + 16)
    os.pwrite(observations.fd, b"\x02" * 16, 0)
    _, terminations, truncations = observations.results()
    observation = observations.take()
    for array in (terminations, truncations, observation):
        assert array.dtype == np.bool_
        assert set(array.tobytes()) == {1}


def test_the_callers_results_are_its_own(shard: LaneShard, observations: ObservationSlab) -> None:
    """Results are copies: a later write of the jail changes nothing that was handed out."""
    rewards, terminations, _ = observations.results()
    observation = observations.take()
    attack(
        shard,
        "size = os.fstat(observations).st_size\n"
        "m = mmap.mmap(observations, size); m[:] = b'\\x01' * size",
    )
    assert rewards.tolist() == [0.0, 0.0]
    assert not terminations.any()
    assert not observation.any()
    assert observations.take().all()


@pytest.mark.parametrize(
    ("size", "spoiled", "refusal"),
    [
        (SLOT + 1, b"", "impossible answer"),
        (2**64 - 1, b"", "impossible answer"),
        (None, b"\x02", "neither 0 nor 1"),
        (None, b"\x01", ""),
    ],
    ids=["long", "endless", "boolean", "control"],
)
def test_the_answer_to_a_step_is_copied_before_it_is_looked_at(
    asked: Asked, size: int | None, spoiled: bytes, refusal: str
) -> None:
    _, shard = asked
    packet = _packet(*map(bytes, m.pack(m.Value(np.ones(20_000, bool)))))
    assert len(packet) < SLOT
    length = len(packet) if size is None else size
    attack(
        shard,
        f"os.pwrite(observations, {packet!r}, 0)\n"
        f"os.pwrite(observations, {spoiled!r}, {len(packet) - 100})\n"
        f"os.pwrite(reply, struct.pack('QQ', {slabs.DONE}, {length}), {slabs.OUTCOME * 8})",
    )
    if refusal:
        with pytest.raises(RemoteProtocolError, match=refusal):
            shard.answer()
    else:
        answer = shard.answer()
        attack(shard, f"os.pwrite(observations, bytes({SLOT}), 0)")
        assert answer.value.all()


class Mirror(tuple):
    """Says that it has its members in the opposite order."""

    def __iter__(self) -> Iterator[int]:
        return reversed(self[:])


@pytest.mark.parametrize(
    ("scalars", "refusal"),
    [
        (msgpack.packb([0.5, 3, "run"]), ""),
        (msgpack.packb([0.5, 3]), "other scalars"),
        (msgpack.packb([0.5, True, "run"]), "other scalars"),
        (msgpack.packb([0.5, 3, ["run"]]), "other scalars"),
        (b"\x91" * 5000, "."),
        ((b"\xdc\x13\x00" * 1000).ljust(5000, b"\x01"), "exceeds max_array_len"),
        (b"\x80\x04.", "."),
        (b"", "."),
    ],
    ids=["control", "few", "bool", "list", "deep", "claims", "pickle", "none"],
)
def test_columns_of_a_step_are_numbers_and_texts_of_its_form(
    asked: Asked, scalars: bytes, refusal: str
) -> None:
    """Whatever lies in them; booleans are made such, and all of it is copied."""
    ring, shard = asked
    columns = struct.pack("QQ", slabs.COLUMNS, len(scalars))
    flags = np.zeros(2, np.bool_)
    infos = {"log": {"loss": 0.25, "steps": 2}, "name": "walk"}
    step = m.StepDone(np.zeros(2), np.zeros(2), flags, flags, infos)
    packet = _packet(*map(bytes, m.pack(step)))
    os.pwrite(ring.fd, packet, 0)
    digest = StepColumns(m.values_of(step), SLOT).digest
    for offer in (digest + 1, digest):
        attack(shard, f"os.pwrite(reply, {columns!r}, {slabs.OUTCOME * 8})")
        with pytest.raises(RemoteProtocolError, match="impossible answer"):
            shard.answer()  # they are of no form yet; nor of that which the runner alone derives
        offered = struct.pack("QQQ", slabs.DONE, len(packet), offer)
        attack(shard, f"os.pwrite(reply, {offered!r}, {slabs.OUTCOME * 8})")
        assert isinstance(shard.answer(), m.StepDone)
    attack(
        shard,
        f"os.pwrite(observations, b'\x02' * {SLOT}, 0)\n"
        f"os.pwrite(reply, {scalars!r}, {slabs.INFOS})\n"
        f"os.pwrite(reply, {columns!r}, {slabs.OUTCOME * 8})",
    )
    if refusal:
        with pytest.raises(RemoteProtocolError, match=refusal):
            shard.answer()
    else:
        answer = shard.answer()
        attack(shard, f"os.pwrite(observations, bytes({SLOT}), 0)")
        # more costs more than it saves; what says that it has other members crosses as those
        for value in ([None] * 1024, Mirror((1, 2))):
            with pytest.raises(IrregularError):
                StepColumns([value], SLOT)
        endless = struct.pack("QQ", slabs.COLUMNS, slabs.INFO_BYTES + 1)
        attack(shard, f"os.pwrite(reply, {endless!r}, {slabs.OUTCOME * 8})")
        with pytest.raises(RemoteProtocolError, match="impossible answer"):
            shard.answer()
        assert isinstance(answer, m.StepDone)
        assert answer.info == {"log": {"loss": 0.5, "steps": 3}, "name": "run"}
        assert answer.terminations.tobytes() == answer.truncations.tobytes() == b"\x01\x01"
        assert answer.observation.tobytes() == b"\x02" * 16


@pytest.mark.parametrize("compared", [True, False], ids=["control", "interrupted"])
def test_a_form_is_checked_before_it_is_trusted(asked: Asked, compared: bool) -> None:
    """Also if a Ctrl-C came before the comparison, and the next answer goes over the server."""
    ring, shard = asked
    flags = np.zeros(2, np.bool_)
    step = m.StepDone(np.zeros(2), np.zeros(2), flags, flags, {})
    packet = _packet(*map(bytes, m.pack(step)))
    digest = StepColumns(m.values_of(step), SLOT).digest
    os.pwrite(ring.fd, packet, 0)
    for words in ((slabs.DONE, len(packet), digest), (slabs.FETCH, 0, 0), (slabs.COLUMNS, 0, 0)):
        told = struct.pack("QQQ", *words)
        attack(shard, f"os.pwrite(reply, {told!r}, {slabs.OUTCOME * 8})")
        trusted = shard.checked_step()
        if words[0] != slabs.COLUMNS:
            shard.answer()
            if compared or words[0] == slabs.FETCH:
                shard.note_checked(False)
    assert (trusted is not None) is compared


@pytest.mark.parametrize(
    ("marks", "form", "length", "refusal"),
    [
        ([1, 0], 1, 0, ""),
        ([1, 1], 1, 0, ""),
        ([2, 0], 1, 0, "neither 0 nor 1"),
        ([1, -1], 1, 0, "neither 0 nor 1"),
        ([], 1, 0, "fewer sizes"),
        ([1, 0, 0], 1, 0, "other sizes"),
        ([1, 0], 0, 0, "impossible answer"),
        ([1, 0], 2**64 - 1, 0, "impossible answer"),
        ([1, 0], 1, slabs.INFO_BYTES + 1, "impossible reply"),
    ],
)
def test_infos_of_a_form_have_rows_where_their_marks_are(
    shard: LaneShard, marks: list[int], form: int, length: int, refusal: str
) -> None:
    """Of two sub-environments; the cases without a refusal are the controls. The answer to a
    message offers no such form, nor has it one.
    """
    ended = np.array([True, False])
    finals = np.array([None, None])
    finals[0] = np.zeros(2)
    infos = {"final_obs": finals, "_final_obs": ended, "final_info": {"r": np.zeros(2)}}
    offered = bytes(m.pack(m.Value(infos))[0])
    digest = StepColumns([infos], slabs.INFO_BYTES).digest
    numbers = [*marks, slabs.DTYPE_CODES[np.dtype(np.float64)]]
    scalars = msgpack.packb([np.array(numbers, np.int64).tobytes(), ""])
    told = struct.pack("QQQQ", slabs.FORMED, length or len(scalars), 0, form)
    for wrong in ("message", "digest", ""):
        if wrong == "message":
            shard.write_message(m.pack(m.Render(1)), (0, 0, 0))
        else:
            shard.write([np.zeros((2, 2), np.float32)], (0, 0, 0))
        told_digest = digest + (wrong == "digest")
        words = struct.pack("QQQQ", slabs.DONE, len(offered), told_digest, 1)
        attack(
            shard,
            f"os.pwrite(reply, {offered!r}, {slabs.INFOS})\n"
            f"os.pwrite(reply, {words!r}, {slabs.OUTCOME * 8})",
        )
        assert shard.outcome()[0] == slabs.DONE
        attack(
            shard,
            f"os.pwrite(reply, {scalars!r}, {slabs.INFOS})\n"
            f"os.pwrite(reply, b'\x02' * {slabs.INFO_BYTES}, {slabs.ANSWER})\n"
            f"os.pwrite(reply, {told!r}, {slabs.OUTCOME * 8})",
        )
        if wrong or refusal:
            with pytest.raises(RemoteProtocolError, match="impossible" if wrong else refusal):
                shard.outcome()
            continue
        _, message = shard.outcome()
        attack(shard, f"os.pwrite(reply, bytes({slabs.INFO_BYTES}), {slabs.ANSWER})")
        assert isinstance(message, m.Value)
        rows, mask, _ = message.value.values()
        assert [row is not None for row in rows] == [bool(mark) for mark in marks]
        assert rows[0].tobytes() == b"\x02" * 16
        assert mask.tobytes() == b"\x01\x01"


FLAGS = spaces.Sequence(spaces.MultiBinary(2))
WORDS = spaces.OneOf([spaces.Sequence(spaces.Text(9)), spaces.Graph(spaces.Box(-1, 1, (2,)), None)])
PAIRS = spaces.Sequence(spaces.Tuple([spaces.MultiBinary(1)] * 2))
MANY = slabs.INFO_BYTES // 4
"""So many pairs in each of two members are as many items as there may be, though more would fit."""
_INT8, _BOOL = [slabs.DTYPE_CODES[np.dtype(kind)] for kind in (np.int8, np.bool_)]


@pytest.mark.parametrize(
    ("space", "numbers", "text", "refusal"),
    [
        (FLAGS, [2, 1, _INT8], "", ""),
        (FLAGS, [2, 1, _BOOL], "", ""),
        (FLAGS, [2, 1, 99], "", "unknown dtype"),
        (FLAGS, [2, 1, -1], "", "unknown dtype"),
        (FLAGS, [-1, 4, _INT8], "", "negative size"),
        (FLAGS, [2, slabs.INFO_BYTES, _INT8], "", "more items"),
        (FLAGS, [2, 2**62, _INT8], "", "more items"),
        (FLAGS, [2, slabs.INFO_BYTES - 2, _INT8], "", "more items"),
        (FLAGS, [2], "", "fewer sizes"),
        (FLAGS, [2, 1, _INT8, 0], "", "other sizes"),
        (FLAGS, [2, 1, _INT8], "x", "other sizes"),
        (WORDS, [-1, 0, 0, 1, 0, 4, 0, 0, 0], "word", ""),
        (WORDS, [-1, 0, 2, 1, 0, 4, 0, 0, 0], "word", "does not have"),
        (WORDS, [_BOOL, 0, 0, 1, 0, 4, 0, 0, 0], "word", "unknown dtype"),
        (WORDS, [-1, 0, 0, 1, 0, 5, 0, 0, 0], "word", "other sizes"),
        (WORDS, [-1, 0, 0, 1, 0, -4, 0, 0, 0], "word", "negative size"),
        (WORDS, [-1, 0, 0, 1, 2**62, 4], "word", "fewer sizes"),
        (WORDS, [-1, 1, 1, _INT8, -2, 0], "", "negative size"),
        (WORDS, [-1, 1, 1, _INT8, 2**62, 2**62], "", "more items"),
        (PAIRS, [MANY, MANY, _INT8, _INT8], "", ""),
        (PAIRS, [MANY, MANY + 1, _INT8, _INT8], "", "more items"),
    ],
)
def test_sizes_of_members_that_vary_are_read_within_what_there_is(
    asked: Asked, space: Any, numbers: list[int], text: str, refusal: str
) -> None:
    """Of two members; the cases without a refusal are the controls."""
    ring, shard = asked
    sample: Any = ((0, ("a",)), (0, ())) if space is WORDS else ((), ())
    flags = np.zeros(2, np.bool_)
    step = m.StepDone(sample, np.zeros(2), flags, flags, {})
    columns, packet = (
        StepColumns(m.values_of(step), SLOT, space),
        _packet(*map(bytes, m.pack(step))),
    )
    os.pwrite(ring.fd, packet, 0)
    offered = struct.pack("QQQ", slabs.DONE, len(packet), columns.digest)
    attack(shard, f"os.pwrite(reply, {offered!r}, {slabs.OUTCOME * 8})")
    shard.answer(space=space)
    scalars = msgpack.packb([np.array(numbers, np.int64).tobytes(), text])
    told = struct.pack("QQ", slabs.COLUMNS, len(scalars))
    attack(
        shard,
        f"os.pwrite(observations, b'\x02' * {SLOT}, 0)\n"
        f"os.pwrite(reply, {scalars!r}, {slabs.INFOS})\n"
        f"os.pwrite(reply, {told!r}, {slabs.OUTCOME * 8})",
    )
    if refusal:
        with pytest.raises(RemoteProtocolError, match=refusal):
            shard.answer(space=space)
        return
    answer = shard.answer(space=space)
    attack(shard, f"os.pwrite(observations, bytes({SLOT}), 0)")
    assert isinstance(answer, m.StepDone)
    if space is WORDS:
        assert answer.observation == ((0, ("word",)), (0, ()))
    elif space is PAIRS:
        assert list(map(len, answer.observation)) == [MANY, MANY]
    else:
        byte = 1 if numbers[-1] == _BOOL else 2
        members = [[row.tobytes() for row in member] for member in answer.observation]
        assert members == [[bytes([byte]) * 2] * 2, [bytes([byte]) * 2]]


FRAMES = {
    "less than a header": lambda head, batch: [head[:-1]],
    "less than the infos it speaks of": lambda head, batch: [struct.pack("<QQ", 1, 8) + batch[:4]],
    "columns of nobody knows what": lambda head, batch: [struct.pack("<QQ", slabs.COLUMNS, 0)],
    "a shorter batch": lambda head, batch: [head + batch[:-1]],
    "a longer batch": lambda head, batch: [head + batch + b"x"],
    "a longer batch in pieces": lambda head, batch: [head, batch, b"x"],
    "an unknown outcome": lambda head, batch: [struct.pack("<QQ", 9, 0) + batch],
}


@pytest.mark.parametrize("lie", [None, *FRAMES])
@pytest.mark.parametrize("size", [8, 70_000])
def test_what_a_server_sends_of_slabs_has_the_size_that_was_agreed_on(
    lie: str | None, size: int
) -> None:
    """An honest one, which is the control, is read; a byte that is no boolean becomes one."""
    space = spaces.Box(0, 1, (size,), np.bool_)
    layout = slabs.layout_of(spaces.Discrete(2), 2)
    observed = slabs.observation_layout(space, 2, 1)
    assert layout is not None
    assert observed is not None
    shard = ServedShard(layout, observed)
    batch, head = b"\2" * observed.total_bytes, struct.pack("<QQ", slabs.DONE, 0)
    if lie is not None:
        with pytest.raises(RemoteProtocolError):
            shard.read(FRAMES[lie](head, batch))
        return
    for frames in ([head + batch], [head, batch[:9], batch[9:]]):
        assert shard.read(frames) == (slabs.DONE, None)
        received = ReceivedBatch(space, [shard])
        bools = [received.take(), *received.results()[1:]]
        assert {byte for flags in bools for byte in flags.tobytes()} == {1}
