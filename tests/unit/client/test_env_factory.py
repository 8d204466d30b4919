"""Environments out of a first jail, or of what is remembered of it; held against each jail."""

import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import LoadError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.builds import wheels
from envhub_sandbox.extras.wheel_builder.entry import mend
from envhub_sandbox.factory.env_factory import EnvFactory
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.session.builder import Builder, JailSource
from envhub_sandbox.session.launcher import Launcher
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.settings.policy import Policy, Timeouts
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.results import Results
from envhub_worker import protocol
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import Manifest, encode_env, encode_manifest
from envhub_worker.protocol.runtime import OWN
from tests.attacks.client.lying_server import (
    ACTION,
    NUM_ENVS,
    LyingSandbox,
    LyingServer,
    env_manifest,
    lying,
)
from tests.support.packages.wheels import make_wheel


@pytest.fixture
def server() -> Iterator[LyingServer]:
    with lying() as found:
        yield found


@pytest.fixture
def launcher(server: LyingServer, tmp_path: Path, snapshot_store: Path) -> Launcher:
    (tmp_path / "repo").mkdir()
    (tmp_path / "repo" / "env.py").write_text("")
    load = m.Load(NUM_ENVS, False, None, {})
    given: Any = (local(tmp_path / "repo"), load, Policy(lane="frames"), Timeouts())
    more: Any = {"recipe": None, "installed": None, "advice": str}
    repository = Repository(*given, OWN, True, **more)
    return Launcher(repository, LyingSandbox(server), snapshot_store)


def suites(launcher: Launcher, agrees: Callable[[Manifest], None] = lambda _: None) -> Any:
    return EnvFactory([launcher], None, 0, agrees).make()


def asked(server: LyingServer, kind: type[m.Message]) -> int:
    return sum(isinstance(one, kind) for one in server.asked)


def says(server: LyingServer, request: type[m.Message], answer: m.Message) -> None:
    server.lies[request] = lambda about: [about.answer(answer)]


def test_the_second_time_no_jail_is_opened(launcher: Launcher, server: LyingServer) -> None:
    """What the first returned is remembered; the first use opens one then, and describes less."""
    with suites(launcher) as first:
        assert first.env.reset()[0].shape == (NUM_ENVS, 3)
        assert asked(server, m.OpenJail) == asked(server, m.Load) == 1
    assert asked(server, m.CloseJail) == 1
    with suites(launcher) as second:
        assert asked(server, m.OpenJail) == 1
        assert second.env.single_action_space == ACTION
        second.env.reset()
        assert (asked(server, m.OpenJail), asked(server, m.Load)) == (2, 1)


def test_other_code_of_the_worker_describes_it_anew(
    launcher: Launcher, server: LyingServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    described = list[int]()
    for name, changed in (("first", 1), ("same", 1), ("other", 2)):
        worker = tmp_path / name
        for module in ("protocol/__init__.py", "runner/manifest.py"):
            (worker / module).parent.mkdir(parents=True)
            (worker / module).touch()
        os.utime(worker / "runner/manifest.py", (changed, changed))
        os.utime(worker / "protocol/__init__.py", (1, 1))
        monkeypatch.setattr(protocol, "__file__", str(worker / "protocol" / "__init__.py"))
        with suites(launcher):
            described.append(asked(server, m.Load))
    assert described == [1, 1, 2]


def test_what_does_not_agree_leaves_no_jail(launcher: Launcher, server: LyingServer) -> None:
    def refuses(manifest: Manifest) -> None:
        raise LoadError(f"{len(manifest.envs)} was not locked")

    for _ in range(2):
        with pytest.raises(LoadError, match="1 was not locked"):
            suites(launcher, refuses)
    assert asked(server, m.OpenJail) == asked(server, m.CloseJail) == 1


@pytest.mark.parametrize("lazy", [True, False])
def test_all_but_lazy_share_a_jail(launcher: Launcher, server: LyingServer, lazy: bool) -> None:
    envs = tuple(env_manifest(task=task) for task in range(2))
    says(server, m.Load, m.LoadDone(encode_manifest(Manifest(envs=envs, lazy=lazy))))
    with suites(launcher) as made:
        assert asked(server, m.CloseJail) == int(lazy)
        for task in range(2):
            made["env"][task].reset()
        assert asked(server, m.OpenJail) == (3 if lazy else 1)
    assert asked(server, m.CloseJail) == asked(server, m.OpenJail)
    with suites(launcher) as again:  # of what is remembered
        again["env"][0].reset()
    plays = [one.play_ms for one in server.asked if isinstance(one, m.Load)]
    assert plays[0] > 0
    assert plays[1:] == ([] if lazy else [0]), "what came of that is remembered as well"


@pytest.mark.parametrize(
    ("changes", "described"),
    [
        ({"num_envs": NUM_ENVS + 1}, False),
        ({"autoreset_mode": "SameStep"}, False),
        ({"task": 7}, True),
        ({"num_envs": NUM_ENVS + 1}, True),
    ],
)
def test_another_environment_is_refused_and_forgotten(
    launcher: Launcher, server: LyingServer, changes: dict[str, Any], described: bool
) -> None:
    other, forgotten = env_manifest(**changes), list[bool]()
    if described:
        manifest = encode_manifest(Manifest(envs=(other,), lazy=True))
        says(server, m.Load, m.LoadDone(manifest))
    else:
        says(server, m.Build, m.BuildDone(encode_env(other)))
    source = JailSource(launcher, lambda: forgotten.append(True))
    builder = Builder(source, Results(env_manifest(), [(0, NUM_ENVS)]))
    loaded = launcher.open(Deadline(60))
    try:
        with pytest.raises(LoadError, match=r"another environment for \('env', 0\)"):
            builder.build(loaded, Deadline(60))
    finally:
        launcher.close(loaded)
    assert forgotten == [True]
    assert asked(server, m.Build) == int(not described)


# --- Metadata of years ago are written as they are read today; nothing else of a wheel is touched


OLD = ("opencv-python (>=3.) ; extra == 'all'", "b (>=1.,<2.)", "c>=4.", "d (==1.*)")
NEW = ("opencv-python (>=3) ; extra == 'all'", "b (>=1,<2)", "c>=4", "d (==1.*)")


def required(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read("x-1.0.dist-info/METADATA").decode()
    return [line[15:] for line in text.splitlines() if line.startswith("Requires-Dist: ")]


def test_versions_that_end_in_a_dot(tmp_path: Path) -> None:
    wheel = make_wheel(tmp_path, "x", requires=OLD)
    mend(wheel)
    assert required(wheel) == list(NEW)
    wheels.check(wheel, "x", "1.0", interpreters.own())
    data = wheel.read_bytes()
    mend(wheel)
    assert wheel.read_bytes() == data, "what is well stays as it is"
