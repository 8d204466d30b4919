"""Options become arguments of ``make_env``, or a message that says what to write."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import typer

from envhub_sandbox.cli.app import app
from envhub_sandbox.cli.shared.exits import ForeignError, UsageError
from envhub_sandbox.cli.shared.options import MakeOptions, read_env_kwargs, read_gpu, read_size
from envhub_sandbox.cli.shared.select import select
from envhub_sandbox.errors import PolicyError, RemoteEnvError
from envhub_sandbox.policy import policy_from

_OUTPUT = "worker_output"
"""The panel of another kind has it."""


def options(**given: Any) -> MakeOptions:
    """Options of ``envhub run`` as typed; the others at their defaults."""
    command = typer.main.get_command(app).commands["run"]  # type: ignore[attr-defined]
    params = {one.name: one.default for one in command.params} | {"ref": "org/repo"}
    assert set(given) <= set(params)
    return MakeOptions.of(SimpleNamespace(command=command, params={**params, **given}))


def test_gpus_are_all_or_named_by_number() -> None:
    """Anything else is told in the words of the option."""
    assert [read_gpu(text) for text in (None, "all", "0", "0,2")] == [None, True, [0], [0, 2]]
    for text in ("", "true", "-1", "0,", "0 1"):
        with pytest.raises(UsageError, match="it takes all, or indices"):
            read_gpu(text)


@pytest.mark.parametrize("name", ["run", "inspect", "check"])
def test_every_option_about_make_env_reaches_it(name: str) -> None:
    """None is lost, and none of another meaning is taken for one."""
    command = typer.main.get_command(app).commands[name]  # type: ignore[attr-defined]
    panels = ("How it is built", "What it may do", "Where it comes from")
    about = {
        one.name for one in command.params if getattr(one, "rich_help_panel", None) in panels
    } - {"suite", "task", "policy"}  # which make_env is not told, or not in this way
    assert len(about) > 15
    params = {one.name: f"<{one.name}>" for one in command.params}
    made = MakeOptions.of(SimpleNamespace(command=command, params=params))
    assert set(made.given.values()) == {f"<{one}>" for one in about | set(params) & {_OUTPUT}}
    assert (made.ref, made.given["step_s"]) == ("<ref>", "<timeout>")


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1048576", 2**20),
        ("512M", 512 * 2**20),
        ("4g", 4 * 2**30),
        ("1.5GiB", 3 * 2**29),
        ("2 KB", 2048),
        (None, None),
    ],
)
def test_sizes_are_read(text: str | None, size: int | None) -> None:
    """In the spellings that people use; units are powers of 1024."""
    assert read_size("--memory", text) == size


@pytest.mark.parametrize("text", ["", "M", "-1G", "4 gigs", "1e9", "nan"])
def test_what_is_no_size_is_refused(text: str) -> None:
    """With the option's name."""
    with pytest.raises(UsageError, match="--memory"):
        read_size("--memory", text)


def test_env_kwargs_take_json_and_pairs() -> None:
    """Values are JSON where they can be; later ones win."""
    texts = [
        '{"size": 8, "name": "a"}',
        "size=9",
        "mode=rgb_array",
        "on=true",
        "path=a=b",
        "empty=",
    ]
    assert read_env_kwargs(texts) == {
        "size": 9,
        "name": "a",
        "mode": "rgb_array",
        "on": True,
        "path": "a=b",
        "empty": "",
    }


@pytest.mark.parametrize("text", ["size", "=3", "a b=3", "{", '{"a": }', "[1]"])
def test_env_kwargs_that_are_neither_are_refused(text: str) -> None:
    """With what to write instead, or what is wrong with the JSON."""
    with pytest.raises(UsageError, match="--env-kwargs"):
        read_env_kwargs([text])


def test_only_what_was_given_reaches_the_policy() -> None:
    """Defaults stay the library's."""
    assert options().arguments()["policy"] == {}
    assert options().arguments()["timeouts"] == {}
    given = options(
        memory="1G", cpu_time=5, network="loopback", gpu="all", readable=["/data"], variables=["A"]
    )
    assert given.arguments()["policy"] == {
        "network": "loopback",
        "gpu": True,
        "readable": ["/data"],
        "environment": ["A"],
        "limits": {"memory_bytes": "1G", "cpu_s": 5},
    }


@pytest.mark.parametrize("name", ["memory", "disk", "processes", "cpu_time"])
def test_a_limit_of_nothing_is_refused(name: str) -> None:
    """And is not taken for the default."""
    given = options(**{name: "0" if name in ("memory", "disk") else 0}).arguments()
    with pytest.raises(PolicyError, match="above 0"):
        policy_from(given["policy"], None)


def test_a_timeout_is_for_every_operation_but_close() -> None:
    """Closing is bounded by itself."""
    timeouts = options(timeout=7.5).arguments()["timeouts"]
    assert timeouts == {"startup_s": 7.5, "reset_s": 7.5, "step_s": 7.5, "call_s": 7.5}


def test_running_unprotected_needs_the_word() -> None:
    """Before anything is fetched, and in the words of the command line."""
    with pytest.raises(UsageError, match="--trust-remote-code"):
        options(sandbox="none").arguments()
    assert options(sandbox="none", trust=True).arguments()["sandbox"] is None


def test_only_without_a_sandbox_are_strange_errors_the_repositorys() -> None:
    """In the sandbox they would be bugs of ours, and must stay visible as such."""
    with pytest.raises(ForeignError, match="KeyError: 'x'"), options(sandbox="none").explained():
        raise KeyError("x")
    with pytest.raises(KeyError), options().explained():
        raise KeyError("x")
    with pytest.raises(RemoteEnvError), options(sandbox="none").explained():
        raise RemoteEnvError("Oops", "text")


SUITES: dict[str, dict[Any, Any]] = {"a": {0: "a0", 1: "a1"}, "b": {"x": "bx", 0: "b0"}}


@pytest.mark.parametrize(
    ("suites", "tasks", "expected"),
    [
        (None, None, ["a0", "a1", "bx", "b0"]),
        (["b"], None, ["bx", "b0"]),
        (None, ["0"], ["a0", "b0"]),
        (["b"], ["x"], ["bx"]),
        (["a", "b"], ["1", "x"], ["a1", "bx"]),
    ],
)
def test_selection_keeps_the_order(suites: Any, tasks: Any, expected: list[str]) -> None:
    """Task ids may be numbers or text; on the command line both are text."""
    assert [env for _, _, env in select(SUITES, suites, tasks)] == expected


def test_a_selection_of_nothing_names_what_there_is() -> None:
    """Escaped, since the names are the worker's."""
    with pytest.raises(UsageError, match=r"a/0, .*evil\\x1b/0"):
        select({**SUITES, "evil\x1b": {0: 1}}, ["c"], None)


def test_a_servers_key_reaches_make_env_and_is_none_without_a_word() -> None:
    """For ``--sandbox tcp://...``; ``make_env`` says where it does not belong."""
    given = options(sandbox="tcp://127.0.0.1:5555", server_key="k").arguments()
    assert (given["sandbox"], given["server_key"]) == ("tcp://127.0.0.1:5555", "k")
    assert options().arguments()["server_key"] is None
