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


@dataclass(frozen=True)
class Instruction:
    """One ``struct sock_filter``."""

    code: int
    if_true: int
    if_false: int
    k: int


Item = Label | Do | Branch


@dataclass(frozen=True)
class _Layout:
    """Where each item starts, where each label is, and which branches are written long."""

    places: list[int]
    labels: dict[str, int]
    far: set[int]

    def offset(self, source: int, target: str | None) -> int:
        """Instructions to skip from position ``source``, which is the one after the jump."""
        if target is None:
            return 0
        if self.labels[target] < source:
            raise ValueError(f"label {target!r} lies behind its branch")
        return self.labels[target] - source


def assemble(items: Sequence[Item]) -> list[Instruction]:
    """Resolve the labels. A jump over more than 255 instructions becomes a pair.

    Raises:
        KeyError: A label is missing.
        ValueError: A label lies behind its branch, or the program is too long.
    """
    far: set[int] = set()
    while True:
        layout = _lay_out(items, far)
        more = {index for index in range(len(items)) if not _fits(items, index, layout)}
        if not more:
            break
        far |= more
    program = [one for index in range(len(items)) for one in _encode(items[index], index, layout)]
    if len(program) > _MAX_INSTRUCTIONS:
        raise ValueError(f"{len(program)} instructions are over {_MAX_INSTRUCTIONS}")
    return program


def _lay_out(items: Sequence[Item], far: set[int]) -> _Layout:
    places: list[int] = []
    labels: dict[str, int] = {}
    position = 0
    for index, item in enumerate(items):
        places.append(position)
        if isinstance(item, Label):
            labels[item.name] = position
        position += _room(item, index in far)
    return _Layout(places, labels, far)


def _room(item: Item, far: bool) -> int:
    if isinstance(item, Label):
        return 0
    if isinstance(item, Do) or not far:
        return 1
    return 1 + sum(target is not None for target in (item.if_true, item.if_false))


def _fits(items: Sequence[Item], index: int, layout: _Layout) -> bool:
    item = items[index]
    if not isinstance(item, Branch) or index in layout.far:
        return True
    source = layout.places[index] + 1
    return all(layout.offset(source, target) <= 255 for target in (item.if_true, item.if_false))


def _encode(item: Item, index: int, layout: _Layout) -> list[Instruction]:
    if isinstance(item, Label):
        return []
    if isinstance(item, Do):
        return [Instruction(item.code, 0, 0, item.k)]
    place = layout.places[index]
    if index in layout.far:
        return _encode_far(item, place, layout)
    if_true, if_false = (layout.offset(place + 1, t) for t in (item.if_true, item.if_false))
    return [Instruction(item.code, if_true, if_false, item.k)]


def _encode_far(item: Branch, place: int, layout: _Layout) -> list[Instruction]:
    """The comparison skips to one of up to two unconditional jumps, or over them."""
    targets = [target for target in (item.if_true, item.if_false) if target is not None]
    skip_true = len(targets) if item.if_true is None else 0
    skip_false = len(targets) if item.if_false is None else len(targets) - 1
    program = [Instruction(item.code, skip_true, skip_false, item.k)]
    for slot, target in enumerate(targets):
        program.append(Instruction(_JUMP, 0, 0, layout.offset(place + 2 + slot, target)))
    return program


def to_bytes(program: Sequence[Instruction]) -> bytes:
    """As the kernel reads it: an array of ``struct sock_filter``."""
    return b"".join(struct.pack("=HBBI", i.code, i.if_true, i.if_false, i.k) for i in program)


def listing(program: Sequence[Instruction]) -> str:
    """One line per instruction, for people and golden files."""
    names = {
        LOAD: "load",
        AND: "and",
        RETURN: "return",
        _JUMP: "jump",
        JUMP_EQUAL: "equal",
        JUMP_GREATER: "greater",
        JUMP_GREATER_OR_EQUAL: "greater-or-equal",
    }
    lines = []
    for place, one in enumerate(program):
        text = f"{place:4} {names[one.code]} {one.k:#x}"
        if one.code in (JUMP_EQUAL, JUMP_GREATER, JUMP_GREATER_OR_EQUAL):
            text += f" ? {place + 1 + one.if_true} : {place + 1 + one.if_false}"
        lines.append(text)
    return "\n".join(lines) + "\n"
