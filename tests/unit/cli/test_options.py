"""Options become arguments of ``make_env``, or a message that says what to write."""

import inspect
from typing import Any

import pytest

from envhub_sandbox.cli.shared.exits import ForeignError, UsageError
from envhub_sandbox.cli.shared.options import (
    ALL,
    MakeOptions,
    read_env_kwargs,
    read_gpu,
    select_envs,
    with_options,
)
from envhub_sandbox.errors import PolicyError, RemoteEnvError
from envhub_sandbox.settings.options import OPTIONS
from envhub_sandbox.settings.policy import policy_from


def options(**given: Any) -> MakeOptions:
    """Options of ``envhub run``, by key; the others as if nothing was typed."""
    return MakeOptions("org/repo", {**{key: OPTIONS[key].default for key in ALL}, **given})


def test_gpus_are_all_or_named_by_number() -> None:
    assert [read_gpu(text) for text in (None, "all", "0", "0,2")] == [None, True, [0], [0, 2]]
    for text in ("", "true", "-1", "0,", "0 1"):
        with pytest.raises(UsageError, match="it takes all, or indices"):
            read_gpu(text)


def test_every_option_of_a_command_reaches_make_env() -> None:
    """Under its key, and under no other; ``--timeout`` is four of them."""
    made: list[MakeOptions] = []

    @with_options(*ALL)
    def probe(*, ref: str, make: MakeOptions) -> None:
        made.append(make)

    names = set(inspect.signature(probe).parameters)
    probe(**{**{name: f"<{name}>" for name in names}, "debug": False})
    given = {key: f"<{OPTIONS[key].parameter}>" for key in ALL}
    assert made == [MakeOptions("<ref>", given)]
    assert names == {*(OPTIONS[key].parameter for key in ALL), "ref", "debug"}
    assert given["step_s"] == given["startup_s"] == "<timeout>"


def test_env_kwargs_take_json_and_pairs() -> None:
    pairs = ("size=9", "mode=rgb_array", "on=true", "path=a=b", "empty=")
    merged = {"size": 9, "name": "a", "mode": "rgb_array", "on": True, "path": "a=b", "empty": ""}
    assert read_env_kwargs(['{"size": 8, "name": "a"}', *pairs]) == merged
    for text in ("size", "=3", "a b=3", "{", '{"a": }', "[1]"):
        with pytest.raises(UsageError, match="--env-kwargs"):
            read_env_kwargs([text])


def test_only_what_was_given_reaches_the_policy() -> None:
    """Defaults stay the library's; a limit of nothing is refused, and not taken for one."""
    nothing = options().arguments()
    assert (nothing["policy"], nothing["timeouts"]) == ({}, {})
    granted: dict[str, Any] = {"network": "loopback", "readable": ["/data"], "environment": ["A"]}
    limits: dict[str, Any] = {"memory_bytes": "1G", "cpu_time_s": 5}
    given = options(gpu="all", sandbox="tcp://127.0.0.1:5555 k", **granted, **limits)
    assert given.arguments()["policy"] == {**granted, "gpu": True, "limits": limits}
    assert given.arguments()["sandbox"] == "tcp://127.0.0.1:5555 k"
    read = options(env_kwargs=["size=8"], dependencies='{"python": "3.12"}', output="-").arguments()
    assert (read["env_kwargs"], read["dependencies"]) == ({"size": 8}, {"python": "3.12"})
    assert (read["cfg"], "output" in read["policy"]) == ("org/repo", False)
    zeros = {"memory_bytes": "0", "disk_bytes": "0", "processes": 0, "cpu_time_s": 0}
    for name, zero in zeros.items():
        with pytest.raises(PolicyError, match="is 0; it takes a whole number"):
            policy_from(options(**{name: zero}).arguments()["policy"], None)


def test_a_timeout_is_for_every_operation_but_close() -> None:
    keys = {key for key in ALL if OPTIONS[key].command == "--timeout"}
    assert keys == {"startup_s", "reset_s", "step_s", "call_s"}
    given = dict.fromkeys(keys, 7.5)
    assert options(**given).arguments()["timeouts"] == given


def test_running_unprotected_needs_the_word() -> None:
    with pytest.raises(UsageError, match="--trust-remote-code"):
        options(sandbox="none").arguments()
    assert options(sandbox="none", trust_remote_code=True).arguments()["sandbox"] is None


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
    assert [env for _, _, env in select_envs(SUITES, suites, tasks)] == expected
    with pytest.raises(UsageError, match=r"a/0, .*evil\\x1b/0"):  # with what there is, escaped
        select_envs({**SUITES, "evil\x1b": {0: 1}}, ["c"], None)


def test_an_option_is_named_as_its_key_is_in_python() -> None:
    """Without the unit; several time limits share one, and --output is a command's own."""
    named = {key: one for key, one in OPTIONS.items() if one.field and one.command}
    others = {key for key, one in named.items() if one.argument == "timeouts"} | {"output"}
    for key in named.keys() - others:
        name = key.removesuffix("_bytes").removesuffix("_s").replace("_", "-")
        assert named[key].command == f"--{name}"
