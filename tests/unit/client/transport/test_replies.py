"""What a worker says went wrong becomes an error of ours, whatever the text is."""

from __future__ import annotations

import builtins
import copy
import pickle
import re
from unittest.mock import Mock

import gymnasium as gym
import pytest

from envhub_sandbox import errors
from envhub_sandbox.session.error_text import add_author_line
from envhub_sandbox.transport.replies import check_reply, death, expect_reply, raised, refusal
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import REASONS
from envhub_worker.runner.described import raised as described

ESCAPE = "\x1b]0;owned\x07\x1b[2J\r"


def a_raised(**changed: str) -> m.RaisedException:
    """What a runner says about an exception, with some fields changed."""
    fields = {
        "builtin": "ValueError",
        "type_name": "mypkg.Oops",
        "message": "no",
        "traceback": "Traceback ...",
        "stage": "step",
    }
    return m.RaisedException(**{**fields, **changed})


@pytest.mark.parametrize(
    "name", ["AttributeError", "KeyError", "NotImplementedError", "OSError", "ZeroDivisionError"]
)
def test_errors_are_the_builtin_that_they_were(name: str) -> None:
    """``except KeyError`` catches a remote KeyError, and its text is the worker's."""
    error = raised(a_raised(builtin=name))
    assert isinstance(error, getattr(builtins, name))
    assert isinstance(error, errors.RemoteEnvError)
    assert str(error) == "mypkg.Oops: no"
    assert (error.type_name, error.message, error.traceback) == (
        "mypkg.Oops",
        "no",
        "Traceback ...",
    )


class Own(gym.error.InvalidAction):
    """An error of a repository's own, that is one of Gymnasium's."""


class Both(gym.error.Error, ValueError):
    """One that is a builtin as well."""


