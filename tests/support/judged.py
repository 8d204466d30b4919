"""What ``envhub check`` says of the hostile payloads and of the samples, as it has to.

``python -m tests.support.judged [NAME ...]`` gives each to it, one after the other
(minutes), prints what is told, and ends with 1 where that is not what stands here. A few are in
the tests.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.findings import Finding
from envhub_sandbox.check.judge import judge
from envhub_sandbox.check.settings import JudgeOptions
from tests.support.samples import SAMPLES, sample

HOSTILE = SAMPLES.parent / "attacks" / "hostile"
PAYLOADS = HOSTILE / "payloads"
KINDS = {
    name: path.name
    for path in PAYLOADS.glob("*.py")
    if path.stem not in ("kernel", "running", "use_card")
    for name in re.findall(r"^def ([a-z]\w*)", path.read_text(), re.MULTILINE)
}
"""The file of each payload."""
NO_ATTACKS = {"be_victim", "plant", "terminals", "where_am_i"}
_TIMEOUTS = dict.fromkeys(("call_s", "reset_s", "step_s"), 30.0)
_MIB = 1 << 20
_CLIENT = {"pid": os.getpid()}
_MEMORY = {**_CLIENT, "address": 4096}
_OUTSIDE = {"path": "/home/other/file"}
_KEY = {"path": "/home/other/.ssh/id_rsa"}
_TEXT = {"text": "x"}
_WORD = {"message": "x"}
_NAMED = {"alias": "judged"}
_PORT = {"host": "127.0.0.1", "port": 9, **_WORD}
_LOG = {"path": "/dev/log", **_WORD}
_LIBRARIES = "libraries try it too, on their way"
_OWN = "it harms nobody but itself"


@dataclass(frozen=True)
class Attack:
    """A payload, and what has to be told of it.

    Attributes:
        check: The check that names it; empty where none does.
        words: What stands in that finding.
        arguments: Of the payload.
        limits: Which the jail has.
        unseen: Why the layers tell nothing of it, where they do not.
        stage: Where it runs: in each step, or in each reset.
    """

    check: str = ""
    words: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Any] = field(default_factory=dict)
    unseen: str = ""
    stage: str = "step"


_FILES, _KERNEL, _NETWORK = "denied-files", "denied-kernel", "denied-network"
_LIMITS = "limits-reached"
ATTACKS = {
    "answers": Attack(_KERNEL, "tried kcmp", {"calls": {"bpf": [0, 0, 0], "kcmp": [0, 0, 0]}}),
    "change_attribute": Attack(_FILES, "setxattr /home/other/file", _OUTSIDE),
    "change_tree": Attack(_FILES, "/home/other/", {"place": "/home/other"}),
    "change_mode": Attack(_FILES, "chmod /home/other/file", _OUTSIDE),
    "change_owner": Attack(_FILES, "chown /home/other/file", {**_OUTSIDE, "gid": 0}),
    "change_times": Attack(_FILES, "utimensat /home/other/file", _OUTSIDE),
    "chroot": Attack(_KERNEL, "tried chroot", _NAMED),
    "clone_with_namespace": Attack(_KERNEL, "tried clone", {**_NAMED, "way": "clone"}),
    "command_lines_of_others": Attack(_FILES, "read /proc/", _CLIENT),
    "create_file": Attack(_FILES, "write /home/other/file", {**_OUTSIDE, **_TEXT}),
    "daemon": Attack("leaks-processes", "processes after each", _NAMED, stage="reset"),
    "delete_file": Attack(_FILES, "unlink /home/other/file", _OUTSIDE),
    "dns": Attack(_NETWORK, "tried socket AF_INET", _PORT),
    "docker_api": Attack(_FILES, "connect to /var/run/docker", {"path": "/var/run/docker.sock"}),
    "enter_namespaces": Attack(_KERNEL, "tried pidfd_open of", {**_NAMED, **_CLIENT}),
    "environment": Attack("source-outside", "", unseen="it may read its own, which we make"),
    "environment_of_others": Attack(_FILES, "read /proc/1/environ", _CLIENT),
    "fill_disk": Attack(
        _LIMITS, "disk_bytes", {"folders": [], "size": 1 << 30}, {"disk_bytes": 64 * _MIB}
    ),
    "fill_inodes": Attack(
        _LIMITS, "disk_files", {"folders": [], "count": 9999}, {"disk_files": 2000}
    ),
    "device_events": Attack(unseen="the kernel sends a jail none"),
    "flood": Attack("", "", {"size": 4 * _MIB}, unseen=_OWN),
    "foreign_abi": Attack("survives", "SIGSYS", {**_NAMED, "abi": "i386"}),
    "fork_bomb": Attack(_LIMITS, "processes", {"count": 200}, {"processes": 64}),
    "garbage_on_streams": Attack("survives", "", {"data": "ff"}),
    "grandchildren": Attack("source-process", "", {**_NAMED, "seconds": 1}, unseen=_OWN),
    "hold_file": Attack(_KERNEL, "tried fcntl", {"path": "/etc/passwd", "way": "lease"}),
    "inherited_descriptors": Attack(unseen="there are none but its own"),
    "ioprio_set": Attack(_KERNEL, "tried ioprio_set of", {**_CLIENT, "priority": 0}),
    "kernel_log_device": Attack(_KERNEL, "tried mknodat"),
    "kernel_object": Attack(_KERNEL, "tried bpf", {"kind": "bpf"}),
    "keyring": Attack(_KERNEL, "tried keyctl", {"name": "x"}),
    "large_pipe": Attack(_KERNEL, "tried fcntl", {"size": _MIB}),
    "leaderless": Attack("leaks-processes", "processes after each", _NAMED, stage="reset"),
    "list_folder": Attack(_FILES, "read /root", {"path": "/root"}),
    "listen": Attack(_NETWORK, "tried socket AF_INET", {"port": 4711, **_WORD}),
    "memory_bomb": Attack("survives", "out of memory", {"kind": "heap", "size": 1 << 31}),
    "mount_tmpfs": Attack(_KERNEL, "tried mount", {**_NAMED, "source": "none"}),
    "mptcp": Attack(_NETWORK, "tried socket AF_INET", _PORT),
    "netlink_message": Attack(_NETWORK, "tried socket AF_NETLINK", {"port": os.getpid(), **_WORD}),
    "netlink_routes": Attack("source-network", "", unseen=_LIBRARIES),
    "network_table": Attack("source-outside", "", {"name": "tcp"}, unseen="it sees its own"),
    "oom_score": Attack(_FILES, "oom_score_adj", {**_CLIENT, "score": 900}),
    "open_nodes": Attack(_FILES, "write /dev/nvidia0", {"nodes": ["/dev/nvidia0"]}),
    "own_memory": Attack("source-outside", "", {"prefix": "x"}, unseen="it may read its own"),
    "packet": Attack(_NETWORK, "tried socket AF_PACKET", {"device": "lo", **_WORD}),
    "pidfd_getfd": Attack(_KERNEL, "tried pidfd_open of", {**_CLIENT, "fd": 0}),
    "pivot_root": Attack(_KERNEL, "tried unshare", _NAMED),
    "prlimit": Attack(_KERNEL, "tried prlimit64", {**_CLIENT, "files": 1}),
    "proc_fd": Attack(_FILES, "read /proc/", {**_CLIENT, "fd": 0}),
    "proc_maps": Attack(_FILES, "/maps", _CLIENT),
    "proc_mem_read": Attack(_FILES, "/mem", {**_MEMORY, "size": 8}),
    "proc_mem_write": Attack(_FILES, "write /proc/", {**_MEMORY, **_WORD}),
    "process_vm_read": Attack(_KERNEL, "tried process_vm_readv", {**_MEMORY, "size": 8}),
    "process_vm_write": Attack(_KERNEL, "tried process_vm_writev", {**_MEMORY, **_WORD}),
    "ptrace_poke": Attack(_KERNEL, "tried ptrace", {**_MEMORY, "word": 1}),
    "raid": Attack(_FILES, "write /home/other/file", {"paths": ["/home/other/file"], **_TEXT}),
    "raw_icmp": Attack(_NETWORK, "tried socket AF_INET", {"host": "127.0.0.1", **_WORD}),
    "reach_below": Attack(_FILES, "/proc/", {"folder": "/tmp", "name": "x"}),
    "reach_devices": Attack(
        _FILES, "write /dev/nvidia0", {"nodes": ["/dev/nvidia0"], "folders": ["/sys/class/net"]}
    ),
    "read_by_handle": Attack(
        _KERNEL, "tried open_by_handle_at", {"handle": "00" * 8, "kind": 1, "mounts": ["."]}
    ),
    "read_file": Attack(_FILES, "read /home/other/.ssh/id_rsa", _KEY),
    "read_through_hard_link": Attack(_FILES, "link /home/other", {**_KEY, "folders": ["/tmp"]}),
    "read_through_proc": Attack(_FILES, "read /home/other/.ssh/id_rsa", _KEY),
    "read_through_symlink": Attack(_FILES, "read /home/other/.ssh/id_rsa", _KEY),
    "redirect": Attack(_FILES, "read /home/other/.ssh/id_rsa", {"folder": "/tmp", **_KEY}),
    "remount_root": Attack(_KERNEL, "tried unshare", _NAMED),
    "rename_file": Attack(_FILES, "rename /home/other/file", _OUTSIDE),
    "sched_setaffinity": Attack(_KERNEL, "sched_setaffinity of", {**_CLIENT, "cpus": [0]}),
    "sched_setscheduler": Attack(_KERNEL, "tried sched_setscheduler of", _CLIENT),
    "send_descriptor": Attack(_FILES, "connect to", {"name": "x", "path": "/etc/passwd"}),
    "setpriority": Attack(_KERNEL, "tried setpriority of", {**_CLIENT, "nice": 5}),
    "setuid_program": Attack(
        "source-process",
        "",
        {"command": ["/bin/true"], "uid": None},
        unseen="programs may be run, and gain nothing",
    ),
    "signal_all": Attack(_KERNEL, "tried kill of"),
    "signal_one": Attack(_KERNEL, "tried kill of", {**_CLIENT, "way": "kill"}),
    "socket_of_family": Attack(
        _NETWORK, "tried socket AF_ALG", {"family": 38, "kind": 5, "protocol": 0}
    ),
    "spin": Attack("survives", "step", {"seconds": 60}),
    "stack_filters": Attack(_KERNEL, "tried prctl", {"way": "prctl"}),
    "stat_file": Attack("runs", "No such file", _OUTSIDE, unseen="who only looks is not seen"),
    "stop_processes": Attack(_KERNEL, "tried kill of", {"pids": [os.getpid()], "own": False}),
    "tcp": Attack(_NETWORK, "tried socket AF_INET", _PORT),
    "tcp_fast_open": Attack(_NETWORK, "tried socket AF_INET", _PORT),
    "thread_bomb": Attack(_LIMITS, "processes", {"count": 500}, {"processes": 64}),
    "type_into_terminal": Attack(_KERNEL, "tried ioctl", _TEXT),
    "udp": Attack(_NETWORK, "tried socket AF_INET", _PORT),
    "unix_datagram": Attack(_FILES, "send to /dev/log", _LOG),
    "unix_datagram_of_a_pair": Attack(_FILES, "send to /dev/log", _LOG),
    "unix_stream": Attack(_FILES, "connect to /var/run/x", {"path": "/var/run/x", **_WORD}),
    "use_up": Attack(_LIMITS, "open_files", {"kind": "pages of pipes", "name": "x"}),
    "user_namespace": Attack(_KERNEL, "tried unshare", _NAMED),
    "vsock": Attack(_NETWORK, "tried socket AF_VSOCK", {"cid": 2, "port": 9, **_WORD}),
    "watch_folder": Attack(
        "source-native",
        "",
        {"folder": "/etc", "way": "inotify", "seconds": 1},
        unseen="there is no such call",
    ),
    "write_file": Attack(_FILES, "truncate /home/other/file", {**_OUTSIDE, **_TEXT}),
    "write_proc": Attack(_FILES, "write /proc/"),
    "write_to_terminal": Attack(_FILES, "write /dev/tty", {**_TEXT, "ways": ["/dev/tty"]}),
}


def told_of(payload: str, attack: Attack) -> list[Finding]:
    """What is found where a payload runs; of what is read in source, what is in its file."""
    order = {"name": payload, "arguments": dict(attack.arguments), "alias": "judged"}
    arguments = {
        "n_envs": 1,
        "env_kwargs": {"order": {"stage": attack.stage, "attack": order}},
        "limits": {"memory_bytes": 1024 * _MIB, **attack.limits},
        "timeouts": _TIMEOUTS,
    }
    resets = 2 if attack.stage == "reset" else 0
    asked = JudgeOptions(reference=str(HOSTILE), arguments=arguments, steps=1, resets=resets)
    return [one for one in judge(asked).findings if one.file in ("", f"payloads/{KINDS[payload]}")]


def is_told(found: list[Finding], attack: Attack) -> bool:
    """Whether the check names it, or nothing of the layers does where nothing can."""
    if not attack.check:
        return not any(one.id.startswith(("denied-", "limits-")) for one in found)
    return any(one.id == attack.check and attack.words in one.message for one in found)


HONEST = (
    *("async_import", "brittle", "cartpole", "custom_vector", "duck_typed"),
    *("exotic_spaces", "half_cheetah", "lerobot_docs_multitask", "lerobot_docs_single"),
    *("lerobot_pendulum", "loose_suites", "lunar_lander", "many_tasks", "marker", "minigrid"),
    *("mo_gymnasium", "partial_entry", "pendulum", "pusht", "scribbler", "signal_handlers"),
    *("single_env", "src_layout", "string_tasks", "sub_folder", "vector_wrapper"),
)
"""Samples of which nothing fails."""
FAILING = {
    "cfg_reader": ("loads", "it wants a config"),
    "counter": ("seed-ignored", "it counts its resets"),
    "echo": ("survives", "an action of 3 ends it"),
    "exits": ("survives", "it ends in its third step"),
    "faulty": ("imports", "one of its ways to fail is a package that nobody has"),
    "given": ("loads", "it wants arguments that are pickled"),
    "mortal": ("survives", "an action kills it"),
    "old_gym": ("imports", "it imports gym, which nothing declares"),
    "noisy": ("loads", "it fails, and paints meanwhile"),
    "prompts": ("loads", "it asks a question that nobody answers"),
    "walk": ("survives", "an action ends it, and one never returns"),
    "torch_obs": ("autoreset", "its episodes end in the same step, and without final_obs"),
    "wrong_types": ("loads", "what it returns is no environment"),
}
"""The others: the check that fails, and why it is right to."""
ENTRIES = {"sub_folder": ":envs-v1/pick-cube.py"}


def failing(name: str) -> list[Finding]:
    arguments = {"n_envs": 2, "timeouts": _TIMEOUTS}
    reference = f"{sample(name)}{ENTRIES.get(name, '')}"
    report = judge(JudgeOptions(reference=reference, arguments=arguments, steps=10, resets=2))
    return report.failures(Severity.ERROR)


def is_as_it_stands(name: str, found: list[Finding]) -> bool:
    """Whether nothing fails of an honest one, and of another what stands here alone."""
    expected = {FAILING[name][0]} if name in FAILING else set()
    return {one.id for one in found} == expected


def main(names: list[str]) -> int:
    """Judge all of them, or those that are named; 1 where one is not judged as it stands here."""
    wrong = []
    for name in names or [*HONEST, *FAILING, *ATTACKS]:
        is_attack = name in ATTACKS
        found = told_of(name, ATTACKS[name]) if is_attack else failing(name)
        right = is_told(found, ATTACKS[name]) if is_attack else is_as_it_stands(name, found)
        wrong += [] if right else [name]
        print(f"{'as expected' if right else 'NOT SO':12} {name}", flush=True)
        for one in found:
            print(f"             {one.id}: {one.text[:160]}".replace("\n", " "))
    print(f"{len(wrong)} are not as they stand here: {', '.join(wrong)}" if wrong else "all so")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
