"""The environments that every peer steps. All of them come from ``repositories/``."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

REPOSITORIES = Path(__file__).parent / "repositories"
_BATCHES = 32


@dataclass(frozen=True)
class Workload:
    """One environment repository, and the sizes at which it is measured.

    Attributes:
        name: On the command line and in reports.
        title: For tables.
        sizes: Numbers of sub-environments.
        envpool: Its name in EnvPool, if EnvPool has it.
    """

    name: str
    title: str
    sizes: tuple[int, ...] = (1, 4, 16, 64)
    envpool: str | None = None

    @property
    def folder(self) -> Path:
        """The repository."""
        return REPOSITORIES / self.name


WORKLOADS = {
    workload.name: workload
    for workload in (
        Workload("cartpole", "CartPole", envpool="CartPole-v1"),
        Workload("halfcheetah", "HalfCheetah", envpool="HalfCheetah-v5"),
        Workload("frames", "84x84x4 uint8"),
        Workload("cameras", "2 cameras 480x640x3", sizes=(8,)),
        Workload("busy", "2 ms busy step"),
        Workload("sleeping", "2 ms sleeping step"),
    )
}


@lru_cache
def module(folder: Path) -> ModuleType:
    """A repository's ``env.py``, imported in this process."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{folder.name}", folder / "env.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode = True  # a repository in which bytecode lies is another one
    spec.loader.exec_module(loaded)
    return loaded


def single(name: str) -> Any:
    """One sub-environment of a workload, in this process."""
    workload = WORKLOADS[name]
    return module(workload.folder).single()


def makers(name: str, count: int) -> list[Callable[[], Any]]:
    """Functions that each make one; they can be pickled, into any interpreter."""
    return [partial(single, name)] * count


def action_batches(name: str, count: int) -> list[Any]:
    """The same batches of actions for every peer: arrays ``(count, *action_space.shape)``."""
    env = single(name)
    space = env.action_space
    space.seed(0)
    batches = [np.stack([space.sample() for _ in range(count)]) for _ in range(_BATCHES)]
    env.close()
    return batches
