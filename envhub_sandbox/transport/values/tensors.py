"""Torch tensors out of the worker's arrays, where torch is installed; arrays elsewhere."""

from __future__ import annotations

import importlib.util
from functools import cache
from typing import Any

import numpy.typing as npt

from envhub_worker.protocol.codec.numpy_forms import widened_numpy


@cache
def _torch() -> Any:
    # a fixed name of ours: nothing is imported because a worker said so
    if importlib.util.find_spec("torch") is None:
        return None
    import torch

    return torch


def to_tensor(array: npt.NDArray[Any], dtype: str) -> Any:
    """A tensor that owns its memory, or the array if there is no torch.

    Args:
        array: The bits, owned and writable; ``uint16`` for ``bfloat16``.
        dtype: Torch's name of the dtype, out of the codec's table.
    """
    torch = _torch()
    if torch is None:
        return widened_numpy(array) if dtype == "bfloat16" else array
    tensor = torch.from_numpy(array)
    return tensor.view(torch.bfloat16) if dtype == "bfloat16" else tensor
