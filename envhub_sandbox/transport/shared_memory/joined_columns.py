"""Infos that came as the same columns from every shard of an environment: one array for each."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from envhub_worker.protocol.shared_memory.slabs import Column

Schema = list[tuple[Column, Any]]
"""What columns infos have, and where each lies in a slab."""


class JoinedColumns:
    """The infos of all shards, where all of them came as the same columns: one copy each.

    With many shards this is most of what is left of a step that has infos.

    Args:
        schemas: Each shard's.
        bounds: The sub-environments of each, from and to.

    Attributes:
        columns: Name, shape, dtype and each shard's part; empty where the schemas differ, or one
            does not have a value for each sub-environment.
    """

    def __init__(self, schemas: Sequence[Schema], bounds: Sequence[tuple[int, int]]) -> None:
        self._schemas = schemas
        self.columns: list[tuple[str, tuple[int, ...], Any, list[Any]]] = []
        forms = [[(one.key, one.dtype, one.shape[1:]) for one, _ in schema] for schema in schemas]
        rows = [{one.shape[0] if one.shape else 0 for one, _ in schema} for schema in schemas]
        if forms and forms == [forms[0]] * len(forms) and rows == [{b - a} for a, b in bounds]:
            for index, (key, dtype, tail) in enumerate(forms[0]):
                parts = [schema[index][1] for schema in schemas]
                self.columns.append((key, (bounds[-1][1], *tail), dtype, parts))

    def is_of(self, schemas: Sequence[Schema]) -> bool:
        """Whether it was made of these."""
        known = self._schemas
        return len(known) == len(schemas) and all(map(operator.is_, known, schemas))

    def infos(self) -> dict[Any, Any]:
        """Fresh arrays. Trust: each byte is read once; what is not 0 in a mask is true."""
        return {
            key: np.concatenate(parts, out=np.empty(shape, dtype), casting="unsafe")
            for key, shape, dtype, parts in self.columns
        }
