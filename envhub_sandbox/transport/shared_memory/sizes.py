"""The size in bytes of a step by the fast lane."""

from __future__ import annotations

import numpy as np

from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.shared_memory import slabs


def step_bytes(manifest: EnvManifest) -> tuple[int, int]:
    """What one step by shared memory sends and receives; infos, which vary, are left out."""
    count = manifest.num_envs
    sent = slabs.layout_of(manifest.single_action_space, count)
    received = slabs.observation_layout(manifest.single_observation_space, count, 1)
    if sent is None or received is None:
        return 0, 0
    flags = count * (8 + 1 + 1)
    return _leaf_bytes(sent.actions), _leaf_bytes(received.leaves) + flags


def _leaf_bytes(leaves: tuple[slabs.Leaf, ...]) -> int:
    return sum(int(np.prod(leaf.shape, dtype=np.int64)) * leaf.dtype.itemsize for leaf in leaves)
