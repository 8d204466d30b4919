"""Every message, one frozen dataclass each; ``docs/protocol.md`` is its document.

A message is the value ``[kind, id, field, ...]`` in the codec's encoding: one msgpack header and
raw buffers. ``id`` ties a reply to its request. Two conversations share this file:

- client and worker server (over ZeroMQ), to open and close jails and to relay;
- client and jail runner (inside ``Relay``), about environments. The server never decodes these.

``unpack`` checks the kind, the number of fields and each field's type, so that a decoded message
is what its class says. Trust: what comes from a jail is hostile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import templates
from envhub_worker.protocol.codec.codec import Buffer, decode_parts, encode, split
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES
from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.protocol.untrusted import UNTRUSTED

VERSION = 5
"""The newest version of the protocol: ``Hello`` offers a range, ``Welcome`` agrees to one.

Version 2 added kinds 17 to 30, version 3 kind 53, version 4 kind 54, version 5 kind 31; nothing
that there was changed.
"""
OLDEST_VERSION = 1
"""The oldest version that this code still speaks."""
_HEAD_BYTES = 64
"""Enough for the length of a document, its kind and its id."""
FIRST_RUNNER_KIND = 32
"""Kinds from here on are between client and jail runner; a runner may send no other."""


class Message:
    """Base of all messages; ``kind`` is its number on the wire and never changes."""

    __slots__ = ()
    kind: ClassVar[int]


M = TypeVar("M", bound=Message)
Checks = tuple[tuple[str, frozenset[type] | None], ...]
KINDS: dict[int, type[Message]] = {}
_CHECKS: dict[type[Message], Checks] = {}

# a field's annotation, and the types that a decoded value of it may have
_ACCEPTED: dict[str, frozenset[type] | None] = {
    "int": frozenset({int}),
    "bool": frozenset({bool}),
    "str": frozenset({str}),
    "Reason": frozenset({str}),
    "bytes": frozenset({bytes}),
    "int | None": frozenset({int, type(None)}),
    "str | None": frozenset({str, type(None)}),
    "tuple[int, ...]": frozenset({tuple}),
    "tuple[object, ...]": frozenset({tuple}),
    "dict[str, object]": frozenset({dict}),
    "dict[object, object]": frozenset({dict}),
    "dict[str, object] | None": frozenset({dict, type(None)}),
    "object": None,
}


def _message(kind: int) -> Callable[[type[M]], type[M]]:
    def register(cls: type[M]) -> type[M]:
        cls.kind = kind
        KINDS[kind] = cls
        annotated = fields(cls)  # type: ignore[arg-type]
        _CHECKS[cls] = tuple((item.name, _ACCEPTED[str(item.type)]) for item in annotated)
        return cls

    return register


# --- client and server -------------------------------------------------------------------------


@_message(1)
@dataclass(frozen=True, slots=True)
class Hello(Message):
    """The first request on every connection. Reply: ``Welcome`` or ``Refused``."""

    oldest: int
    newest: int
    session: bytes
    """Random bytes that join the connections of one client; jails belong to a session."""


@_message(2)
@dataclass(frozen=True, slots=True)
class Welcome(Message):
    """The agreed version, and what the worker server runs on."""

    version: int
    worker: str
    pid: int


@_message(3)
@dataclass(frozen=True, slots=True)
class Refused(Message):
    """The server did not do it. ``error`` is a name out of a table in the client.

    ``layer`` and ``fix`` are filled where a layer of the confinement is missing.
    """

    error: str
    message: str
    layer: str
    fix: str


@_message(4)
@dataclass(frozen=True, slots=True)
class OpenJail(Message):
    """Fork a jail for a snapshot. Reply: ``JailOpened``, ``Refused`` or ``Died``.

    ``confinement`` holds the fields of ``Confinement``, with ``limits`` as a nested mapping.
    ``python`` is the interpreter that runs the repository; empty for the server's own.
    """

    name: str
    python: str
    snapshot: str
    entry: str
    confinement: dict[str, object]
    runners: int

    @property
    def runtime(self) -> Runtime:
        """What runs the repository."""
        return Runtime(self.python)


@_message(5)
@dataclass(frozen=True, slots=True)
class JailOpened(Message):
    """The jail's number and its runners' numbers."""

    jail: int
    runners: tuple[int, ...]
    report: tuple[object, ...]
    """One mapping per layer: ``layer``, ``enforced``, ``detail``."""


@_message(6)
@dataclass(frozen=True, slots=True)
class StartRunners(Message):
    """Fork further runners in an open jail. Reply: ``JailOpened`` with just the new ones."""

    jail: int
    runners: int


@_message(7)
@dataclass(frozen=True, slots=True)
class Relay(Message):
    """Hand the frames that follow to runners: ``parts`` is ``((runner, frames), ...)``.

    Reply: ``Relayed`` once every runner has answered, or ``Died``.
    """

    jail: int
    operation: str
    parts: tuple[object, ...]


@_message(8)
@dataclass(frozen=True, slots=True)
class Relayed(Message):
    """The runners' replies: ``parts`` is the number of frames of each, in the request's order."""

    parts: tuple[int, ...]


@_message(9)
@dataclass(frozen=True, slots=True)
class Died(Message):
    """A process of the jail ended. Trust: ``tail`` is the jail's own output, escaped."""

    runner: int
    reason: Reason
    exit_code: int | None
    signal: str | None
    detail: str
    tail: str
    operation: str


