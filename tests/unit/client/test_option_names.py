"""Each option once, and each place's own spelling of it."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

import envhub_sandbox
from envhub_sandbox import Limits, Policy, Timeouts, make_env
from envhub_sandbox.cli.app import whole_command
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.settings.options import (
    OPTIONS,
    in_python,
    on_command_line,
    on_lerobots_command_line,
    option_name,
    use_option_names,
)

_COMMANDS = {name for one in OPTIONS.values() for name in one.command.split()}
_ALL = on_command_line(_COMMANDS)
_GROUPS: dict[str, Any] = {"policy": Policy, "limits": Limits, "timeouts": Timeouts}
_ROOT = Path(next(iter(envhub_sandbox.__path__)))


@pytest.mark.parametrize(
    ("key", "value", "python", "command", "lerobot"),
    [
        (
            *("dependencies", {"extra": ["a b"]}, "dependencies={'extra': ['a b']}"),
            """--dependencies '{"extra": ["a b"]}'""",
            """--env.dependencies='{"extra": ["a b"]}'""",
        ),
        ("python", "PATH", "python='PATH'", "--python PATH", "--env.python=PATH"),
        (
            *("profile", "container", "policy={'profile': 'container'}", "--profile container"),
            """--env.policy='{"profile": "container"}'""",
        ),
        (
            *("assets", ["a/b", "c/d"], "assets=['a/b', 'c/d']", "--assets a/b --assets c/d"),
            """--env.assets='["a/b", "c/d"]'""",
        ),
        ("gpu", True, "policy={'gpu': True}", "--gpu", """--env.policy='{"gpu": true}'"""),
        (
            *("startup_s", 600, "timeouts={'startup_s': 600}", "--timeout 600"),
            """--env.timeouts='{"startup_s": 600}'""",
        ),
        (
            *("restart", "on_reset", "policy={'restart': 'on_reset'}"),
            "policy={'restart': 'on_reset'} in Python",
            """--env.policy='{"restart": "on_reset"}'""",
        ),
    ],
)
def test_each_place_has_its_spelling(
    key: str, value: Any, python: str, command: str, lerobot: str
) -> None:
    assert option_name(key, value) == python
    with use_option_names(_ALL):
        assert option_name(key, value) == command
        with use_option_names(on_lerobots_command_line()):
            assert option_name(key, value) == lerobot
        assert option_name(key, value) == command
    with use_option_names(on_command_line({"--seed"})):
        assert option_name(key, value) == f"{python} in Python"
    with use_option_names(on_lerobots_command_line("--sandbox.")):
        assert option_name(key, value) == lerobot.replace("--env.", "--sandbox.")


def test_what_is_wrong_with_an_option_names_it_as_it_was_given() -> None:
    for spelling, said in (
        (in_python, "limits: memory_bytes is 0;"),
        (_ALL, "--memory is 0;"),
        (on_lerobots_command_line(), "--env.limits: memory_bytes is 0;"),
    ):
        with use_option_names(spelling), pytest.raises(PolicyError, match=f"^{re.escape(said)}"):
            Policy(limits=Limits(memory_bytes=0))


def test_the_signature_of_make_env_is_that_of_the_table() -> None:
    """Each argument with its default, each key of one that is a mapping; and no other."""
    signature = inspect.signature(make_env).parameters
    arguments = {key: one.default for key, one in OPTIONS.items() if not one.field}
    assert {key: one.default for key, one in signature.items() if key != "cfg"} == arguments
    for argument, kind in _GROUPS.items():
        known = {one.name for one in dataclasses.fields(kind)} - {"limits"}
        keys = {key for key, one in OPTIONS.items() if one.argument == argument and one.field}
        assert keys == known, argument
    there = {name for one in whole_command("run").params for name in one.opts}
    assert there >= _COMMANDS, "``envhub run`` has all of them"


def test_no_error_has_a_spelling_of_its_own() -> None:
    """No text but the documentation of Python writes an option with a value in the source."""
    names = "|".join({one.argument for one in OPTIONS.values()} - {"copy", "token", "n_envs"})
    written = re.compile(rf"(?<![-\w.])(?:{names})=(?:['\"{{.]|[A-Z]{{2}})|Policy\(|Timeouts\(")
    found = []
    for path in _ROOT.rglob("*.py"):
        if path.name in ("starter.py", "options.py", "inprocess.py", "make_env.py", "app.py"):
            continue
        module = ast.parse(path.read_text())
        docs = {id(one.value) for one in ast.walk(module) if isinstance(one, ast.Expr)}
        found += [
            f"{path.name}:{one.lineno}: {one.value}"
            for one in ast.walk(module)
            if isinstance(one, ast.Constant) and isinstance(one.value, str)
            if id(one) not in docs and written.search(one.value)
        ]
    assert found == []
