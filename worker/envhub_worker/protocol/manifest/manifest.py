"""The manifest: what a repository's ``make_env`` returned, described as data.

The jail makes it and the client reads it, so every reader here treats it as hostile: counts are
bounded, names are strings of bounded length, spaces are checked before they are built. Metadata
keys that Gymnasium acts on have checked types. Readers take only the facts of a spec: its other
fields are instructions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_worker.protocol.errors import UNTRUSTED, RemoteProtocolError
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.manifest.names import (
    checked_key,
    checked_name,
    optional_name,
    plain_keys,
    servable_names,
    string_keys,
    texts_by_name,
)
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.spaces.batches import is_batch
from envhub_worker.protocol.spaces.reader import GeneratorMaker, SpaceReader
from envhub_worker.protocol.spaces.spaces import encode_space

MAX_ENVS = 4096
"""Vector environments in one manifest: a benchmark suite has a few hundred tasks."""
SUB_ENV_BYTES = 256
"""What a sub-environment may cost the client before it starts: a slice, and a function's place."""
AUTORESET_MODES = ("NextStep", "SameStep", "Disabled")

TaskId = int | str


@dataclass(frozen=True, kw_only=True)
class EnvManifest:
    """One vector environment.

    Attributes:
        suite: Key of the outer mapping.
        task: Key of the inner mapping.
        shardable: The worker drives the sub-environments itself, so they can be spread over several
            processes; otherwise the environment has a ``step`` of its own.
        sync: The repository asked for ``SyncVectorEnv``: its sub-environments may share state.
        independent: For ``AsyncVectorEnv``: the sub-environments gave equal results when played
            apart and together in one process; otherwise each needs a process of its own.
        single_observation_space, single_action_space: Spaces of one sub-environment.
        observation_space, action_space: Batched spaces.
        autoreset_mode: ``"NextStep"``, ``"SameStep"``, ``"Disabled"``, or None if not stated.
        metadata: The environment's metadata, without the autoreset mode; values are inert data.
        spec: ``id``, ``max_episode_steps``, ``reward_threshold`` and ``nondeterministic`` of the
            environment's ``EnvSpec``, as far as they are known, or None.
        attributes: Names of attributes that the vector environment has beyond Gymnasium's, as far
            as ``names.is_servable`` lets them in.
    """

    suite: str
    task: TaskId
    num_envs: int
    shardable: bool
    sync: bool
    independent: bool
    single_observation_space: gym.Space[Any]
    single_action_space: gym.Space[Any]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    autoreset_mode: str | None
    metadata: dict[Any, Any]
    render_mode: str | None
    spec: dict[str, Any] | None
    attributes: tuple[str, ...]
    type_name: str

    def own_batch(self, name: str) -> gym.Space[Any] | None:
        """The batched space of this name if it is not Gymnasium's batch of the single space.

        A repository's own vector environment may define its batches itself. Otherwise None.
        """
        batched, single = getattr(self, name), getattr(self, f"single_{name}")
        own = not self.shardable and not is_batch(batched, single, self.num_envs)
        return batched if own else None


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """All vector environments of a repository and what they run on.

    Attributes:
        envs: In the order of the repository's mapping.
        lazy: No environment has been built yet; each task can live in a jail of its own.
        interpreter: ``implementation version`` and path of the worker's Python.
        packages: Versions of the distributions that the repository could import.
    """

    envs: tuple[EnvManifest, ...]
    lazy: bool
    interpreter: dict[str, str] = field(default_factory=dict)
    packages: dict[str, str] = field(default_factory=dict)


_SPACES = ("single_observation_space", "single_action_space", "observation_space", "action_space")
_ENV_FIELDS = frozenset(EnvManifest.__dataclass_fields__)
_FIELDS = frozenset(Manifest.__dataclass_fields__)


def encode_env(manifest: EnvManifest, *, seeded: bool = False) -> dict[str, object]:
    """Encodes one environment's manifest as a plain value, with generators of ``seeded`` spaces."""
    value = {name: getattr(manifest, name) for name in _ENV_FIELDS}
    described = {
        name: encode_space(value[name], seeded=seeded, single=value.get(f"single_{name}"))
        for name in _SPACES
    }
    return value | described


def encode_manifest(manifest: Manifest) -> dict[str, object]:
    """Encodes a manifest as a plain value, with the generators of seeded spaces."""
    return {
        **vars(manifest),
        "envs": tuple(encode_env(env, seeded=True) for env in manifest.envs),
    }


def decode_manifest(
    value: object,
    *,
    max_elements: int,
    check: Callable[[], None] | None = None,
    generator: GeneratorMaker | None = None,
) -> Manifest:
    """Read a manifest. Trust: input from the worker.

    Args:
        value: The decoded value.
        max_elements: Budget of all spaces and sub-environments of all environments together.
        check: Called before each space; may raise to end the reading, for example at a deadline.
        generator: Checks a state and makes a seeded space's generator from it.

    Raises:
        RemoteProtocolError: The value is no manifest, or is over a limit.
    """
    with UNTRUSTED:
        fields = _mapping(value, _FIELDS, "a manifest")
        envs = fields["envs"]
        if type(envs) is not tuple or not 1 <= len(envs) <= MAX_ENVS:
            raise RemoteProtocolError(f"a manifest does not hold 1 to {MAX_ENVS} environments")
        reader = SpaceReader(max_elements, check, generator)
        decoded = tuple(_decode_env(env, reader) for env in envs)
        if len({(env.suite, env.task) for env in decoded}) != len(decoded):
            raise RemoteProtocolError("a manifest names the same task twice")
        return Manifest(
            envs=decoded,
            lazy=_typed(fields, "lazy", bool),
            interpreter=texts_by_name(fields["interpreter"], "interpreter"),
            packages=texts_by_name(fields["packages"], "packages"),
        )