@_message(10)
@dataclass(frozen=True, slots=True)
class CloseJail(Message):
    """End a jail and everything in it. Reply: ``Done``, once it is gone."""

    jail: int


@_message(11)
@dataclass(frozen=True, slots=True)
class Done(Message):
    """It is done, and there is nothing to say about it."""


@_message(12)
@dataclass(frozen=True, slots=True)
class ReadOutput(Message):
    """Ask for the last lines that a jail printed. Reply: ``Output``, or ``Died``.

    ``operation`` is what ``Died`` then says the client was waiting for.
    """

    jail: int
    operation: str


@_message(13)
@dataclass(frozen=True, slots=True)
class Output(Message):
    """The last lines of a jail's output, control characters escaped."""

    text: str


@_message(14)
@dataclass(frozen=True, slots=True)
class GetStatus(Message):
    """Ask for the server's jails. Reply: ``Status``."""


@_message(15)
@dataclass(frozen=True, slots=True)
class Status(Message):
    """One mapping per jail: ``jail``, ``name``, ``pids``, ``states``, ``busy_s``, ``operation``."""

    jails: tuple[object, ...]


@_message(16)
@dataclass(frozen=True, slots=True)
class Deposit(Message):
    """Over the descriptor socket: descriptors for a runner, which the next request brings to it.

    That has to be an ``Attach``; the server, which decodes no such message, does not look.
    Reply, over the same socket: one byte, with a pidfd of the jail.
    """

    session: bytes
    jail: int
    runner: int


@_message(17)
@dataclass(frozen=True, slots=True)
class KeepJail(Message):
    """From now on a runner's death does not end the jail. Reply: ``Done``, or ``Died``.

    A ``Relay`` to a runner that has died, or dies before it answers, is then answered with
    ``RelayedPartly``; further runners can be started in its place.
    """

    jail: int


@_message(18)
@dataclass(frozen=True, slots=True)
class RelayedPartly(Message):
    """As ``Relayed``, of a jail that is kept, where some runners have died.

    ``dead`` holds their places in the request; what stands there is the server's own ``Died``,
    in one frame. What runners send never counts as such, whatever it says.
    """

    parts: tuple[int, ...]
    dead: tuple[int, ...]


@_message(19)
@dataclass(frozen=True, slots=True)
class OfferSnapshot(Message):
    """A snapshot's files, each ``(path, size, sha256)``. Reply: ``Wanted``, or ``Refused``."""

    files: tuple[object, ...]


@_message(20)
@dataclass(frozen=True, slots=True)
class Wanted(Message):
    """The hashes that the server does not have. None: ``OpenJail`` may name ``snapshot``."""

    snapshot: str
    hashes: tuple[object, ...]


