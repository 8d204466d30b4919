"""A pytest plugin: the tests that a newcomer needs to trust the copy, and ``--full`` for all.

Without a path, ``-k``, ``-m`` or ``--full``, the short form is run: all of ``tests/unit``, and what
bears the marker ``short``, as a module, a class or a function. ``@pytest.mark.short("strict-")``
takes, of a function's cases, those whose parameters' id starts so.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--full``."""
    text = "run every test, and not only tests/unit and what is marked as short"
    parser.addoption("--full", action="store_true", help=text)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is not in the short form.

    Raises:
        UsageError: A marker names cases of which there is none.
    """
    if not is_short(config):
        return
    if idle := sorted(_named(items) - _named(items, met=True)):
        text = ", ".join(f"{start!r} of {test}" for test, start in idle)
        raise pytest.UsageError(f"the short selection names no case by {text}")
    unit = config.rootpath / "tests" / "unit"
    kept = [one for one in items if one.path.is_relative_to(unit) or _is_marked(one)]
    others = set(items).difference(kept)
    config.hook.pytest_deselected(items=[one for one in items if one in others])
    items[:] = kept


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say what was left out."""
    if is_short(config):
        terminalreporter.write_line("the short selection; --full runs every test")


def is_short(config: pytest.Config) -> bool:
    """Whether nothing was asked for by name."""
    named = config.args_source is pytest.Config.ArgsSource.ARGS
    asked = named or config.option.keyword or config.option.markexpr
    return not (asked or config.option.full)


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
