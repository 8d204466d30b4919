"""Progress is a line where somebody looks, and a record in any case."""

import io
import logging
import sys

import pytest

from envhub_sandbox.system import log


def test_loggers_are_ours_and_silent() -> None:
    for one in (log.WORKER, log.OUTPUT, log.SNAPSHOT, log.DEPENDENCIES, log.CRASHES, log.ERRORS):
        assert one.name.startswith(f"{log.ROOT.name}.")
        assert one.handlers == []
    assert [type(one) for one in log.ROOT.handlers] == [logging.NullHandler]


def test_each_line_is_logged_and_shown(caplog: pytest.LogCaptureFixture) -> None:
    outer, inner = list[str](), list[str]()
    with caplog.at_level(logging.INFO, log.DEPENDENCIES.name):
        with log.progress_shown_by(outer.append):
            with log.progress_shown_by(inner.append), log.progress_shown("org/repo") as tell:
                tell("resolving")
                tell("x" * 300)
            with log.progress_shown("org/repo") as tell:
                tell("installing")
        with log.progress_shown("org/repo") as tell:
            tell("for nobody")
    assert (inner[0], len(inner[1])) == ("org/repo: resolving", 100)
    assert outer == ["org/repo: installing"]
    assert len(caplog.messages) == 4


@pytest.mark.parametrize("variables", [{}, {"CI": "1"}])
def test_terminals_alone_get_it(variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return bool(variables)

    monkeypatch.delenv("CI", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "stderr", Terminal())
    with log.progress_shown("org/repo") as tell:
        tell("resolving")
    assert sys.stderr.getvalue() == ""
