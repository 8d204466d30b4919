"""What ``make_env`` was given is checked before anything is fetched or started."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import HubReferenceError, PolicyError, RepositoryUnavailableError
from envhub_sandbox.factory import arguments
from envhub_sandbox.factory.arguments import plain_config
from envhub_sandbox.hub import snapshot
from envhub_sandbox.settings.options import Options
from envhub_worker.protocol.messages import CONFIG_CLASS
from tests.support import inside
from tests.support.samples import sample

MIB = 1 << 20


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"n_envs": 0}, ValueError, "at least 1"),
        ({"n_envs": 100_000}, ValueError, "at most 65536"),
        ({"n_envs": 4.0}, TypeError, "whole number"),
        ({"use_async_envs": "yes"}, TypeError, "True or False"),
        ({"num_workers": 0}, ValueError, "at least 1"),
        ({"num_workers": 1.5}, TypeError, "whole number"),
        ({"env_kwargs": ["a"]}, TypeError, "mapping"),
        ({"env_kwargs": {1: 2}}, TypeError, "mapping"),
        ({"env_kwargs": {"n_envs": 3}}, TypeError, "separate argument"),
        ({"sandbox": False}, PolicyError, "sandbox is False"),
        ({"python": "no-such-python"}, PolicyError, "not a program"),
        ({"lane": "fast"}, PolicyError, "lane"),
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
    "given",
    [
        *({"policy": {"network": "none"}}, {"limits": {"memory_bytes": MIB}}),
        *({"timeouts": {"step_s": 1}}, {"python": "python3"}, {"num_workers": 2}),
        {"validate": True},
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
    assert arguments.interpreter("python3.12") == "/somewhere/python3.12"
    assert arguments.interpreter("/a/../python3.12") == "/python3.12"
    assert arguments.interpreter(None) == ""


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
    names, fields, computed = made.pop(CONFIG_CLASS)  # type: ignore[misc]
    inner: Any = made.pop("inner")
    assert (made, inner["size"]) == ({"hub_path": "org/repo", "task": "push"}, 3)
    assert inner[CONFIG_CLASS][0][0][1] == type(_Config().inner).__qualname__
    assert (names[0][1], computed) == ("_Config", {"type": "hub"})
    assert fields == ("hub_path", "task", "inner")


def test_a_folder_written_like_a_repository_gets_a_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``examples/cartpole`` is a hub reference; the folder is ``./examples/cartpole``."""

    def missing(*_: object, **__: object) -> None:
        raise HubReferenceError("not found")

    (tmp_path / "examples" / "cartpole").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(snapshot, "fetch", missing)
    with pytest.raises(HubReferenceError, match=r"write '\./examples/cartpole:env\.py'"):
        make_env("examples/cartpole:env.py")
    with pytest.raises(HubReferenceError, match=r"not found$"):
        make_env("examples/other")
