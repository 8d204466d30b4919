"""A worker's output: lines of any bytes, bounded, fit for a terminal."""

import os
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport import output
from envhub_sandbox.transport.output import Lines, OutputFollower, OutputSinks
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import OutputTail
from tests.support import inside


def lines_of(*chunks: bytes) -> list[str]:
    found: list[str] = []
    lines = Lines([found.append])
    for chunk in chunks:
        lines.feed(chunk)
    lines.end()
    return found


def test_lines_are_cut_at_every_end() -> None:
    """Carriage returns count, for progress bars; the last line need not be ended. Escape sequences
    and broken encodings become visible text; a line without end is cut."""
    assert lines_of(b"a\nb\r\nc\rd") == ["a", "b", "c", "d"]
    assert lines_of(b"one ", b"line\nand", b" another") == ["one line", "and another"]
    assert lines_of(b"\x1b[31mred\x07\n\xff\xfe\n") == ["\\x1b[31mred\\x07", "\\xff\\xfe"]
    found = lines_of(*[b"x" * 10_000] * 10)
    assert sum(map(len, found)) >= 20_000
    assert max(map(len, found)) <= 4096 + 100


@given(st.lists(st.binary(max_size=60), max_size=20))
def test_any_bytes_become_printable_lines(chunks: list[bytes]) -> None:
    for line in lines_of(*chunks):
        assert line.isprintable() or "\t" in line


def test_a_file_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rest is left out, and the file says so; what was in it before counts."""
    monkeypatch.setattr(output, "FILE_BYTES", 100)
    path = tmp_path / "out.log"
    path.write_text("before\n")
    sinks = OutputSinks("label", path)
    [file] = sinks.sinks
    for number in range(50):
        file(f"line {number}")
    sinks.close()
    lines = path.read_text().splitlines()
    assert (lines[:2], lines[-1]) == (["before", "line 0"], "[the rest is left out]")
    assert path.stat().st_size < 150


def test_a_file_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(output.PolicyError, match="output"):
        OutputSinks("label", tmp_path)


@given(
    prints=st.lists(st.integers(0, 30), max_size=12),
    limit=st.integers(1, 20),
    asks=st.sets(st.integers(0, 12)),
)
def test_a_follower_gets_every_kept_byte(prints: list[int], limit: int, asks: set[int]) -> None:
    """Each once, in order; what it misses is the bytes that were dropped, and it can tell."""
    reads, writes = os.pipe2(os.O_NONBLOCK)
    tail = OutputTail(reads, limit)
    printed, followed, offset = b"", b"", 0
    for index, size in enumerate(prints):
        data = bytes((len(printed) + place) % 256 for place in range(size))
        printed += data
        os.write(writes, data)
        tail.read()
        if index in asks:
            start, got = tail.since(offset)
            assert start >= offset
            assert got == printed[start:]
            assert len(printed) - start >= min(len(printed) - offset, limit)
            followed, offset = followed + got, start + len(got)
    assert tail.since(len(printed) + 5) == (len(printed), b"")
    os.close(writes)
    tail.read()
    assert tail.ended
    tail.read()  # after its end: nothing happens
    tail.close()


@pytest.mark.parametrize("end", ["\n", "\r"])
def test_what_is_told_does_not_begin_amid_a_line(end: str) -> None:
    """Half of a secret would not be found where secrets are left out."""
    reads, writes = os.pipe2(os.O_NONBLOCK)
    tail = OutputTail(reads, 20)
    os.write(writes, f"before{end}".encode())
    tail.read()
    assert tail.text() == "before", "all of it is there"
    os.write(writes, f"key=hf_secretsecret{end}and more of it".encode())
    tail.read()
    assert tail.text() == "and more of it"
    os.close(writes)
    tail.close()


def test_a_follower_ends_though_a_server_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has more at each request, for ever; who stops following is not kept busy."""
    monkeypatch.setattr(*inside.FETCHING_THE_REST_S, 0.1)
    ended = threading.Event()

    def more(request: m.FollowOutput, **_: object) -> tuple[m.Message, list[object]]:
        return m.OutputBytes(request.offset, b"x\n"), []

    server = Mock(request=more, close=ended.set)
    OutputFollower(lambda: server, 1, OutputSinks("label", None)).stop()
    assert ended.wait(60)


def test_stderr_gets_lines_as_it_is_now(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A notebook puts another in its place, and what takes nothing hurts nobody. It takes no more
    than a file: somebody keeps what our program prints, and a worker may print for ever."""
    monkeypatch.setattr(output, "FILE_BYTES", 30)
    [sink] = OutputSinks("repo", None, stderr=True).sinks
    sink("hello")
    assert capsys.readouterr() == ("", "hello\n")
    with open(os.devnull) as unwritable:
        for broken in (None, unwritable):
            with monkeypatch.context() as patch:
                patch.setattr("sys.stderr", broken)
                sink("lost")
    for _ in range(5):
        sink("12345678")
    assert capsys.readouterr() == ("", "12345678\n[the rest is left out]\n")
