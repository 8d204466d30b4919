"""Infos that came as columns from several shards."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from envhub_sandbox.transport.shared_memory.client_slabs import JoinedColumns, Schema
from envhub_worker.protocol.shared_memory.slabs import columns_of
from envhub_worker.protocol.spaces import batches

BOUNDS = [(0, 3), (3, 5)]


def infos(rows: int, first: float, **other: Any) -> dict[str, Any]:
    """Those of one shard: ``first`` and what follows it, and masks."""
    speeds = np.arange(first, first + rows)
    goal = np.full((rows, 2), first, np.float32)
    found = {"speed": speeds, "goal": goal, "steps": np.arange(rows), **other}
    masks = {f"_{key}": np.ones(rows, np.bool_) for key in found}
    return {
        name: one
        for key in found
        for name, one in ((key, found[key]), (f"_{key}", masks[f"_{key}"]))
    }


def schema(part: dict[str, Any]) -> Schema:
    """As a shard knows it, and with these values in its slab."""
    columns = columns_of(part)
    assert columns
    slab = bytearray(4096)
    made = [(column, column.view(slab, 0)) for column in columns]
    for column, view in made:
        view[...] = part[column.key]
    return made


def test_they_are_joined_as_parts_are() -> None:
    """The same arrays in the same order, and fresh ones each time."""
    parts = [infos(3, 0.5), infos(2, 7.5)]
    joined = JoinedColumns([schema(part) for part in parts], BOUNDS)
    expected, found = batches.join_infos(parts, [3, 2]), joined.infos()
    assert list(found) == list(expected)
    for key, value in expected.items():
        assert (found[key].dtype, found[key].tolist()) == (value.dtype, value.tolist()), key
        assert not np.shares_memory(found[key], joined.infos()[key])


def test_what_is_no_boolean_in_a_mask_is_true() -> None:
    schemas = [schema(infos(3, 0)), schema(infos(2, 0))]
    for column, view in schemas[1]:
        if column.key == "_speed":
            view[...] = (2, 0)
    found = JoinedColumns(schemas, BOUNDS).infos()["_speed"]
    assert found.view(np.uint8).tolist() == [1, 1, 1, 1, 0]


@pytest.mark.parametrize(
    "second",
    [
        infos(2, 0, more=np.zeros(2)),
        infos(2, 0, steps=np.zeros(2)),
        infos(2, 0, goal=np.zeros((2, 3), np.float32)),
        infos(3, 0),
        {"x": np.zeros(2)},
    ],
    ids=["another key", "another dtype", "another shape", "too many rows", "other keys"],
)
def test_what_does_not_go_together_is_left_to_joining(second: dict[str, Any]) -> None:
    assert not JoinedColumns([schema(infos(3, 0)), schema(second)], BOUNDS).columns


def test_a_new_schema_of_one_shard_makes_another() -> None:
    schemas = [schema(infos(3, 0)), schema(infos(2, 0))]
    joined = JoinedColumns(schemas, BOUNDS)
    assert joined.is_of(list(schemas))
    assert not joined.is_of([schemas[0], schema(infos(2, 0))])
    assert not joined.is_of(schemas[:1])
    assert not JoinedColumns((), ()).is_of(schemas)
