"""A pytest plugin: the tests that a newcomer needs to trust the copy, and ``--full`` for all.

Without a path, ``-k``, ``-m`` or ``--full``, the short form is run: what bears the marker
``short``, as a module, a class or a function. ``@pytest.mark.short("strict-")`` takes, of a
function's cases, those whose parameters' id starts so. It is to be some hundred tests: the main
job, an attack of each kind with its control, parity over both lanes, and the commands.

CI repeats tests as another user (``--differs-by users``), and with other versions of Python and
of packages (``--differs-by versions``). ``@pytest.mark.same_for("users", "versions")`` says for
which of these a test proves the same again: it is left out there.
"""

from __future__ import annotations

from pathlib import Path

import pytest

REPEATED = ("users", "versions")
"""What CI repeats tests for."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--full`` and ``--differs-by``."""
    text = "run every test, and not only what is marked as short"
    parser.addoption("--full", action="store_true", help=text)
    text = "leave out what is marked as the same for them"
    parser.addoption("--differs-by", choices=REPEATED, help=text)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """In the short form, do not import a module that marks nothing."""
    if collection_path.is_dir() or not is_short(config):
        return None
    return None if "mark.short" in collection_path.read_text() else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what need not be repeated, and what is not in the short form.

    Raises:
        UsageError: A marker names cases of which there is none, or what is no reason to repeat.
    """
    if wrong := sorted({str(one) for x in items for one in _same_for(x) - set(REPEATED)}):
        raise pytest.UsageError(
            f"same_for names {', '.join(wrong)}; CI repeats for {' and '.join(REPEATED)}"
        )
    _keep(config, items, [one for one in items if config.option.differs_by not in _same_for(one)])
    if not is_short(config):
        return
    if idle := sorted(_named(items) - _named(items, met=True)):
        text = ", ".join(f"{start!r} of {test}" for test, start in idle)
        raise pytest.UsageError(f"the short selection names no case by {text}")
    _keep(config, items, [x for x in items if _is_marked(x)])


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    if is_short(config):
        terminalreporter.write_line("the short selection; --full runs every test")


def is_short(config: pytest.Config) -> bool:
    """Whether nothing was asked for by name."""
    named = config.args_source is pytest.Config.ArgsSource.ARGS
    asked = named or config.option.keyword or config.option.markexpr
    return not (asked or config.option.full)


def _keep(config: pytest.Config, items: list[pytest.Item], kept: list[pytest.Item]) -> None:
    others = set(items).difference(kept)
    config.hook.pytest_deselected(items=[one for one in items if one in others])
    items[:] = kept


def _same_for(item: pytest.Item) -> set[object]:
    return {name for mark in item.iter_markers("same_for") for name in mark.args}


def _is_marked(item: pytest.Item) -> bool:
    return any(
        not mark.args or _parameters(item).startswith(mark.args)
        for mark in item.iter_markers("short")
    )


def _named(items: list[pytest.Item], *, met: bool = False) -> set[tuple[str, str]]:
    """Each test's name, with each start that its marker names; or those only that a case has."""
    return {
        (item.nodeid.partition("[")[0], start)
        for item in items
        for mark in item.iter_markers("short")
        for start in mark.args
        if not met or _parameters(item).startswith(start)
    }


def _parameters(item: pytest.Item) -> str:
    return item.nodeid.partition("[")[2]