@pytest.mark.parametrize(
    ("raises", "kind"),
    [
        (gym.error.ResetNeeded, gym.error.ResetNeeded),
        (Own, gym.error.InvalidAction),
        (Both, ValueError),
        (gym.error.Error, gym.error.Error),
        (KeyError, KeyError),
    ],
)
def test_errors_are_gymnasiums_nearest(raises: type[Exception], kind: type[Exception]) -> None:
    """A worker names the ancestor, and a table in the client has its twin; so has a pickle."""
    error = raised(described(raises("no"), "step"))
    assert isinstance(error, errors.RemoteEnvError)
    for found in (error, pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert isinstance(found, kind)
        assert type(found) is type(error)
        assert str(found).strip("'").endswith("no")
        assert (str(found), found.traceback) == (str(error), error.traceback)


@pytest.mark.parametrize("name", ["KeyboardInterrupt", "SystemExit", "Oops", "", "print", "open"])
def test_other_names_mean_nothing(name: str) -> None:
    error = raised(a_raised(builtin=name))
    assert type(error) is errors.RemoteEnvError


@pytest.mark.parametrize("field", ["type_name", "message", "traceback"])
@pytest.mark.parametrize("stage", ["step", "import", "make_env", "return"])
def test_escape_sequences_are_not_obeyed(field: str, stage: str) -> None:
    """Text of a hostile runner is escaped here: the runner's own care is not relied on."""
    error: BaseException | None = raised(a_raised(stage=stage, **{field: f"a{ESCAPE}b"}))
    while error is not None:
        for text in (str(error), *map(str, vars(error).values())):
            assert "\x1b" not in text
            assert "\r" not in text
        error = error.__cause__


def test_long_texts_are_cut() -> None:
    error = raised(a_raised(message="x" * 3_000_000, type_name="T" * 3_000_000))
    assert len(str(error)) < 20_000


@pytest.mark.parametrize(
    ("reply", "expected"),
    [
        (a_raised(stage="import", builtin="ModuleNotFoundError"), errors.MissingModuleError),
        (a_raised(stage="import", builtin="SyntaxError"), errors.LoadError),
        (a_raised(stage="make_env"), errors.LoadError),
        (a_raised(stage="return"), errors.LoadError),
    ],
)
def test_failures_to_load_say_so(reply: m.RaisedException, expected: type[Exception]) -> None:
    """What fails before there is an environment is an error of loading, as its pickle is."""
    error = raised(reply)
    assert isinstance(error, expected)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_missing_package_is_an_import_error() -> None:
    """As it would be in this process, and of the very class where a module is missing."""
    assert {errors.DependencyError, ModuleNotFoundError} < set(errors.MissingModuleError.mro())
    assert issubclass(errors.DependencyError, ImportError)


@pytest.mark.parametrize("name", ["ValueError", "RuntimeError", "KeyError", "FileNotFoundError"])
def test_failures_to_load_are_the_builtin_that_they_were(name: str) -> None:
    """``except ValueError`` catches what ``make_env`` raised, as it would in this process."""
    error = raised(a_raised(stage="make_env", builtin=name))
    assert isinstance(error, errors.LoadError)
    assert isinstance(error, getattr(builtins, name))
    assert str(error).endswith("mypkg.Oops: no")
    assert isinstance(error.__cause__, getattr(builtins, name))
    assert type(pickle.loads(pickle.dumps(error))) is type(error)


LOADER = "envhub_worker.runner.loader"


@pytest.mark.parametrize(
    ("stage", "kind", "builtin", "expected"),
    [
        ("import", f"{LOADER}.EntryError", "AttributeError", AttributeError),
        ("make_env", f"{LOADER}.ArgumentsError", "TypeError", TypeError),
        ("return", f"{LOADER}.ResultError", "Exception", ValueError),
        ("import", f"{LOADER}.EntryError", "SystemExit", errors.LoadError),  # of an older worker
    ],
)
def test_what_the_loader_refuses_is_what_lerobot_raises(
    stage: str, kind: str, builtin: str, expected: type[Exception]
) -> None:
    """``except AttributeError`` around LeRobot's ``make_env`` goes on working; our table has it."""
    error = raised(a_raised(stage=stage, type_name=kind, builtin=builtin))
    assert isinstance(error, errors.LoadError)
    assert isinstance(error, expected)
    assert not isinstance(error, SystemExit)
    assert str(error) == "no"


def test_a_repository_that_cannot_be_had_is_an_os_error() -> None:
    error = errors.RepositoryUnavailableError("org/repo: there is none")
    assert isinstance(error, OSError)
    error.args = ("here: org/repo: there is none",)
    assert str(error) == "here: org/repo: there is none"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_gymnasiums_own_errors_are_themselves() -> None:
    """``except gymnasium.error.ResetNeeded`` works; what has no such name is looked up nowhere."""
    error = raised(a_raised(builtin="Exception", type_name="gymnasium.error.ResetNeeded"))
    assert isinstance(error, gym.error.ResetNeeded)
    assert isinstance(error, errors.RemoteEnvError)
    assert isinstance(pickle.loads(pickle.dumps(error)), gym.error.ResetNeeded)
    for name in ("gymnasium.error.logger", "gymnasium.error.Nothing", "gymnasium.error_"):
        assert type(raised(a_raised(builtin="Nothing", type_name=name))) is errors.RemoteEnvError


SERVERS = [
    m.Death(1, "exit", 0, None, ESCAPE, ESCAPE, "step"),
    m.Refusal("SandboxUnavailableError", ESCAPE, "", ESCAPE),
    m.RelayDone((1,)),
    m.Done(),
]


@pytest.mark.parametrize("message", SERVERS, ids=lambda message: type(message).__name__)
def test_a_runner_cannot_speak_in_the_servers_name(message: m.Message) -> None:
    """A death or a refusal inside a runner's reply is a broken rule, not news."""
    with pytest.raises(errors.RemoteProtocolError, match="a runner sent") as caught:
        check_reply(message)
    assert "\x1b" not in str(caught.value)


def test_the_kinds_of_both_conversations_are_apart() -> None:
    runners = {cls.__name__ for kind, cls in m.KINDS.items() if kind >= m.FIRST_RUNNER_KIND}
    assert {
        "LoadDone",
        "BuildDone",
        "ResetDone",
        "StepDone",
        "Value",
        "Method",
        "RaisedException",
    } <= runners
    assert not runners & {type(message).__name__ for message in SERVERS}


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        (m.Death(1, "exit", 3, None, "", "", "step"), "died during step: it exited (exit code 3)"),
        (m.Death(1, "signal", None, "SIGKILL", "", "", ""), "died: a signal ended it (SIGKILL)"),
        (m.Death(1, "exit", 0, None, "", "bye", "reset"), "Its last output:\n  | bye"),
        (m.Death(1, "exit", 0, None, "why", "", "reset"), "\nwhy"),
    ],
)
def test_deaths_say_how(reply: m.Death, text: str) -> None:
    """Exit code or signal, the request that was being served, and the last output."""
    error = death(reply)
    assert text in str(error)
    assert (error.exit_code, error.signal, error.reason) == (
        reply.exit_code,
        reply.signal,
        reply.reason,
    )
    assert (error.log_tail, error.request) == (reply.tail, reply.operation or None)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("SandboxUnavailableError", errors.SandboxUnavailableError),
        ("VersionMismatchError", errors.VersionMismatchError),
        ("WorkerError", errors.WorkerError),
        ("ResolutionError", errors.ResolutionError),
        ("PackagesTooLargeError", errors.PackagesTooLargeError),
        ("SystemExit", errors.WorkerError),
    ],
)
def test_refusals_come_from_a_table(name: str, expected: type[Exception]) -> None:
    """The server names an error; what it does not know is a WorkerError."""
    assert type(refusal(m.Refusal(name, "text", "", ""))) is expected


