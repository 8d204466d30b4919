"""Compiles the table of ``policy`` to a BPF program and installs it as the system call filter."""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Mapping

from envhub_worker.lockdown.layers import LayerUnavailableError, no_system_calls
from envhub_worker.lockdown.mechanisms import kernel
from envhub_worker.lockdown.seccomp import bpf, policy
from envhub_worker.lockdown.seccomp.bpf import Branch, Do, Item, Label
from envhub_worker.lockdown.seccomp.policy import ByArguments, Check, Verdict
from envhub_worker.lockdown.seccomp.syscalls import NUMBERS

_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
# The x32 ABI reaches the same calls by other numbers, which no table lists.
_X32 = 0x40000000

_PR_GET_SECCOMP = 21
_PR_SET_SECCOMP = 22
_MODE_FILTER = 2
_SET_MODE_FILTER = 1
_NEW_LISTENER = 1 << 3
#: Once its notification was read, only a fatal signal interrupts the caller (Linux 5.19).
WAIT_KILLABLE = 1 << 5

_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16


def compile_filter(
    *,
    namespaced: bool,
    network: str,
    brokered: bool = False,
    measured: bool = False,
    scoped: bool = True,
    record: bool = False,
) -> bytes:
    """Compiles this machine's ``policy_table``, or its ``recorded_calls`` if ``record``, to bytes.
    Raises ``LayerUnavailableError``: no table for this machine.
    """
    machine = os.uname().machine
    conditions = {"brokered": brokered, "measured": measured, "scoped": scoped}
    verdicts = policy.policy_table(namespaced=namespaced, network=network, **conditions)
    if record:
        verdicts = policy.recorded_calls(verdicts, NUMBERS.get(machine, ()))
    return bpf.to_bytes(program(machine, verdicts))


def program(machine: str, verdicts: Mapping[str, Verdict]) -> list[bpf.BpfInstruction]:
    """Returns the program: checks the architecture, then searches a balanced tree over the call
    numbers, then checks arguments.
    """
    if machine not in NUMBERS:
        raise no_system_calls(machine)
    numbers = NUMBERS[machine]
    highest = max(numbers.values())
    by_number = {numbers[name]: verdict for name, verdict in verdicts.items() if name in numbers}
    numbered = set(numbers.values())
    items: list[Item] = [
        # First of all: another architecture's calls have other numbers.
        Do(bpf.LOAD, _ARCHITECTURE),
        Branch(bpf.JUMP_EQUAL, _AUDIT_ARCH[machine], None, _returning(policy.KILL_PROCESS)),
        Do(bpf.LOAD, _NUMBER),
    ]
    if machine == "x86_64":
        items.append(Branch(bpf.JUMP_GREATER_OR_EQUAL, _X32, _returning(policy.KILL_PROCESS), None))
    # The answer of a kernel that is older than the call, after which programs use another one.
    items.append(Branch(bpf.JUMP_GREATER, highest, _returning(policy.ENOSYS), None))
    labels = [
        _label(n, by_number.get(n, policy.EPERM if n in numbered else policy.ENOSYS))
        for n in range(highest + 1)
    ]
    # A segment is a run of call numbers with equal labels: (first number, label).
    starts = [n for n, label in enumerate(labels) if n == 0 or labels[n - 1] != label]
    items += _tree([(n, labels[n]) for n in starts])
    for call, verdict in sorted(by_number.items()):
        if isinstance(verdict, ByArguments):
            items += _argument_block(_label(call, verdict), verdict)
    return bpf.assemble(items + _returns(items))


def _label(call: int, verdict: Verdict) -> str:
    return f"call-{call}" if isinstance(verdict, ByArguments) else _returning(verdict)


def _returning(verdict: int) -> str:
    return f"return-{verdict:#x}"


def _tree(segments: list[tuple[int, str]]) -> list[Item]:
    """Returns a binary search for the segment of the loaded call number."""
    middle = len(segments) // 2
    left, right = segments[:middle], segments[middle:]
    items: list[Item] = [
        Branch(bpf.JUMP_GREATER_OR_EQUAL, right[0][0], _entry(right), _entry(left))
    ]
    for half in (left, right):
        if len(half) > 1:
            items += [Label(_entry(half)), *_tree(half)]
    return items


def _entry(segments: list[tuple[int, str]]) -> str:
    """Returns the label for segments: the verdict of a single segment, or a subtree of several."""
    if len(segments) == 1:
        return segments[0][1]
    return f"tree-{segments[0][0]}-{segments[-1][0]}"


def _argument_block(label: str, verdict: ByArguments) -> list[Item]:
    items: list[Item] = [Label(label)]
    for index, (checks, action) in enumerate(verdict.rules):
        following = f"{label}-{index + 1}"
        for check in checks:
            items += _compare(check, following)
        items += [Do(bpf.RETURN, action), Label(following)]
    return [*items, Do(bpf.RETURN, verdict.otherwise)]


def _compare(check: Check, otherwise: str) -> list[Item]:
    """Returns a check that falls through if it holds. Both machines are little-endian."""
    offset = _ARGUMENTS + 8 * check.arg
    items: list[Item] = [Do(bpf.LOAD, offset)]
    if check.mask != 0xFFFFFFFF:
        items.append(Do(bpf.AND, check.mask))
    items.append(Branch(bpf.JUMP_EQUAL, check.value & 0xFFFFFFFF, None, otherwise))
    if check.wide:
        items.append(Do(bpf.LOAD, offset + 4))
        items.append(Branch(bpf.JUMP_EQUAL, check.value >> 32, None, otherwise))
    return items


def _returns(items: list[Item]) -> list[Item]:
    """Returns a labelled return for each verdict that a branch jumps to."""
    targets = {
        target
        for item in items
        if isinstance(item, Branch)
        for target in item.targets
        if target.startswith("return-")
    }
    return [
        item
        for target in sorted(targets)
        for item in (Label(target), Do(bpf.RETURN, int(target.removeprefix("return-"), 16)))
    ]


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def install(compiled: bytes, *, brokered: bool = False) -> int:
    """Filter this thread and its descendants for good. ``no_new_privs`` must be set.

    Returns, if ``brokered``, the listener: the descriptor at which notified calls arrive and whose
    holder decides them. Otherwise returns -1.
    Raises ``LayerUnavailableError``: the kernel refuses.
    """
    code = ctypes.create_string_buffer(compiled, len(compiled))
    header = _Program(len(compiled) // 8, ctypes.addressof(code))
    try:
        if brokered:
            return _listener(ctypes.addressof(header))
        kernel.prctl(_PR_SET_SECCOMP, _MODE_FILTER, ctypes.addressof(header))
    except OSError as error:
        raise LayerUnavailableError(
            "seccomp",
            f"the kernel answers {os.strerror(error.errno or 0)}",
            "It needs CONFIG_SECCOMP_FILTER, which every distribution's kernel has"
            f"{', and Linux 5.5' if brokered else ''}.",
        ) from error
    return -1


def _listener(index: int) -> int:
    """Install the program at ``index``; no signal interrupts a call that waits for init.

    Kernels before 5.19 lack the flag for that: there a signal ends the call with EINTR, or repeats
    the notification if the signal's handler restarts calls.
    """
    try:
        return kernel.syscall("seccomp", _SET_MODE_FILTER, _NEW_LISTENER | WAIT_KILLABLE, index)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
    return kernel.syscall("seccomp", _SET_MODE_FILTER, _NEW_LISTENER, index)


def installed() -> bool:
    """Whether a filter holds for this thread."""
    return kernel.prctl(_PR_GET_SECCOMP) == _MODE_FILTER
