"""A repository's own packages: nothing of them runs outside of a jail, whatever they are called.
The control uses the same folder as anybody would: a virtual environment, or ``PYTHONPATH``."""

from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_worker.protocol.runtime import Runtime
from tests.attacks.harness import Arena, token
from tests.attacks.packages import trapped_packages as traps
from tests.attacks.processes.neighbour import Pair, neighbour
from tests.attacks.processes.victim import READS, victim
from tests.support.packages.environments import base_interpreter, install, running_on
from tests.support.repositories import write_repository

FAMILY = "Packages of the repository's own"
REPOSITORY = """
import os, sys
import gymnasium as gym

class Seen(gym.Env):
    observation_space = gym.spaces.Discrete(1)
    action_space = gym.spaces.Discrete(1)
    def reset(self, seed=None, options=None):
        return 0, {}
    def seen(self):
        import ctypes, encodings, json, envhub_worker, msgpack, numpy
        here = os.getpid()
        trapped = getattr(sys, "trapped", [])
        return [gym.__version__, *(name if pid == here else "elsewhere" for name, pid in trapped)]

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Seen] * n_envs)
"""


@pytest.fixture
def place(home: Path) -> Path:
    """Where packages lie, that every user may read."""
    folder = home / "packages"
    folder.mkdir()
    folder.chmod(0o755)
    return folder


def seen_in_a_jail(arena: Arena, repository: Path, runtime: Runtime) -> list[str]:
    """Gymnasium's version, and the traps that ran in the very process of the repository's code."""
    write_repository(repository, REPOSITORY)
    with running_on(runtime), make_env(str(repository), **arena.place({})) as suites:
        suites.env.reset()
        [found] = suites.env.call("seen")
        return list(found)


def test_nothing_of_a_package_runs_outside_of_its_jail(strict: Arena, place: Path) -> None:
    """Not at the start of an interpreter, and not in the place of what the worker imports."""
    home, folder = place.parent, place / "trapped"
    traps.real_packages(folder)
    traps.set_traps(folder, home)
    traps.use_unprotected(folder, place / "control")
    ran = [name for name in traps.TRAPS if traps.canary(home, name).exists()]
    assert ran == list(traps.TRAPS), "a control failed"
    for name in traps.TRAPS:
        traps.canary(home, name).unlink()
    found = seen_in_a_jail(strict, place / "repository", Runtime(base_interpreter(), str(folder)))
    # in the jail they are what they claim to be, but for the names of what was there before
    expected = {"a .pth file", "its own msgpack", "its own numpy"}
    assert set(found[1:]) == expected
    for name in traps.TRAPS:
        through = traps.canary(home, name).exists()
        strict.judge(f"run before there is a jail: {name}", "succeeds", through, "")


def test_plugins_of_gymnasium_run_in_the_jail_only(strict: Arena, place: Path) -> None:
    """Gymnasium 0.29 imports every entry point ``gymnasium.envs`` when it is imported itself."""
    home, folder, name = place.parent, place / "old", "an entry point gymnasium.envs"
    runtime = install(folder, "gymnasium==0.29.1", "numpy==1.26.4")
    (folder / "plugin.py").write_text(traps.trap(home, name) + "def register(): pass\n")
    (folder / "plugin-1.0.dist-info").mkdir()
    entry = "[gymnasium.envs]\n__root__ = plugin:register\n"
    (folder / "plugin-1.0.dist-info/entry_points.txt").write_text(entry)
    (folder / "plugin-1.0.dist-info/METADATA").write_text("Name: plugin\nVersion: 1.0\n")
    traps.use_unprotected(folder, place / "control")
    assert traps.canary(home, name).exists(), "the control failed"
    traps.canary(home, name).unlink()
    assert seen_in_a_jail(strict, place / "repository", runtime) == ["0.29.1", name]
    through = traps.canary(home, name).exists()
    strict.judge(f"run before there is a jail: {name}", "succeeds", through, "")


def test_a_jail_of_another_environment_is_out_of_reach(arena: Arena, place: Path) -> None:
    """Two environments in one client have a zygote each, and nothing in common."""
    runtimes = []
    for name in ("one", "other"):
        traps.real_packages(place / name)
        runtimes.append(Runtime(base_interpreter(), str(place / name)))
    with (
        victim(token()) as target,
        running_on(runtimes[1]),
        neighbour(arena, target.secret) as other,
        running_on(runtimes[0]),
    ):
        pair = Pair(target, other)
        for way in ("kill", "pidfd"):
            title = f"signal a jail of another environment: {way}"
            pair.signal(arena, title, way=way, **pair.at("pid"))
        payload, names = READS["process_vm_readv"]
        title = "read a jail of another environment: process_vm_readv"
        arena.steal(title, payload, pair.secret, **pair.at(*names))
