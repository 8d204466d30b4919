"""Our own frames are left out of tracebacks that say without them where it comes from."""

import errno
import logging
import traceback
from collections.abc import Callable

import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import errors
from envhub_sandbox.vector.tracebacks import short_traceback

WHOLE = ["asked", "ask", "deep", "deeper"]


def deeper(error: BaseException, cause: BaseException | None) -> None:
    if cause is None:
        raise error
    raise error from cause


def deep(error: BaseException, cause: BaseException | None) -> None:
    deeper(error, cause)


@short_traceback
def ask(error: BaseException, cause: BaseException | None = None) -> None:
    """As a method of ours."""
    deep(error, cause)


@short_traceback
def ask_by_another(error: BaseException) -> None:
    """As a method of ours that asks another one."""
    ask(error)


def frames(error: BaseException, asking: Callable[..., None] = ask) -> list[str]:
    with pytest.raises(type(error)) as caught:
        asking(error)
    assert caught.value is error
    _, *below = traceback.extract_tb(error.__traceback__)
    return [frame.name for frame in below]


@pytest.mark.parametrize(
    "error",
    [
        errors.remote_error("ValueError", "ValueError", "no"),
        errors.LoadError("no"),
        errors.PolicyError("no"),
        errors.LocalProtocolError("no"),
        errors.WorkerDiedError("no", reason="exit"),
        ClosedEnvironmentError("no"),
    ],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("asking", [ask, ask_by_another])
def test_one_frame_of_ours_is_left(error: Exception, asking: Callable[..., None]) -> None:
    assert frames(error, asking) == ["asked"]
    assert error.__traceback__.tb_next.tb_frame.f_locals["__tracebackhide__"] is True
    [*_, shown] = traceback.extract_tb(error.__traceback__)
    assert shown.line.endswith("# ENVHUB_TRACEBACK=full shows where")


@pytest.mark.parametrize(
    "error",
    [errors.RemoteProtocolError("no"), KeyError("of ours"), KeyboardInterrupt()],
    ids=lambda error: type(error).__name__,
)
def test_what_may_be_our_fault_keeps_its_frames(error: BaseException) -> None:
    assert frames(error) == WHOLE
    assert (ask.__name__, ask.__doc__) == ("ask", "As a method of ours."), "it keeps its face"


def test_logged_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """At DEBUG, however many methods of ours it comes through; a variable shows them all."""
    with caplog.at_level(logging.DEBUG, "envhub_sandbox.errors"):
        frames(errors.LoadError("no"), ask_by_another)
    [record] = [one for one in caplog.records if one.name == "envhub_sandbox.errors"]
    assert [frame.name for frame in traceback.extract_tb(record.exc_info[2])] == WHOLE
    monkeypatch.setenv("ENVHUB_TRACEBACK", "full")
    assert frames(errors.LoadError("no")) == WHOLE


def test_what_the_caller_was_handling_is_kept() -> None:
    error, mine = errors.LoadError("no"), KeyError("mine")
    try:
        raise mine
    except KeyError:
        left = frames(error)
    assert left == ["asked"]
    assert error.__context__ is mine
    assert mine.__traceback__ is not None
    assert not error.__suppress_context__


def test_of_causes_only_ours_are_folded() -> None:
    ours, theirs = errors.LoadError("ours"), OSError("theirs")
    for error, cause in ((ours, theirs), (errors.PolicyError("on top"), ours)):
        with pytest.raises(type(error)):
            deeper(error, cause)
    assert ours.__traceback__ is not None
    with pytest.raises(OSError, match="theirs"):
        deeper(theirs, None)
    with pytest.raises(errors.PolicyError) as caught:
        ask(errors.PolicyError("on top"), ours)
    assert caught.value.__cause__ is ours
    assert ours.__traceback__ is None
    assert theirs.__traceback__ is not None


@pytest.mark.parametrize(
    ("lack", "cure"),
    [
        (errno.EMFILE, r"limit of [0-9,]+ on open files .ulimit -n"),
        (errno.EFBIG, "ulimit -f"),
        (errno.ENOSPC, "df -i"),
    ],
)
def test_what_the_machine_lacks_is_an_error_of_ours(lack: int, cure: str) -> None:
    """With what to do; an error that says nothing of the kind stays what it is."""
    with pytest.raises(errors.WorkerError, match=rf" here: .*{cure}") as caught:
        ask(OSError(lack, "lacks"))
    assert isinstance(caught.value.__cause__, OSError)
    with pytest.raises(FileNotFoundError):
        ask(OSError(errno.ENOENT, "missing"))
