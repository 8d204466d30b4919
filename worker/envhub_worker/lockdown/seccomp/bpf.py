"""A small assembler for the classic BPF programs that seccomp runs. Pure."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

# Codes of <linux/bpf_common.h>, composed.
LOAD = 0x20
AND = 0x54
RETURN = 0x06
_JUMP = 0x05
JUMP_EQUAL = 0x15
JUMP_GREATER = 0x25
JUMP_GREATER_OR_EQUAL = 0x35

_MAX_INSTRUCTIONS = 4096


@dataclass(frozen=True)
class Label:
    """The place that branches name."""

    name: str


@dataclass(frozen=True)
class Do:
    """``LOAD`` the word at offset ``k``, ``AND`` the accumulator with ``k``, or ``RETURN`` k."""

    code: int
    k: int


@dataclass(frozen=True)
class Branch:
    """Compare the accumulator with ``k``; None falls through."""

    code: int
    k: int
    if_true: str | None = None
    if_false: str | None = None

    @property
    def targets(self) -> list[str]:
        """The labels that it names."""
        return [target for target in (self.if_true, self.if_false) if target is not None]


@dataclass(frozen=True)
class BpfInstruction:
    """One ``struct sock_filter``."""

    code: int
    if_true: int
    if_false: int
    k: int


Item = Label | Do | Branch


def assemble(items: Sequence[Item]) -> list[BpfInstruction]:
    """Resolve the labels. A jump over more than 255 instructions becomes a pair.
    Raises ``KeyError``: a label is missing; ``ValueError``: a label lies behind its branch, or the
    program is too long.
    """
    branches = {index: item for index, item in enumerate(items) if isinstance(item, Branch)}
    far: set[int] = set()  # branches that are written long; which moves what follows them
    while True:
        places, labels = _lay_out(items, far)
        skips = {
            i: [labels[to] - places[i] - 1 for to in one.targets] for i, one in branches.items()
        }
        more = {index for index, skip in skips.items() if max(skip, default=0) > 255} - far
        if not more:
            break
        far |= more
    for index, branch in branches.items():
        for target, skip in zip(branch.targets, skips[index], strict=True):
            if skip < 0:
                raise ValueError(f"label {target!r} lies behind its branch")
    program: list[BpfInstruction] = []
    for index, item in enumerate(items):
        program += _encode(item, places[index], labels, far=index in far)
    if len(program) > _MAX_INSTRUCTIONS:
        raise ValueError(f"{len(program)} instructions are over {_MAX_INSTRUCTIONS}")
    return program


def _lay_out(items: Sequence[Item], far: set[int]) -> tuple[list[int], dict[str, int]]:
    """Where each item starts, and where each label is."""
    places: list[int] = []
    labels: dict[str, int] = {}
    position = 0
    for index, item in enumerate(items):
        places.append(position)
        if isinstance(item, Label):
            labels[item.name] = position
        else:
            position += 1
        if isinstance(item, Branch) and index in far:
            position += len(item.targets)
    return places, labels


def _encode(item: Item, place: int, labels: dict[str, int], *, far: bool) -> list[BpfInstruction]:
    if isinstance(item, Label):
        return []
    if isinstance(item, Do):
        return [BpfInstruction(item.code, 0, 0, item.k)]
    if not far:
        ends = (item.if_true, item.if_false)
        if_true, if_false = (0 if end is None else labels[end] - place - 1 for end in ends)
        return [BpfInstruction(item.code, if_true, if_false, item.k)]
    # the comparison skips to one of up to two unconditional jumps, or over them
    targets = item.targets
    skip_true = len(targets) if item.if_true is None else 0
    skip_false = len(targets) if item.if_false is None else len(targets) - 1
    jumps = [
        BpfInstruction(_JUMP, 0, 0, labels[target] - place - 2 - slot)
        for slot, target in enumerate(targets)
    ]
    return [BpfInstruction(item.code, skip_true, skip_false, item.k), *jumps]


def to_bytes(program: Sequence[BpfInstruction]) -> bytes:
    """As the kernel reads it: an array of ``struct sock_filter``."""
    return b"".join(struct.pack("=HBBI", i.code, i.if_true, i.if_false, i.k) for i in program)