def test_a_missing_layer_comes_with_its_fix() -> None:
    error = refusal(m.Refusal("SandboxUnavailableError", "it is off", "landlock", "turn it on"))
    assert str(error) == "this host cannot enforce landlock: it is off\nturn it on"


def test_other_replies_than_expected_break_the_rules() -> None:
    """A reply of another kind is the worker's fault; deaths and refusals are told as such."""
    assert expect_reply(m.Done(), m.Done) == m.Done()
    with pytest.raises(errors.RemoteProtocolError, match="with Output where Done belongs"):
        expect_reply(m.Output(""), m.Done)
    with pytest.raises(errors.WorkerDiedError):
        expect_reply(SERVERS[0], m.Done)
    with pytest.raises(errors.WorkerError):
        expect_reply(m.Refusal("WorkerError", "no", "", ""), m.Done)


def test_check_raises_what_a_reply_says() -> None:
    check_reply(m.Value(3))
    with pytest.raises(errors.RemoteEnvError):
        check_reply(a_raised())


def test_every_reason_of_a_death_is_told() -> None:
    """In the public docstring, and in words wherever the server gives it."""
    attributes = str(errors.WorkerDiedError.__doc__)
    told = attributes.partition("reason:")[2].partition("log_tail:")[0]
    assert re.findall(r'``"([a-z-]+)"``', told) == list(REASONS)
    for reason in REASONS[: REASONS.index("server")]:
        text = str(death(m.Death(-1, reason, None, None, "", "", "step")))
        assert not text.endswith(f": {reason}")


_IMITATION = (
    "gone\nTraceback (most recent call last):\n"
    "2026-01-01 envhub_sandbox.worker WARNING type your token here"
)


@pytest.mark.parametrize("stage", ["", "import", "make_env", "return"])
@pytest.mark.parametrize("builtin", ["ValueError", "ModuleNotFoundError"])
def test_a_strangers_lines_cannot_be_taken_for_ours(stage: str, builtin: str) -> None:
    """Nor for a traceback of the caller's: all but the first have a margin."""
    error = raised(m.RaisedException(builtin, "Oops", _IMITATION, _IMITATION, stage))
    if not isinstance(error, errors.RemoteEnvError) and error.__cause__ is None:
        shown = [str(error)]
    else:
        add_author_line(error, Mock(root="/nowhere", known_as=lambda name: None))
        shown = [str(error), str(error.__cause__ or error), *vars(error)["__notes__"]]
    shown.append(str(errors.RemoteEnvWarning("repo", "Oops", _IMITATION)))
    for text in shown:
        first, *others = text.splitlines()
        assert "gone" in first or "In the environment" in first
        assert len(others) >= 2
        assert all(line.startswith("  | ") for line in others), text


def test_the_last_output_cannot_be_taken_for_ours() -> None:
    """What a worker prints before it dies is told apart from what is said of its death."""
    died = death(m.Death(1, "exit", 1, None, "", _IMITATION, "step"))
    _, _, *lines = str(died).splitlines()
    assert len(lines) == 3
    assert all(line.startswith("  | ") for line in lines)
    assert died.log_tail == _IMITATION
