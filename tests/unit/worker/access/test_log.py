"""The lines of a server's log: bounded in number and length, and never two for one event."""

import contextlib
import json
import os

import pytest

from envhub_worker.extras.access.audit.log import CLIENT_LINES, FORMS, LINES, Log


def test_a_log_cannot_be_filled() -> None:
    """A few lines of a kind in a minute, then how many more there were. A client has many of its
    own; what it wastes is neither another's nor a stranger's."""
    now, lines = [0.0], list[str]()
    log = Log(lines.append, lambda: now[0])
    for _ in range(1000):
        log.say("unknown_key", why="noise")
    log.say("stopped", why="something else")
    assert len(lines) == LINES + 1
    now[0] = 61
    log.tick()
    assert lines[-1].endswith(f"left_out of=unknown_key lines={1000 - LINES}")
    lines.clear()
    for _ in range(CLIENT_LINES + 5):
        log.say("refused", whose="a" * 64, client="mallory")
    assert len(lines) == CLIENT_LINES
    log.say("refused", whose="b" * 64, client="alice")
    log.say("refused", why="a stranger")
    assert len(lines) == CLIENT_LINES + 2
    now[0] = 122
    log.tick()
    assert lines[-1].endswith(f"left_out of=refused lines=5 key={'a' * 16}")


def test_a_log_that_nobody_reads_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    broken = open(write, "w", buffering=1)  # noqa: SIM115
    monkeypatch.setattr("sys.stderr", broken)
    Log().say("refused", why="to a pipe without a reader")
    with contextlib.suppress(BrokenPipeError):
        broken.close()
    Log().say("refused", why="to a closed stream")


@pytest.mark.parametrize("form", FORMS)
def test_a_line_is_short_plain_and_one(form: str) -> None:
    evil = "a\n\r\x1b[2J\x85\u2028\u202e\ud800\"'\\ b=c" + "x" * 10_000
    line = FORMS[form](0.0, "info", "jail_opened", {"client": evil, "number": 7, "some": True})
    assert line.isprintable()
    assert line.isascii()
    assert len(line) < 1_000
    assert "1970-01-01T00:00:00.000Z" in line
    if form == "json":
        told = json.loads(line)
        assert (told["number"], told["some"], told["event"]) == (7, True, "jail_opened")
        assert told["client"].startswith(evil[:30])
    else:
        assert line.startswith('1970-01-01T00:00:00.000Z info jail_opened client="a\\n')
        assert line.endswith("number=7 some=true")
