"""A vector environment's infos, seen from one sub-environment."""

from __future__ import annotations

from typing import Any

import numpy as np


def info_of(infos: dict[Any, Any], index: int, num_envs: int) -> dict[Any, Any]:
    """The info of sub-environment ``index``.

    The other way round from ``VectorEnv._add_info``: a key counts where its mask, ``"_" + key``,
    bool ``(num_envs,)``, is set, and mappings are nested. Keys may be numbers, as in Gymnasium.
    """
    info = {}
    masks = {f"_{key}" for key in infos}
    for key, value in infos.items():
        if key in masks:
            continue
        mask = infos.get(f"_{key}")
        if mask is None or np.asarray(mask).flat[index]:
            info[key] = _of_one(value, index, num_envs)
    return info


def _of_one(value: Any, index: int, num_envs: int) -> Any:
    if isinstance(value, dict):
        return info_of(value, index, num_envs)
    if isinstance(value, (np.ndarray, list, tuple)) and len(value) == num_envs:
        return value[index]
    return value  # not of the sub-environments, but of the vector environment
