"""A jail with one GPU reaches for the others, for displays, and for what /sys says of the host.
There is no GPU here. The host is one whose nodes are files, in mounts that only it sees: whose
words come back has been opened. Nothing in the sandbox knows the difference."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from tests.attacks.harness import ANSWER, Arena, token
from tests.attacks.kernel import gpu_host

FAMILY = "GPUs"
GRANTED = ("/dev/nvidia0", "/dev/nvidiactl", "/dev/nvidia-uvm", "/dev/dri/renderD128", "/dev/kfd")
OTHERS = ("/dev/nvidia1", "/dev/dri/renderD129")
UNNEEDED = ("/dev/nvidia-modeset", "/dev/nvidia-uvm-tools", "/dev/dri/card0", "/dev/sda")
OWN, OTHER = "0000:01:00.0", "0000:02:00.0"


def attempt(profile: str) -> tuple[Mapping[str, Any], dict[str, str], str]:
    """What a plain process and a jail with the GPUs 0 and 2 found, the nodes' words, the device."""
    words = {path: token() for path in (*GRANTED, *OTHERS, *UNNEEDED)}
    net = f"eth{token()[:8]}"
    order = {
        "profile": profile,
        "gpu": [0, 2],
        "nodes": words,
        "net": net,
        "gpus": {"renderD128": OWN, "renderD129": OTHER},
    }
    command = [sys.executable, "-m", "tests.attacks.kernel.gpu_host", json.dumps(order)]
    alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads may not change namespaces
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=alone)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1]), words, net


def test_a_jail_has_the_gpus_that_it_was_given(arena: Arena) -> None:
    """Their nodes and their own folders of /sys; no other GPU, and no name of a network device.
    What nobody counts is in the report; and a GPU that is not there is refused with those that are.
    """
    found, words, net = attempt(arena.profile)
    outside, inside = found["outside"], found["inside"]
    assert inside, found["error"]
    assert outside["nodes"] == {
        **words,
        **{f"{gpu_host.PCI}/{one}/vendor": f"vendor of {one}" for one in (OWN, OTHER)},
    }, "the control opens all"
    assert net in outside["folders"]["/sys/class/net"], "the control sees the network"
    assert outside["zeros"] == "mapped", "the control maps zeros"
    for path in GRANTED:
        assert inside["nodes"].get(path) == words[path], f"{path} is not there: {inside['nodes']}"
    for title, paths in (
        ("a GPU that is not granted", OTHERS),
        ("a display, the modes, a profiler, a disk", UNNEEDED),
    ):
        text = json.dumps({path: inside["nodes"].get(path) for path in paths})
        through = any(words[path] in json.dumps(inside) for path in paths)
        arena.judge(f"with gpu=[0]: open {title}", "succeeds", through, text)
    listing = json.dumps(inside["folders"])
    arena.judge("with gpu=[0]: names of network devices in /sys", "succeeds", net in listing, "")
    title = "with gpu=[0]: the folder in /sys of a GPU that is not granted"
    arena.judge(title, "succeeds", f"vendor of {OTHER}" in json.dumps(inside), "")
    title = "with gpu=[0]: map /dev/zero, which is memory in no account"
    arena.judge(title, "succeeds", inside["zeros"] == "mapped", "", judged=ANSWER)
    proc = found["proc"]
    assert isinstance(proc, dict), proc
    assert outside["proc"]["others"], "the control opens what it owns"
    assert proc["named"], "CUDA gives up where it cannot name its threads"
    title = "with gpu=[0]: write into a file of /proc that is the kernel's or another process's"
    arena.judge(title, "succeeds", bool(proc["others"]), json.dumps(proc), judged=ANSWER)
    [memory] = [layer["detail"] for layer in found["report"] if layer["layer"] == "memory"]
    assert "not counted: file locks, memory of the GPU's driver" in memory
    if "measured by" in memory:
        assert "memfds and shared memory that are mapped nowhere" in memory
    assert f"GPU {gpu_host.MISSING}, which does not exist here; these do: 0:" in found["refused"]
