"""What a worker says went wrong becomes an error of ours, whatever the text is."""

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
    fields = {
        "builtin": "ValueError",
        "type_name": "mypkg.Oops",
        "message": "no",
        "traceback": "Traceback ...",
        "stage": "step",
    }
    return m.RaisedException(**{**fields, **changed})


LOADER = "envhub_worker.runner.loader"
REMOTE = (errors.RemoteEnvError,)
LOAD = (errors.LoadError,)


@pytest.mark.parametrize(
    ("changed", "kinds", "text"),
    [
        *(
            ({"builtin": kind.__name__}, (*REMOTE, kind), "mypkg.Oops: no")
            for kind in (AttributeError, KeyError, NotImplementedError, OSError, ZeroDivisionError)
        ),
        (
            {"builtin": "Exception", "type_name": "gymnasium.error.ResetNeeded"},
            (*REMOTE, gym.error.ResetNeeded),
            "no",
        ),
        ({"stage": "import", "builtin": "ModuleNotFoundError"}, (errors.DependencyError,), "no"),
        ({"stage": "import", "builtin": "SyntaxError"}, LOAD, "no"),
        ({"stage": "return"}, LOAD, "no"),
        *(
            ({"stage": "make_env", "builtin": kind.__name__}, (*LOAD, kind), "mypkg.Oops: no")
            for kind in (ValueError, RuntimeError, KeyError, FileNotFoundError)
        ),
        # around LeRobot's make_env, ``except AttributeError`` goes on working; our table has it
        *(
            (
                {"stage": stage, "type_name": f"{LOADER}.{name}", "builtin": builtin},
                (*LOAD, kind),
                "no",
            )
            for stage, name, builtin, kind in (
                ("import", "EntryError", "AttributeError", AttributeError),
                ("make_env", "ArgumentsError", "TypeError", TypeError),
                ("return", "ResultError", "Exception", ValueError),
                ("import", "EntryError", "SystemExit", errors.LoadError),  # of an older worker
            )
        ),
    ],
)
def test_errors_are_what_they_were(
    changed: dict[str, str], kinds: tuple[type[Exception], ...], text: str
) -> None:
    """Of our class and of the builtin or Gymnasium's; so is a pickle. The text is the worker's."""
    error = raised(a_raised(**changed))
    assert str(error).endswith(text)
    for one in (error, pickle.loads(pickle.dumps(error))):
        assert all(isinstance(one, kind) for kind in kinds)
        assert (type(one), str(one)) == (type(error), str(error))
        assert not isinstance(one, SystemExit)
    if isinstance(error, errors.RemoteEnvError):
        told = (error.type_name, error.message, error.traceback)
        assert told == (changed.get("type_name", "mypkg.Oops"), "no", "Traceback ...")
    elif kinds[1:] and text != "no":
        assert isinstance(error.__cause__, kinds[1])


@pytest.mark.parametrize(("reason", "known"), [("size", "size"), ("of its own", "other")])
def test_a_missing_package_is_an_import_error(reason: str, known: str) -> None:
    """As it would be in this process, for a reason that the client knows."""
    error = refusal(m.Refusal("DependencyError", "text", reason, ""))
    assert isinstance(error, errors.DependencyError)
    assert isinstance(error, ModuleNotFoundError)
    assert (str(error), error.reason) == ("text", known)
    assert pickle.loads(pickle.dumps(error)).reason == known


@pytest.mark.parametrize(
    "changed",
    [
        *({"builtin": one} for one in ("KeyboardInterrupt", "SystemExit", "Oops", "", "open")),
        *(
            {"builtin": "Nothing", "type_name": f"gymnasium.{name}"}
            for name in ("error.logger", "error.Nothing", "error_")
        ),
    ],
)
def test_other_names_mean_nothing(changed: dict[str, str]) -> None:
    assert type(raised(a_raised(**changed))) is errors.RemoteEnvError


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


@pytest.mark.parametrize("field", ["type_name", "message", "traceback"])
@pytest.mark.parametrize("stage", ["step", "import", "make_env", "return"])
def test_escape_sequences_are_not_obeyed(field: str, stage: str) -> None:
    """Text of a hostile runner is escaped here: the runner's own care is not relied on."""
    error: BaseException | None = raised(a_raised(stage=stage, **{field: f"a{ESCAPE}b"}))
    while error is not None:
        for text in (str(error), *map(str, vars(error).values())):
            assert not {"\x1b", "\r"} & set(text)
        error = error.__cause__
    error = raised(a_raised(stage=stage, **{field: "x" * 3_000_000}))
    assert len(str(error)) < 20_000
    while error is not None:
        assert max(map(len, map(str, vars(error).values())), default=0) < 40_000
        error = error.__cause__


