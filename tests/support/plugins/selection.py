"""A pytest plugin: the tests that a newcomer needs to trust the copy, and ``--full`` for all.
Without a path, ``-k``, ``-m`` or ``--full``, the short form is run: what bears the marker
``short``, as a module, a class or a function. ``@pytest.mark.short("strict-")`` takes, of a
function's cases, those whose parameters' id starts so. It is to be some hundred tests: the main
job, an attack of each kind with its control, parity over both lanes, and the commands.
CI repeats some tests as another user and with other versions of Python and of packages, there with
``--one-case``: of a test's cases the first, for each profile and each lane that it names."""

from pathlib import Path

import pytest

_NAMED = {"strict", "no-userns", "auto", "frames"}
"""Profiles and lanes, of which ``--one-case`` keeps each."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run every test, and not only what is marked as short"
    parser.addoption("--full", action="store_true", help=text)
    text = "of each test's cases only the first, for each profile and lane"
    parser.addoption("--one-case", action="store_true", help=text)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """In the short form, do not import a module that marks nothing."""
    if collection_path.is_dir() or not is_short(config):
        return None
    return None if "mark.short" in collection_path.read_text() else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is not in the short form, and with ``--one-case`` all but first cases."""
    kept = list(items)
    if is_short(config):
        if idle := sorted(_named(items) - _named(items, met=True)):
            text = ", ".join(f"{start!r} of {test}" for test, start in idle)
            raise pytest.UsageError(f"the short selection names no case by {text}")
        kept = [item for item in items if _is_marked(item)]
    if config.option.one_case:
        kept = _first_cases(kept)
    config.hook.pytest_deselected(items=list(set(items).difference(kept)))
    items[:] = kept


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


def _first_cases(items: list[pytest.Item]) -> list[pytest.Item]:
    first: dict[tuple[str, frozenset[str]], pytest.Item] = {}
    for item in items:
        values = item.callspec.params.values() if hasattr(item, "callspec") else ()
        named = frozenset(one for one in values if isinstance(one, str) and one in _NAMED)
        first.setdefault((item.nodeid.partition("[")[0], named), item)
    return list(first.values())


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