@_message(21)
@dataclass(frozen=True, slots=True)
class PutBlob(Message):
    """One piece of a wanted file, in order; the frame that follows holds it. Reply: ``Done``.

    With the last piece the whole is compared with its hash.
    """

    sha256: bytes
    offset: int


@_message(22)
@dataclass(frozen=True, slots=True)
class KeepAlive(Message):
    """The client lives, and still holds these jails. Reply: ``Done``."""

    jails: tuple[int, ...]


@_message(23)
@dataclass(frozen=True, slots=True)
class Agree(Message):
    """The compressions that the client can read, best first. Reply: ``Agreed``."""

    compressions: tuple[object, ...]


@_message(24)
@dataclass(frozen=True, slots=True)
class Agreed(Message):
    """The compression of both directions from here on, or ``""``; and the server's patience.

    Jails of a client that is not heard from for ``idle_s`` seconds are ended; 0 means never.
    """

    compression: str
    idle_s: int


@_message(25)
@dataclass(frozen=True, slots=True)
class Packed(Message):
    """In front of a message's frames: some of them are compressed.

    ``sizes`` has one number for each frame that follows: its size when unpacked, or -1 for a
    frame that is as it was.
    """

    compression: str
    sizes: tuple[int, ...]


@_message(26)
@dataclass(frozen=True, slots=True)
class GetSessions(Message):
    """Ask who uses the server: the asker's own sessions, or all for the operator."""


@_message(27)
@dataclass(frozen=True, slots=True)
class Sessions(Message):
    """One mapping a session: ``client``, ``session``, ``heard_s``, ``connections``, ``jails``."""

    sessions: tuple[object, ...]


@_message(28)
@dataclass(frozen=True, slots=True)
class FollowOutput(Message):
    """Ask for what a jail has printed from its ``offset``-th byte on. Reply: ``OutputBytes``.

    Also after the jail's death, until it is closed.
    """

    jail: int
    offset: int


@_message(29)
@dataclass(frozen=True, slots=True)
class OutputBytes(Message):
    """Bytes that a jail printed. Trust: raw; what lay before ``start`` is not kept any more."""

    start: int
    data: bytes


@_message(30)
@dataclass(frozen=True, slots=True)
class ExpireIdle(Message):
    """End a jail whose runners do nothing for so many milliseconds. Reply: ``Done``, or ``Died``.

    Whoever asks anything of it afterwards is told ``Died`` with the reason ``"idle"``.
    """

    jail: int
    idle_ms: int


@_message(31)
@dataclass(frozen=True, slots=True)
class OpenJailWith(OpenJail):
    """``OpenJail`` for a repository with packages of its own. The same replies.

    ``packages`` is a folder of them, for ``python``; that interpreter's own are not used. Nothing
    of it runs outside of the jail.
    """

    packages: str

    @property
    def runtime(self) -> Runtime:
        """What runs the repository."""
        return Runtime(self.python, self.packages)


# --- client and jail runner ----------------------------------------------------------------------


@_message(32)
@dataclass(frozen=True, slots=True)
class Load(Message):
    """Import the entry file and call its ``make_env``. Reply: ``Loaded`` or ``Raised``.

    ``cfg`` holds the ``vars()`` of the caller's config object, or None.
    """

    n_envs: int
    use_async_envs: bool
    cfg: dict[str, object] | None
    env_kwargs: dict[str, object]


@_message(33)
@dataclass(frozen=True, slots=True)
class Loaded(Message):
    """What the repository's ``make_env`` returned: see ``manifest.decode_manifest``."""

    manifest: dict[str, object]


@_message(34)
@dataclass(frozen=True, slots=True)
class Build(Message):
    """Build sub-environments ``start`` to ``stop`` of a task as ``env``. Reply: ``Built``.

    The reply's manifest is that of the built slice.
    """

    env: int
    suite: str
    task: object
    start: int
    stop: int


@_message(35)
@dataclass(frozen=True, slots=True)
class Built(Message):
    """The slice is ready: see ``manifest.decode_env``."""

    manifest: dict[str, object]


