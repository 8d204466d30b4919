"""A host with GPUs that are none: ``python -m tests.attacks.kernel.gpu_host``, in its own mounts.
argv: one JSON object: ``profile``, ``gpu``, and ``nodes`` (a path in /dev to what is read there),
``net`` (the name of a network device) and ``gpus`` (a render node's name to a PCI address). Runs
``reach_devices`` once in a plain process and once in a jail, and prints one line of JSON with what
came of both: ``outside``, ``inside``, ``report``, ``mounts`` of the jail's process and ``refused``,
what is said of a GPU that there is not."""

import json
import os
import sys
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_worker.lockdown.mechanisms import kernel
from tests.attacks.harness import Arena, control_run

PCI = "/sys/devices/pci0000:00"
_ORDINARY = ("null", "zero", "full", "random", "urandom", "shm", "tty", "ptmx", "pts", "fd")
FOLDERS = ("/sys/class/net", "/sys/devices", PCI, "/sys/bus/pci/devices", "/sys/class/drm", "/dev")
MISSING = 9


def enter() -> None:
    """Mounts that nobody else sees; as a plain user in a user namespace, as that user."""
    uid, gid = os.getuid(), os.getgid()
    if uid:
        kernel.unshare(kernel.CLONE_NEWUSER | kernel.CLONE_NEWNS)
        itself = {"setgroups": "deny", "uid_map": f"{uid} {uid} 1", "gid_map": f"{gid} {gid} 1"}
        for name, text in itself.items():
            Path(f"/proc/self/{name}").write_text(text)
    else:
        kernel.unshare(kernel.CLONE_NEWNS)
    kernel.mount("none", "/", "none", kernel.MS_REC | kernel.MS_PRIVATE)


def build(order: dict[str, Any]) -> None:
    """/dev with the stand-ins: files, whose words say that they were opened; and /sys for them."""
    kept = {f"/dev/{name}" for name in _ORDINARY if os.path.lexists(f"/dev/{name}")}
    kept |= {"/sys/devices/system", "/sys/fs"}
    links = {path: os.readlink(path) for path in kept if os.path.islink(path)}
    trees = {path: kernel.clone_tree(path) for path in kept - set(links)}
    for place in ("/dev", "/sys"):
        kernel.mount("stand-ins", place, "tmpfs", 0, "mode=755")
    for path, tree in trees.items():
        if os.path.isdir(f"/proc/self/fd/{tree}"):
            os.makedirs(path)
        else:
            Path(path).touch()
        kernel.attach_tree(tree, path)
        os.close(tree)
    for path, target in links.items():
        os.symlink(target, path)
    for path, text in order["nodes"].items():
        _write(path, text).chmod(0o666)
    for number, (name, address) in enumerate(order["gpus"].items()):
        _write(f"{PCI}/{address}/drm/{name}/dev", f"226:{number}\n")
        _write(f"{PCI}/{address}/vendor", f"vendor of {address}")
        _link(f"/sys/class/drm/{name}", f"{PCI}/{address}/drm/{name}")
        _link(f"/sys/dev/char/226:{number}", f"{PCI}/{address}/drm/{name}")
        _link(f"/sys/bus/pci/devices/{address}", f"{PCI}/{address}")
    _write(f"/sys/devices/virtual/net/{order['net']}/address", "02:00:00:00:00:01\n")
    _link(f"/sys/class/net/{order['net']}", f"/sys/devices/virtual/net/{order['net']}")


def _write(path: str, text: str) -> Path:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)
    return Path(path)


def _link(path: str, target: str) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    os.symlink(target, path)


def main(order: dict[str, Any]) -> int:
    enter()
    build(order)
    nodes = [*order["nodes"], *(f"{PCI}/{address}/vendor" for address in order["gpus"].values())]
    arguments = {"nodes": nodes, "folders": list(FOLDERS)}
    found: dict[str, Any] = {}
    with control_run("reach_devices", arguments) as run:
        found["outside"] = run.value
    with control_run("write_proc", {}) as run:
        found["outside"]["proc"] = run.value
    arena = Arena(order["profile"], "GPUs")
    with arena.inside("write_proc", {}, {"gpu": order["gpu"]}) as run:
        found["proc"] = run.value or run.error
    with arena.inside("reach_devices", arguments, {"gpu": order["gpu"]}) as run:
        found |= {"inside": run.value, "error": run.error, "report": arena.report}
    try:
        with arena.environment({"gpu": [MISSING]}) as env:
            env.reset()
    except SandboxUnavailableError as error:
        found["refused"] = str(error)
    print("\n" + json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
