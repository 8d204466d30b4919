"""Hand-made messages, for tests of what a hostile or older peer may send."""

import struct
from collections.abc import Callable, Iterable
from typing import Any
from unittest.mock import Mock

import msgpack
from gymnasium.vector.utils import batch_space

from envhub_sandbox.transport.jail import JailHandle, Request
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.reader import Space, SpaceReader


def message(document: bytes, tail: bytes = b"", *frames: bytes) -> list[Buffer]:
    return [struct.pack("<I", len(document)) + document + tail, *frames]


def value(document: bytes) -> list[Buffer]:
    """A ``Value``, the answer to a call, around a hand-made msgpack document."""
    return message(b"\x92" + msgpack.packb(m.Value.kind) + document)


def decode_space(value: object, *, max_elements: int) -> Space:
    return SpaceReader(max_elements).space(value)


def env_manifest(observation: Space, action: Space, count: int, /, **changes: Any) -> EnvManifest:
    """The description of an environment with these single spaces, with some fields changed."""
    fields: dict[str, Any] = {
        "suite": "env",
        "task": 0,
        "num_envs": count,
        "shardable": True,
        "sync": False,
        "independent": True,
        "single_observation_space": observation,
        "single_action_space": action,
        "observation_space": batch_space(observation, count),
        "action_space": batch_space(action, count),
        "autoreset_mode": "NextStep",
        "metadata": {},
        "render_mode": None,
        "spec": None,
        "attributes": (),
        "type_name": "gymnasium.vector.AsyncVectorEnv",
    }
    return EnvManifest(**(fields | changes))


def not_refused(read: Callable[[Any], object], lies: Iterable[Any]) -> list[Any]:
    """The lies that are read without a ``RemoteProtocolError``."""
    taken = []
    for lie in lies:
        try:
            read(lie)
        except RemoteProtocolError:
            continue
        taken.append(lie)
    return taken


def ext(code: int, payload: bytes = b"") -> msgpack.ExtType:
    return msgpack.ExtType(code, payload)


def packed(value: object) -> list[Buffer]:
    """Frames around what plain msgpack makes of a value."""
    return message(msgpack.packb(value))


def deep(levels: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(levels - 1):
        value = [value]
    return value


def requested(*messages: m.Message) -> Request:
    """A request of a message for each shard of two sub-environments, as it is sent."""
    jail = JailHandle(Mock(version=m.VERSION), 1, [], [], DEFAULT_LIMITS)
    bounds = [(2 * index, 2 * index + 2) for index in range(len(messages))]
    return jail.request("a test", messages, bounds)
