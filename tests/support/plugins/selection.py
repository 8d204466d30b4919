"""A pytest plugin: the tests that a newcomer needs to trust the copy, and ``--full`` for all.

Whoever names nothing gets the short selection below: some minutes instead of a quarter of an hour.
With ``--full``, a path, ``-k`` or ``-m`` what is asked for is run, as ever.
"""

from __future__ import annotations

import pytest

_ATTACKS = (
    "bombs.py::test_memory_bomb_stops_at_the_limit[strict-heap",
    "bombs.py::test_fork_bomb_stops_at_the_limit[strict-fork",
    "bombs.py::test_disk_cannot_be_filled[strict",
    "checkouts.py::",
    "client_jails.py::test_pickles_from_a_jail_are_never_loaded[strict",
    "client_jails.py::test_bombs_from_a_jail_are_refused[strict",
    "client_lies.py::",
    "descriptors.py::test_open_files_are_not_inherited[strict",
    "descriptors.py::test_noise_on_the_stream_ends_only_its_jail[strict-ff",
    "doorbells.py::test_a_client_that_is_answered_is_not_held[strict-fill",
    "files.py::test_private_files_cannot_be_read[strict",
    "kept_jails.py::test_runners_cannot_speak_of_deaths[strict",
    "kernel.py::test_no_user_namespace_can_be_made[strict",
    "kernel.py::test_nothing_can_be_mounted[strict",
    "network.py::test_tcp_does_not_get_out[strict",
    "network.py::test_dns_does_not_get_out[strict",
    "outliving.py::test_nothing_outlives_the_environment[strict-a daemon",
    "processes.py::test_memory_and_files_cannot_be_read[strict-read /proc",
    "processes.py::test_signals_do_not_reach_the_client[strict-kill",
    "secrets.py::test_token_is_not_in_the_environment[strict",
    "secrets.py::test_token_is_not_in_memory[strict",
    "servers.py::",
    "slabs.py::",
    "terminal.py::test_errors_do_not_paint[strict",
    "threat_model.py::",
    "unix_sockets.py::test_socket_files_cannot_be_connected_to[strict-a docker socket",
    "writes.py::test_files_outside_cannot_be_written[strict-a file in the home",
    "writes.py::test_files_outside_cannot_be_created[strict-/tmp",
)
SHORT = (
    # each module by itself
    "tests/unit/",
    # the results are those of the same code in this process, bit for bit
    "tests/compliance/test_join_infos.py::",
    "tests/compliance/differential/test_differential.py::test_random_cases_do_not_differ[0]",
    "tests/compliance/test_parity.py::TestCounterInUnevenShards::",
    "tests/compliance/test_parity.py::TestCartPole::",
    "tests/compliance/test_parity.py::TestLeRobotPendulum::",
    # one of each family of attacks, and what a client is told by a liar
    *(f"tests/attacks/test_{start}" for start in _ATTACKS),
    # how environments end, and that nothing of them remains
    "tests/faults/remains/test_nothing_left.py::",
    "tests/faults/test_interrupts.py::",
    "tests/faults/test_late_replies.py::",
    "tests/faults/test_restarts.py::",
    "tests/faults/test_crashes.py::test_a_bundle_holds_what_is_promised",
    # what a repository may be, and what is said when it is none
    "tests/integration/test_examples.py::",
    "tests/integration/test_loading.py::",
    "tests/integration/test_samples.py::TestManyTasks::",
    "tests/integration/test_hub_olah.py::test_each_repository_type_loads",
    "tests/integration/test_hub_lies.py::",
    "tests/integration/cli/test_run.py::test_a_run_prints_results_and_nothing_else",
    "tests/integration/cli/test_run.py::test_failures_have_a_code_and_a_message",
    "tests/integration/test_cli_doctor.py::",
    # each layer that confines, as the kernel shows it
    "tests/integration/test_confinement.py::test_files_outside",
    "tests/integration/test_confinement.py::test_strict_",
    "tests/integration/test_confinement.py::test_capabilities_and_privileges_are_gone",
    "tests/integration/test_confinement.py::test_listener_outside_is_not_reached[strict",
    "tests/integration/test_confinement.py::test_denial_that_does_not_hold_aborts",
    "tests/integration/test_confinement.py::test_host_without_landlock_is_refused",
    "tests/integration/test_confinement_limits.py::test_disk_fill_stops_at_the_quota",
    # another host: keys, the same results, strangers
    "tests/remote/access/test_keys.py::",
    "tests/remote/test_parity.py::TestCounter::",
    "tests/remote/test_parity.py::TestExoticSpaces::",
    "tests/remote/access/test_strangers.py::test_another_clients_key_is_refused_at_once",
    "tests/remote/access/test_strangers.py::test_no_key_is_refused_at_once",
)
"""Beginnings of the ids of the tests that are in it. What names no test any more is an error."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--full``."""
    text = "run every test, and not the short selection of tests/support/plugins/selection.py"
    parser.addoption("--full", action="store_true", help=text)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is not in the selection.

    Raises:
        UsageError: Something in the selection names no test, and no folder that ``--ignore`` names.
    """
    if not is_short(config):
        return
    ignored = tuple(f"{folder.rstrip('/')}/" for folder in config.option.ignore or ())
    sought = [start for start in SHORT if not start.startswith(ignored)]
    idle = [start for start in sought if not any(one.nodeid.startswith(start) for one in items)]
    if idle:
        raise pytest.UsageError(f"the short selection names no test by {', '.join(idle)}")
    others = [one for one in items if not one.nodeid.startswith(SHORT)]
    config.hook.pytest_deselected(items=others)
    items[:] = [one for one in items if one.nodeid.startswith(SHORT)]


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
