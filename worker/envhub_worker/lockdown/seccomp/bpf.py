"""A small assembler for the classic BPF programs that seccomp runs. Pure."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

# Codes of <linux/bpf_common.h>, composed.
LOAD = 0x20
AND = 0x54
RETURN = 0x06
_JUMP = 0x05
JUMP_EQUAL = 0x15
JUMP_GREATER = 0x25
JUMP_GREATER_OR_EQUAL = 0x35

_MAX_INSTRUCTIONS = 4096


class Label(NamedTuple):
    """A position that branches jump to."""

    name: str


class Do(NamedTuple):
    """An instruction: ``LOAD`` the word at offset ``k``, ``AND`` it with ``k``, or ``RETURN`` k."""

    code: int
    k: int


class Branch(NamedTuple):
    """A conditional jump that compares the accumulator with ``k``; a target None falls through."""

    code: int
    k: int
    if_true: str | None = None
    if_false: str | None = None

    @property
    def targets(self) -> list[str]:
        """The labels that this branch jumps to."""
        return [target for target in (self.if_true, self.if_false) if target is not None]


class BpfInstruction(NamedTuple):
    """One ``struct sock_filter``."""

    code: int
    if_true: int
    if_false: int
    k: int


Item = Label | Do | Branch


def assemble(items: Sequence[Item]) -> list[BpfInstruction]:
    """Resolve the labels. A jump over more than 255 instructions becomes a pair.
    Raises ``KeyError``: a label is missing, or lies behind its branch; ``ValueError``: the program
    is too long.
    """
    program: list[BpfInstruction] = []  # backwards: so it is known how far each branch leads
    labels: dict[str, int] = {}  # how many instructions follow
    for item in reversed(items):
        if isinstance(item, Label):
            labels[item.name] = len(program)
        elif isinstance(item, Do):
            program.append(BpfInstruction(item.code, 0, 0, item.k))
        else:
            program += reversed(_branch(item, len(program), labels))
    if len(program) > _MAX_INSTRUCTIONS:
        raise ValueError(f"{len(program)} instructions are over {_MAX_INSTRUCTIONS}")
    return program[::-1]


def _branch(item: Branch, following: int, labels: dict[str, int]) -> list[BpfInstruction]:
    """Returns the instructions of a branch; ``following``: number of instructions after it."""
    skips = {end: following - labels[end] for end in item.targets}
    if max(skips.values(), default=0) <= 255:
        if_true, if_false = (skips.get(end or "", 0) for end in (item.if_true, item.if_false))
        return [BpfInstruction(item.code, if_true, if_false, item.k)]
    # The comparison jumps to one of up to two unconditional jumps, or over both.
    ends = item.targets
    skip_true = len(ends) if item.if_true is None else 0
    skip_false = len(ends) if item.if_false is None else len(ends) - 1
    jumps = [
        BpfInstruction(_JUMP, 0, 0, skips[end] + len(ends) - 1 - slot)
        for slot, end in enumerate(ends)
    ]
    return [BpfInstruction(item.code, skip_true, skip_false, item.k), *jumps]


def to_bytes(program: Sequence[BpfInstruction]) -> bytes:
    """Returns the program as the kernel reads it: an array of ``struct sock_filter``."""
    return b"".join(struct.pack("=HBBI", i.code, i.if_true, i.if_false, i.k) for i in program)
