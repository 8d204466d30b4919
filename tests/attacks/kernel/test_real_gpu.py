"""A real GPU, in jails that have it and in one that has not: skipped without one."""

import contextlib
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_worker.lockdown.gpus import gpu_devices
from envhub_worker.lockdown.root_plan import real_host
from tests.attacks.harness import ANSWER, HOSTILE, Arena, control_run, token

FAMILY = "GPUs"
GRANTED = gpu_devices(real_host())
_NAMES = ("nvidia*", "nvidia-caps*/*", "dri/*", "kfd")
pytestmark = pytest.mark.skipif(not GRANTED, reason="no GPU here, or no driver for it")
nvidias = pytest.mark.skipif("/dev/nvidia0" not in GRANTED, reason="no GPU of NVIDIA's here")


def nodes_of_drivers() -> list[str]:
    found = {str(path) for name in _NAMES for path in Path("/dev").glob(name)}
    return sorted(path for path in found if stat.S_ISCHR(Path(path).stat().st_mode))


@contextlib.contextmanager
def offered(text: str) -> Iterator[str]:
    command = [sys.executable, str(HOSTILE / "payloads" / "use_card.py"), text]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        yield process.stdout.readline().decode().strip()
        process.kill()


@pytest.mark.parametrize("gpu", [[0], False], ids=["granted", "not granted"])
def test_a_jail_opens_what_it_was_given(arena: Arena, gpu: object) -> None:
    """No display, no profiler, no capability of the driver's, and none of all that without one."""
    nodes = nodes_of_drivers()
    with control_run("open_nodes", {"nodes": nodes}) as run:
        outside = {path for path, answer in run.value.items() if answer == "opened"}
    granted = set(GRANTED) if gpu else set()
    assert outside >= set(GRANTED), "the control opens what it may"
    with arena.inside("open_nodes", {"nodes": nodes}, {"gpu": gpu}) as run:
        assert run.value, run.error
        inside = {path for path, answer in run.value.items() if answer == "opened"}
    assert granted <= inside, run.value
    title = f"with gpu={gpu}, on a real one: open another node of its driver"
    arena.judge(title, "succeeds", inside > granted, run.text, judged=ANSWER)


@nvidias
def test_cuda_starts_where_it_was_granted(strict: Arena) -> None:
    """There only. Memory that a process has offered on the card is everybody's who has the card."""
    secret = token()
    with offered(secret) as handle:
        arguments = {"handle": handle, "size": len(secret)}
        with control_run("use_card", arguments) as run:
            assert run.value, run.text
            assert run.value["read"] == secret, run.text
            name = run.value["name"]
        with strict.inside("use_card", arguments, {"gpu": [0]}) as run:
            assert run.value, run.text
            assert run.value["name"] == name, run.text
            title = "with gpu, on a real one: read what another process offers on it, by its handle"
            strict.judge(title, "succeeds", secret in run.text, run.text)
    with strict.inside("use_card", {}) as run:
        title = "on a real GPU: use it without a grant"
        strict.judge(title, "succeeds", name in run.text, run.text, judged=ANSWER)