def decode_env(value: object, *, max_elements: int) -> EnvManifest:
    """Read one environment's manifest. Trust: input from the worker.
    Raises ``RemoteProtocolError``: the value is no manifest, or is over a limit.
    """
    with UNTRUSTED:
        return _decode_env(value, SpaceReader(max_elements))


def _decode_env(value: object, reader: SpaceReader) -> EnvManifest:
    fields = _mapping(value, _ENV_FIELDS, "an environment's manifest")
    num_envs = _typed(fields, "num_envs", int)
    if not 1 <= num_envs <= MAX_NUM_ENVS:
        raise RemoteProtocolError(f"num_envs is {num_envs}, outside 1..{MAX_NUM_ENVS}")
    reader.spend(num_envs * SUB_ENV_BYTES)
    spaces = {name: reader.space(fields[name]) for name in _SPACES}
    mode, task = fields["autoreset_mode"], fields["task"]
    if mode is not None and (type(mode) is not str or mode not in AUTORESET_MODES):
        raise RemoteProtocolError(f"autoreset mode {str(mode)[:40]!r} is not one of Gymnasium's")
    return EnvManifest(
        suite=checked_key(fields["suite"], "suite"),
        task=task if type(task) is int else checked_key(task, "task"),
        num_envs=num_envs,
        shardable=_typed(fields, "shardable", bool),
        sync=_typed(fields, "sync", bool),
        independent=_typed(fields, "independent", bool),
        autoreset_mode=mode,
        metadata=read_metadata_facts(fields["metadata"]),
        render_mode=optional_name(fields["render_mode"], "render_mode"),
        spec=read_spec_facts(fields["spec"]),
        attributes=servable_names(fields["attributes"]),
        type_name=checked_name(fields["type_name"], "type_name"),
        **spaces,
    )


def _mapping(value: object, names: frozenset[str], name: str) -> Mapping[str, Any]:
    if type(value) is not dict or value.keys() != names:
        raise RemoteProtocolError(f"{name} has other fields than {', '.join(sorted(names))}")
    return value


def _typed(fields: Mapping[str, Any], name: str, kind: type) -> Any:
    if type(fields[name]) is not kind:
        raise RemoteProtocolError(f"{name} is not of type {kind.__name__}")
    return fields[name]


MAX_METADATA = 4096
"""Values in an environment's metadata, those in lists, mappings and arrays included."""
MAX_FPS = 1_000_000.0
"""Frames in a second that metadata may ask a video for."""
_NUMBERS = (int, float, np.integer, np.floating)


def read_metadata_facts(value: object) -> dict[Any, Any]:
    """Reads metadata: free data for people, but keys that Gymnasium acts on have checked types."""
    metadata = plain_keys(value, "metadata")
    _count([*metadata, *metadata.values()], MAX_METADATA + len(metadata))
    return {
        key: item
        for key, item in metadata.items()
        if key != "autoreset_mode"  # a field of its own says it
        and (key not in _METADATA_OF_GYMNASIUM or _METADATA_OF_GYMNASIUM[key](item))
    }


def _count(value: object, left: int) -> int:
    """Returns how many more values metadata may hold. The wire's limits bound its depth."""
    left -= 1
    if isinstance(value, np.ndarray):
        left -= value.size
        value = value.tolist() if value.dtype.hasobject and left >= 0 else ()
    inner: Iterable[object] = ()
    if isinstance(value, (dict, list, tuple, set, frozenset)):
        inner = value.values() if isinstance(value, dict) else value
    for item in inner:
        left = _count(item, left)
    if left < 0:
        raise RemoteProtocolError(f"metadata holds more than {MAX_METADATA} values")
    return left


def _is_rate(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        return False
    return bool(0 < value <= MAX_FPS)


def _are_modes(value: object) -> bool:
    return isinstance(value, (list, tuple)) and all(type(mode) is str for mode in value)


_METADATA_OF_GYMNASIUM: dict[str, Callable[[object], bool]] = {
    "render_fps": _is_rate,
    "render_modes": _are_modes,
}


def read_spec_facts(value: object) -> dict[str, Any] | None:
    """Reads the facts of an ``EnvSpec`` and drops every other field.

    The other fields are instructions: which code makes the environment, with which arguments, in
    which wrappers.
    """
    if value is None:
        return None
    facts = string_keys(value, "spec")
    known = {name: facts[name] for name in _FACTS if name in facts}
    return {
        name: None if fact is None else _FACTS[name](fact, name) for name, fact in known.items()
    }


def _whole(value: object, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise RemoteProtocolError(f"{name} is not a whole number")
    if not -(1 << 63) <= value < 1 << 63:
        raise RemoteProtocolError(f"{name} is out of range")
    return int(value)


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        raise RemoteProtocolError(f"{name} is not a number")
    if isinstance(value, (float, np.floating)):
        return float(value)
    return _whole(value, name)


def _flag(value: object, name: str) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise RemoteProtocolError(f"{name} is neither true nor false")
    return bool(value)


_FACTS: dict[str, Callable[[object, str], object]] = {
    "id": checked_name,
    "max_episode_steps": _whole,
    "reward_threshold": _number,
    "nondeterministic": _flag,
}
