"""A classic BPF interpreter for seccomp data: what the kernel would answer; and a listing."""

import struct
from collections.abc import Sequence

from envhub_worker.lockdown.seccomp.bpf import BpfInstruction


def run(program: Sequence[BpfInstruction], arch: int, number: int, args: Sequence[int] = ()) -> int:
    """The verdict for one system call. It ends: every jump goes forward."""
    words = [*args, *[0] * (6 - len(args))]
    masked = [word & (2**64 - 1) for word in words]
    data = struct.pack("<IIQ6Q", number, arch, 0, *masked)
    accumulator = place = 0
    while True:
        one = program[place]
        place += 1
        if one.code == 0x06:
            return one.k
        if one.code == 0x20:
            accumulator = struct.unpack_from("<I", data, one.k)[0]
        elif one.code == 0x54:
            accumulator &= one.k
        elif one.code == 0x05:
            place += one.k
        else:
            place += one.if_true if _holds(one, accumulator) else one.if_false


def _holds(one: BpfInstruction, accumulator: int) -> bool:
    verdicts = {0x15: accumulator == one.k, 0x25: accumulator > one.k, 0x35: accumulator >= one.k}
    return verdicts[one.code]


def listing(program: Sequence[BpfInstruction]) -> str:
    names = {
        0x20: "load",
        0x54: "and",
        0x06: "return",
        0x05: "jump",
        0x15: "equal",
        0x25: "greater",
        0x35: "greater-or-equal",
    }
    lines = []
    for place, one in enumerate(program):
        text = f"{place:4} {names[one.code]} {one.k:#x}"
        if one.code in (0x15, 0x25, 0x35):
            text += f" ? {place + 1 + one.if_true} : {place + 1 + one.if_false}"
        lines.append(text)
    return "\n".join(lines) + "\n"
