"""What ``make_env`` was given is checked before anything is fetched or started."""

import ast
import dataclasses
import inspect
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import Limits, Policy, Timeouts, make_env
from envhub_sandbox.cli.app import whole_command
from envhub_sandbox.errors import PolicyError, RepositoryUnavailableError, SandboxUnavailableError
from envhub_sandbox.factory.make_env import interpreter, sandbox_of
from envhub_sandbox.session.repository import plain_config
from envhub_sandbox.settings.options import (
    OPTIONS,
    Options,
    in_python,
    on_command_line,
    on_lerobots_command_line,
    option_name,
    use_option_names,
)
from envhub_worker.protocol.messages import CONFIG_CLASS
from tests.support import inside
from tests.support.samples import sample
from tests.unit.docs.test_imports import modules

MIB = 1 << 20


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"n_envs": 0}, ValueError, "at least 1"),
        ({"n_envs": 100_000}, ValueError, "at most 65536"),
        ({"n_envs": 4.0}, TypeError, "whole number"),
        *(
            ({name: "no"}, TypeError, f"`{name}` is 'no'; it is True or False")
            for name in ("use_async_envs", "trust_remote_code", "allow_secrets", "copy")
        ),
        *(
            ({name: 3.12}, TypeError, f"`{name}` is 3.12; it takes a path")
            for name in ("python", "lock", "hub_cache_dir")
        ),
        ({"num_workers": 0}, ValueError, "at least 1"),
        ({"num_workers": 1.5}, TypeError, "whole number"),
        ({"env_kwargs": ["a"]}, TypeError, "mapping"),
        ({"env_kwargs": {1: 2}}, TypeError, "mapping"),
        ({"env_kwargs": {"n_envs": 3}}, TypeError, "separate argument"),
        *(
            ({"sandbox": name}, PolicyError, f"sandbox is {name!r}")
            for name in (False, "vm", "file:/none", "dns://host:5555")
        ),
        ({"python": "3.12"}, PolicyError, r"not a program.* dependencies=\{'python': '3.12'\}"),
        ({"policy": {"lane": "fast"}}, PolicyError, "lane"),
        ({"lane": "frames"}, TypeError, r"policy=\{'lane': ...\}"),
        ({"server_key": "KEY"}, TypeError, "sandbox='tcp://HOST:PORT KEY'"),
        ({"n_env": 2}, TypeError, "did you mean 'n_envs'"),
        ({"cfg": SimpleNamespace(hub_path=None)}, TypeError, "hub_path is None"),
        ({"cfg": SimpleNamespace()}, TypeError, "an object with a hub_path"),
        ({"cfg": "./README.md"}, RepositoryUnavailableError, "a .py file"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused(
    given: dict[str, Any],
    error: type[Exception],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "README.md").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(*inside.MAKER, None)
    with pytest.raises(error, match=words):
        make_env(**{"cfg": sample("cartpole"), **given})


@pytest.mark.parametrize(
    ("sandbox", "extra"),
    [("docker:python", "docker"), ("ray", "ray"), ("tcp://a:1", "remote"), (["process"], "fleet")],
)
def test_what_is_absent_is_named(sandbox: Any, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the package was installed without its module; with it, there is such a place."""
    lacking = f"envhub_sandbox.extras.{extra}"
    for name in [name for name in sys.modules if name.startswith(f"{lacking}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, lacking, None)
    with pytest.raises(
        SandboxUnavailableError, match=rf"sandbox needs {lacking}.*, which .*'process'"
    ):
        make_env(sample("cartpole"), sandbox=sandbox)
    monkeypatch.undo()
    assert sandbox_of(sandbox).name


@pytest.mark.parametrize(
    "given",
    [
        *({"policy": {"network": "none"}}, {"limits": {"memory_bytes": MIB}}),
        *({"timeouts": {"step_s": 1}}, {"python": "python3"}, {"num_workers": 2}),
    ],
    ids=lambda given: next(iter(given)),
)
def test_without_a_sandbox_nothing_pretends_to_protect(given: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match=f"^{next(iter(given))}: for environments in a sandbox"):
        make_env(sample("cartpole"), sandbox=None, trust_remote_code=True, **given)


def test_what_is_given_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numpy's numbers are numbers; a name is looked up as a shell does, and a path is a path."""
    given: Any = {"n_envs": np.int64(4), "use_async_envs": np.True_, "num_workers": np.int8(2)}
    made = Options(**given).checked()
    assert (made.n_envs, made.use_async_envs, made.num_workers) == (4, True, 2)
    assert [type(one) for one in (made.n_envs, made.use_async_envs)] == [int, bool]
    monkeypatch.setattr("shutil.which", lambda name: f"/somewhere/{name}")
    assert interpreter("python3.12") == "/somewhere/python3.12"
    assert interpreter("/a/../python3.12") == "/python3.12"
    assert interpreter(None) == ""


@dataclass
class _Config:
    hub_path: str = "org/repo"
    task: str = "push"
    inner: Any = field(default_factory=lambda: SimpleNamespace(size=3))

    @property
    def type(self) -> str:
        return "hub"

    @property
    def broken(self) -> str:
        raise RuntimeError

    @property
    def _hidden(self) -> str:
        return "no"


def test_properties_of_a_config_cross() -> None:
    """A repository that reads ``cfg.type`` works here as it does in LeRobot."""
    made = plain_config(_Config())
    names, fields, computed = made.pop(CONFIG_CLASS)
    inner: Any = made.pop("inner")
    assert (made, inner["size"]) == ({"hub_path": "org/repo", "task": "push"}, 3)
    assert inner[CONFIG_CLASS][0][0][1] == type(_Config().inner).__qualname__
    assert (names[0][1], computed) == ("_Config", {"type": "hub"})
    assert fields == ("hub_path", "task", "inner")


# --- Each option once, and each place's own spelling of it


_COMMANDS = {name for one in OPTIONS.values() for name in one.command.split()}
_ALL = on_command_line(_COMMANDS)
_GROUPS: dict[str, Any] = {"policy": Policy, "limits": Limits, "timeouts": Timeouts}


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
def test_spelling_of_places(key: str, value: Any, python: str, command: str, lerobot: str) -> None:
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
    """Each argument with its default, each key of one that is a mapping; at most twenty."""
    signature = inspect.signature(make_env).parameters
    assert len(signature) <= 20
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
    ours = ("init", "options", "inprocess", "make_env", "app")
    for name, module in modules().items():
        if name.startswith("envhub_worker") or name.endswith(tuple(f".{one}" for one in ours)):
            continue
        docs = {id(one.value) for one in ast.walk(module) if isinstance(one, ast.Expr)}
        found += [
            f"{name}:{one.lineno}: {one.value}"
            for one in ast.walk(module)
            if isinstance(one, ast.Constant) and isinstance(one.value, str)
            if id(one) not in docs and written.search(one.value)
        ]
    assert found == []