@pytest.mark.parametrize("field", ["reason", "signal", "detail", "tail", "operation"])
@pytest.mark.parametrize("said", [f"a{ESCAPE}b", "x" * 3_000_000])
def test_a_server_cannot_paint_a_death(field: str, said: str) -> None:
    """Nor fill a screen, but with what a jail has printed; the server may be anybody's."""
    error = death(m.replace(m.Death(1, "exit"), **{field: said}))
    for text in (str(error), *map(str, vars(error).values())):
        assert not {"\x1b", "\r"} & set(text)
        assert field == "tail" or len(text) < 20_000


@pytest.mark.parametrize("field", ["message", "missing", "fix"])
def test_a_server_cannot_paint_a_refusal(field: str) -> None:
    told = {"message": "no", "missing": "", "fix": "", field: ESCAPE}
    assert not {"\x1b", "\r"} & set(str(refusal(m.Refusal("SandboxUnavailableError", **told))))


def test_a_repository_that_cannot_be_had_is_an_os_error() -> None:
    error = errors.RepositoryUnavailableError("org/repo: there is none")
    assert isinstance(error, OSError)
    error.args = ("here: org/repo: there is none",)
    assert str(error) == "here: org/repo: there is none"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


SERVERS = [
    m.Death(1, "exit", 0, None, ESCAPE, ESCAPE, "step"),
    m.Refusal("SandboxUnavailableError", ESCAPE, "", ESCAPE),
    m.RelayDone((1,)),
    m.Done(),
]


@pytest.mark.parametrize("message", SERVERS, ids=lambda message: type(message).__name__)
def test_a_runner_cannot_speak_in_the_servers_name(message: m.Message) -> None:
    with pytest.raises(errors.RemoteProtocolError, match="a runner sent") as caught:
        check_reply(message)
    assert "\x1b" not in str(caught.value)


def test_the_kinds_of_both_conversations_are_apart() -> None:
    """What runners may send begins at one number."""
    runners = {cls.__name__ for kind, cls in m.KINDS.items() if kind >= m.FIRST_RUNNER_KIND}
    assert {"LoadDone", "BuildDone", "ResetDone", "StepDone", "RaisedException"} <= runners
    assert not runners & {type(message).__name__ for message in SERVERS}


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        (m.Death(1, "exit", 3, None, "", "", "step"), "died during step: it exited (exit code 3)"),
        (m.Death(1, "signal", None, "SIGKILL", "", "", ""), "died: a signal ended it (SIGKILL)"),
        (m.Death(1, "exit", 0, None, "", "bye", "reset"), "Its last output:\n  | bye"),
        (m.Death(1, "exit", 0, None, "why", "", "reset"), "\nwhy"),
        (m.Death(1, "out-of-memory", 0, None, "(memory_bytes)", "", ""), "(limits: memory_bytes)"),
    ],
)
def test_deaths_say_how(reply: m.Death, text: str) -> None:
    error = death(reply)
    assert text in str(error)
    told = (error.exit_code, error.signal, error.reason, error.log_tail, error.request)
    assert told == (
        *(reply.exit_code, reply.signal, reply.reason, reply.tail),
        reply.operation or None,
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("SandboxUnavailableError", errors.SandboxUnavailableError),
        ("VersionMismatchError", errors.VersionMismatchError),
        ("WorkerError", errors.WorkerError),
        ("SystemExit", errors.WorkerError),
        ("LoadError", errors.WorkerError),
    ],
)
def test_refusals_come_from_a_table(name: str, expected: type[Exception]) -> None:
    assert type(refusal(m.Refusal(name, "text", "", ""))) is expected
    error = refusal(m.Refusal("SandboxUnavailableError", "it is off", "landlock", "turn it on"))
    assert str(error) == "this host cannot enforce landlock: it is off\nturn it on"


def test_other_replies_than_expected_break_the_rules() -> None:
    """A reply of another kind is the worker's fault; deaths and refusals are told as such."""
    check_reply(m.Value(3))
    assert expect_reply(m.Done(), m.Done) == m.Done()
    for reply, kind, said in (
        (m.GetStatus(), errors.RemoteProtocolError, "with GetStatus instead of Done"),
        (SERVERS[0], errors.WorkerDiedError, "died"),
        (m.Refusal("WorkerError", "no", "", ""), errors.WorkerError, "no"),
    ):
        with pytest.raises(kind, match=said):
            expect_reply(reply, m.Done)
    with pytest.raises(errors.RemoteEnvError):
        check_reply(a_raised())


def test_every_reason_of_a_death_is_told() -> None:
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
    died = death(m.Death(1, "exit", 1, None, "", _IMITATION, "step"))
    assert died.log_tail == _IMITATION
    _, _, *printed = str(died).splitlines()
    assert len(printed) == 3
    assert all(line.startswith("  | ") for line in printed)
    for text in shown:
        first, *others = text.splitlines()
        assert "gone" in first or "In the environment" in first
        assert len(others) >= 2
        assert all(line.startswith("  | ") for line in others), text