@_message(36)
@dataclass(frozen=True, slots=True)
class Reset(Message):
    """``seeds`` is None or one seed or None per sub-environment of the slice; so is ``mask``."""

    env: int
    seeds: object
    options: dict[str, object] | None
    mask: object


@_message(37)
@dataclass(frozen=True, slots=True)
class ResetDone(Message):
    """Batched observation and infos of the slice."""

    observation: object
    info: dict[object, object]


@_message(38)
@dataclass(frozen=True, slots=True)
class Step(Message):
    """The slice's batch of actions."""

    env: int
    actions: object


@_message(39)
@dataclass(frozen=True, slots=True)
class StepDone(Message):
    """Batched results of the slice."""

    observation: object
    rewards: object
    terminations: object
    truncations: object
    info: dict[object, object]


@_message(40)
@dataclass(frozen=True, slots=True)
class Call(Message):
    """``VectorEnv.call``: a method or attribute of every sub-environment. Reply: ``Value``."""

    env: int
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


@_message(41)
@dataclass(frozen=True, slots=True)
class SetAttr(Message):
    """One value per sub-environment of the slice. Reply: ``Value``."""

    env: int
    name: str
    values: tuple[object, ...]


@_message(42)
@dataclass(frozen=True, slots=True)
class Render(Message):
    """``VectorEnv.render``. Reply: ``Value`` with a tuple of frames or None."""

    env: int


@_message(43)
@dataclass(frozen=True, slots=True)
class GetOwn(Message):
    """An attribute of the vector environment itself. Reply: ``Value``, or ``Method``."""

    env: int
    name: str


@_message(44)
@dataclass(frozen=True, slots=True)
class Method(Message):
    """The attribute is callable; ``CallOwn`` calls it."""


@_message(45)
@dataclass(frozen=True, slots=True)
class CallOwn(Message):
    """Call a method of the vector environment itself. Reply: ``Value``."""

    env: int
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


@_message(46)
@dataclass(frozen=True, slots=True)
class GetRandom(Message):
    """Ask for the generators. Reply: ``Value``, one state each, or the one state there is."""

    env: int


@_message(47)
@dataclass(frozen=True, slots=True)
class Close(Message):
    """Close an environment. Reply: ``Value`` with None."""

    env: int


@_message(50)
@dataclass(frozen=True, slots=True)
class Attach(Message):
    """Serve an environment's steps over the slabs and doorbells that come along.

    The descriptors: request slab, reply slab, observation slab, the runner's doorbell, the
    client's. The shard's rows of a batch of ``count`` begin at ``start``. Reply: ``Value``; False
    where the environment has no fixed layout.
    """

    env: int
    start: int
    count: int
    slots: int


@_message(51)
@dataclass(frozen=True, slots=True)
class FetchInfos(Message):
    """Ask for the last step's infos, which did not fit the slab. Reply: ``Value``."""

    env: int


@_message(52)
@dataclass(frozen=True, slots=True)
class Revive(Message):
    """Reset all sub-environments in the place of others, which died in the middle of an episode.

    Reply: ``StepDone``: the fresh observations, rewards of zero, every episode truncated. What
    the next step does with those is as the autoreset mode says.
    """

    env: int
    seeds: object


@_message(54)
@dataclass(frozen=True, slots=True)
class FetchInfosApart(Message):
    """Ask for the last reset's or step's infos as each sub-environment gave them.

    For shards that do not agree about a key: the first sub-environment of all decides.
    Reply: ``Value`` of ``((index in the slice, info), ...)``.
    """

    env: int


@_message(53)
@dataclass(frozen=True, slots=True)
class LoadTask(Message):
    """As ``Load``, where the client knows what comes back: nothing is described, nor built for it.

    Reply: ``Value`` of the task's ``(num_envs, shardable)``, None if there is none, or ``Raised``.
    """

    n_envs: int
    use_async_envs: bool
    cfg: dict[str, object] | None
    env_kwargs: dict[str, object]
    suite: str
    task: object


@_message(48)
@dataclass(frozen=True, slots=True)
class Value(Message):
    """A result."""

    value: object


