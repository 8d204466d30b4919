"""The nodes of a real GPU, in a jail that has it and in one that has not: skipped without one."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from envhub_worker.lockdown.gpus import gpu_devices
from envhub_worker.lockdown.root_plan import real_host
from tests.attacks.harness import ANSWER, Arena, control_run

FAMILY = "GPUs"
GRANTED = gpu_devices(real_host())
_NAMES = ("nvidia*", "nvidia-caps*/*", "dri/*", "kfd")

pytestmark = pytest.mark.skipif(not GRANTED, reason="no GPU here, or no driver for it")


def nodes_of_drivers() -> list[str]:
    """Everything that drivers of GPUs have in /dev."""
    found = {str(path) for name in _NAMES for path in Path("/dev").glob(name)}
    return sorted(path for path in found if stat.S_ISCHR(Path(path).stat().st_mode))


@pytest.mark.parametrize("gpu", [[0], False], ids=["granted", "not granted"])
def test_a_jail_opens_what_it_was_given(arena: Arena, gpu: object) -> None:
    """No display, no profiler, no capability of the driver's, and none of all that without one."""
    nodes = nodes_of_drivers()
    with control_run("open_nodes", {"nodes": nodes}) as run:
        outside = {path for path, answer in run.value.items() if answer == "opened"}
    granted = set(GRANTED) if gpu else set()
    assert outside > granted or outside >= set(GRANTED), "the control opens more"
    with arena.inside("open_nodes", {"nodes": nodes}, {"gpu": gpu}) as run:
        assert run.value, run.error
        inside = {path for path, answer in run.value.items() if answer == "opened"}
    assert granted <= inside, run.value
    title = f"with gpu={gpu}, on a real GPU: open another node of its driver"
    arena.judge(title, "succeeds", inside > granted, run.text, judged=ANSWER)
