"""Packets on a stream: cut anywhere they arrive whole; lies about lengths cost nothing."""

import itertools
import struct
import tracemalloc

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.stream import Packet, StreamReader, pack_packet

Plain = tuple[int, list[bytes]]
LIMITS = WireLimits(header_bytes=1000, frame_bytes=10_000, message_bytes=12_000, frames=4)
frames = st.lists(st.binary(max_size=200), min_size=1, max_size=4)
packets = st.lists(st.tuples(st.integers(0, 2**63 - 1), frames), max_size=5)


def head(count: int, *lengths: int, request_id: int = 1) -> bytes:
    return struct.pack(f"<QQ{len(lengths)}Q", count, request_id, *lengths)


def on_the_wire(sent: list[Plain]) -> bytes:
    return b"".join(bytes(part) for each in sent for part in pack_packet(*each))


def plain(packet: Packet) -> Plain:
    return packet.request_id, [bytes(frame) for frame in packet.frames]


def read(chunks: list[bytes], limits: WireLimits = LIMITS) -> list[Plain]:
    reader = StreamReader(limits)
    return [plain(packet) for chunk in chunks for packet in reader.feed(chunk)]


def cut(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({0, len(data), *(place % (len(data) + 1) for place in cuts)})
    return [data[start:stop] for start, stop in itertools.pairwise(places)]


@given(packets, st.lists(st.integers(0, 2000), max_size=20) | st.just(list(range(5000))))
def test_packets_arrive_whole_however_the_stream_is_cut(sent: list[Plain], cuts: list[int]) -> None:
    assert read(cut(on_the_wire(sent), cuts)) == sent


def test_a_packet_is_whole_and_its_own() -> None:
    reader = StreamReader(LIMITS)
    [empty] = reader.feed(on_the_wire([(3, [b"", b"", b""])]))
    assert plain(empty) == (3, [b"", b"", b""])
    [first] = reader.feed(on_the_wire([(1, [b"first"])]))
    list(reader.feed(on_the_wire([(2, [b"other"])])))
    assert plain(first) == (1, [b"first"])


def test_large_frames_are_not_copied_when_packed() -> None:
    frame = bytearray(1000)
    assert pack_packet(1, [b"", frame])[2] is frame


@pytest.mark.parametrize(
    "data",
    [head(0), head(5), head(2**32 - 1), head(2**64 - 1), head(1, request_id=2**63)],
    ids=["no frame", "too many frames", "endless frames", "more than 32 bits", "id out of range"],
)
def test_heads_that_break_the_rules_are_refused_at_once(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        read([data])


@pytest.mark.parametrize(
    "lengths",
    [(1001,), (10, 10_001), (1000, 6000, 6000), (2**63, 1), (1, 2**64 - 1)],
    ids=["header", "frame", "message", "absurd header", "absurd frame"],
)
def test_lengths_over_a_limit_are_refused_before_a_byte_of_them(lengths: tuple[int, ...]) -> None:
    with pytest.raises(MessageTooLargeError, match="over the limit"):
        read([head(len(lengths), *lengths)])


def test_lengths_at_the_limit_are_accepted() -> None:
    sent = [(1, [bytes(1000), bytes(10_000), bytes(1000)])]
    assert read([on_the_wire(sent)]) == sent


def test_declared_and_never_sent_costs_no_memory() -> None:
    limits = WireLimits()
    reader = StreamReader(limits)
    process = psutil.Process()
    before = process.memory_info().rss
    assert list(reader.feed(head(2, 100, limits.frame_bytes - 1000))) == []
    assert process.memory_info().rss - before < 64 * 1024 * 1024


def test_many_small_packets_keep_nothing() -> None:
    reader = StreamReader(LIMITS)
    data = on_the_wire([(1, [bytes(500)])])
    list(reader.feed(data))
    tracemalloc.start()
    for _ in range(2000):
        list(reader.feed(data))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 500_000


@pytest.mark.parametrize("torn", [0, 10])
def test_of_a_flood_of_small_packets_the_rest_is_not_copied(torn: int) -> None:
    """For each of them that would be quadratic work; also where the first one comes in two."""
    flood, reader = head(1, 0) * 10_000, StreamReader(LIMITS)
    assert list(reader.feed(flood[:torn])) == []
    rest = memoryview(flood)[torn:]
    tracemalloc.start()
    assert sum(1 for _ in reader.feed(rest)) == 10_000
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < len(flood) // 10


def test_what_must_not_come_is_refused_before_there_is_memory_for_it() -> None:
    def check(request_id: int) -> None:
        if request_id != 1:
            raise RemoteProtocolError("nobody asked")

    reader = StreamReader(check=check)
    [packet] = reader.feed(b"".join(pack_packet(1, [b"asked"])))
    assert packet.request_id == 1
    header = pack_packet(2, [bytes(1 << 20)])[0]
    with pytest.raises(RemoteProtocolError, match="nobody asked"):
        list(reader.feed(header))