@_message(49)
@dataclass(frozen=True, slots=True)
class Raised(Message):
    """The repository's code raised. ``builtin`` is its nearest builtin ancestor."""

    builtin: str
    type_name: str
    message: str
    traceback: str
    stage: str
    """``"import"``, ``"make_env"``, ``"return"`` or the operation."""


# --- packing -----------------------------------------------------------------------------------

_OUTGOING: templates.Forms[Any, templates.Outgoing] = templates.Forms()
_INCOMING: templates.Forms[bytes, templates.Incoming[Message]] = templates.Forms()


def pack(
    message: Message,
    request_id: int,
    *,
    pickler: Callable[[object], bytes] | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
) -> list[Buffer]:
    """The frames of a message.

    Raises:
        LocalProtocolError: A field holds what the wire cannot carry; nothing was sent.
    """
    cls = type(message)
    values = [getattr(message, name) for name, _ in _CHECKS[cls]]
    found = templates.outline(values)
    if found is None:
        return encode([cls.kind, request_id, *values], pickler=pickler, limits=limits)
    outline, arrays = found
    form = _OUTGOING.get((cls, outline))
    if form is not None and form.limits is limits:
        return form.frames(request_id, arrays)
    frames = encode([cls.kind, request_id, *values], pickler=pickler, limits=limits)
    _OUTGOING.met((cls, outline), lambda: templates.Outgoing(frames, arrays, limits))
    return frames


def unpack(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Callable[[bytes], object] | None = None,
    tensors: Callable[[Any, str], object] | None = None,
) -> tuple[int, Message]:
    """The request id and the message of some frames.

    Raises:
        RemoteProtocolError: The peer broke the rules.
    """
    with UNTRUSTED:
        document, tail, buffers = split(frames, limits)
        plain = templates.without_id(document)
        if plain is None:
            return _decode(document, tail, buffers, limits, unpickler, tensors)
        key, packed_id = plain
        form = _INCOMING.get(key)
        if form is not None and form.limits is limits:
            return templates.read_id(packed_id), form.message(tail, buffers)
        request_id, message = _decode(document, tail, buffers, limits, unpickler, tensors)
        _INCOMING.met(key, lambda: templates.Incoming(document, type(message), limits))
        return request_id, message


def id_of(frame: Buffer) -> int | None:
    """The id of a header that may be unreadable otherwise; None if there is none.

    Trust: input from the other side. Only the first bytes are looked at.
    """
    head = msgpack.Unpacker(max_buffer_size=_HEAD_BYTES)
    head.feed(bytes(memoryview(frame).cast("B")[DOCUMENT_BYTES.size : _HEAD_BYTES]))
    try:
        items, kind, number = head.read_array_header(), head.unpack(), head.unpack()
    except Exception:  # whatever a decoder makes of noise
        return None
    if items < 2 or type(kind) is not int or type(number) is not int:
        return None
    return number if 0 < number < 1 << 63 else None


def _decode(
    document: bytes,
    tail: Buffer,
    buffers: list[Buffer],
    limits: WireLimits,
    unpickler: Callable[[bytes], object] | None,
    tensors: Callable[[Any, str], object] | None,
) -> tuple[int, Message]:
    value = decode_parts(document, tail, buffers, limits, unpickler, tensors)
    if type(value) is not list or len(value) < 2:
        raise RemoteProtocolError("a message is a list that starts with its kind and its id")
    kind, request_id, *rest = value
    cls = KINDS.get(kind) if type(kind) is int else None
    if cls is None or type(request_id) is not int or request_id.bit_length() > 63:
        raise RemoteProtocolError(f"unknown message kind {str(kind)[:40]!r}")
    _check_fields(cls, rest)
    return request_id, cls(*rest)


def _check_fields(cls: type[Message], values: list[object]) -> None:
    checks = _CHECKS[cls]
    if len(values) != len(checks):
        raise RemoteProtocolError(
            f"{cls.__name__} has {len(checks)} fields, the peer sent {len(values)}"
        )
    for (name, accepted), value in zip(checks, values, strict=True):
        if accepted is not None and type(value) not in accepted:
            raise RemoteProtocolError(
                f"{cls.__name__}.{name} cannot be of type {type(value).__name__}"
            )
