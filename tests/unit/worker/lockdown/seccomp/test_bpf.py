"""The BPF assembler, judged by an interpreter."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.lockdown.seccomp.bpf import (
    JUMP_EQUAL,
    LOAD,
    RETURN,
    BpfInstruction,
    Branch,
    Do,
    Label,
    assemble,
    to_bytes,
)
from tests.unit.worker.lockdown.seccomp.bpf_machine import run


def test_branch_skips_to_its_labels() -> None:
    program = assemble(
        [
            Do(LOAD, 0),
            Branch(JUMP_EQUAL, 7, "seven", None),
            Do(RETURN, 1),
            Label("seven"),
            Do(RETURN, 2),
        ]
    )
    assert program == [
        BpfInstruction(LOAD, 0, 0, 0),
        BpfInstruction(JUMP_EQUAL, 1, 0, 7),
        BpfInstruction(RETURN, 0, 0, 1),
        BpfInstruction(RETURN, 0, 0, 2),
    ]


def test_bytes_are_the_kernels_structure() -> None:
    assert to_bytes([BpfInstruction(0x15, 1, 2, 0x04030201)]) == bytes([0x15, 0, 1, 2, 1, 2, 3, 4])


@pytest.mark.parametrize("both", [True, False])
def test_far_branch_becomes_a_pair_of_jumps(both: bool) -> None:
    padding = [Do(LOAD, 0)] * 300
    program = assemble(
        [
            Do(LOAD, 0),
            Branch(JUMP_EQUAL, 7, "far", "further" if both else None),
            Do(RETURN, 1),
            *padding,
            Label("far"),
            Do(RETURN, 2),
            *padding,
            Label("further"),
            Do(RETURN, 3),
        ]
    )
    assert all(one.if_true < 256 and one.if_false < 256 for one in program)
    assert run(program, 0, 7) == 2
    assert run(program, 0, 8) == (3 if both else 1)


@pytest.mark.parametrize(
    ("items", "error", "text"),
    [
        ([Label("back"), Do(LOAD, 0), Branch(JUMP_EQUAL, 1, "back", None)], KeyError, "back"),
        ([Branch(JUMP_EQUAL, 1, "nowhere", None), Do(RETURN, 0)], KeyError, "nowhere"),
        ([Do(LOAD, 0)] * 4097, ValueError, "4097"),
    ],
    ids=["a label behind its branch", "a missing label", "too long"],
)
def test_what_no_kernel_takes_fails(items: list[Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        assemble(items)


@given(
    targets=st.lists(st.integers(0, 40), min_size=1, max_size=60),
    padding=st.integers(0, 40),
    number=st.integers(0, 70),
)
def test_comparisons_find_their_label(targets: list[int], padding: int, number: int) -> None:
    items: list[object] = [Do(LOAD, 0)]
    items += [Branch(JUMP_EQUAL, n, f"l{target}", None) for n, target in enumerate(targets)]
    items.append(Do(RETURN, 999))
    for label in range(41):
        items += [Label(f"l{label}"), Do(RETURN, label), *[Do(LOAD, 0)] * padding]
    program = assemble(items)
    assert run(program, 0, number) == (targets[number] if number < len(targets) else 999)
