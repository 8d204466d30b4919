"""Values to frames and back. ``docs/values.md`` is the reference of the encoding.

The first frame holds a msgpack document and the bytes of small arrays; each large array is a
frame of its own. What msgpack has no type for is either an extension (arrays, numpy scalars, big
integers) or an array whose first element is an extension that says what the rest is (tuples,
sets, ranges). Nothing that ``decode`` is given can make it execute anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker, ThingReader, Unpickler
from envhub_worker.protocol.codec.encoder import Describer, Encoder, Pickler
from envhub_worker.protocol.codec.frames import check_outgoing_frames, split_frames
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.codec.kinds import Buffer
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits

__all__ = ["Buffer", "RemoteEnum", "RemoteObject", "decode", "encode"]


def encode(
    value: object,
    *,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
    names: Sequence[str] = (),
    describer: Describer | None = None,
    reduces: bool = False,
) -> list[Buffer]:
    """Encodes a value as frames: the header, then one per large array.

    Args:
        value: Plain Python values, numpy arrays and scalars, torch tensors, nested in any way.
            Anything else crosses as ``RemoteObject``.
        pickler: Encodes objects that have no form of their own instead. Client to worker only.
        limits: What the receiver accepts.
        names: What to call the elements of the value in an error.
        describer: Describes what the receiver can make again. Worker to client only.
        reduces: Whether a ``RemoteObject`` may stand in the place of a part that cannot be sent.

    Returns:
        Frames to be sent in this order. Large contiguous arrays are not copied, and must
        not be written until the frames are sent.

    Raises:
        LocalProtocolError: The value is cyclic, too deep, too large, or holds a dtype that
            cannot cross. The text names the path to the offender. Nothing was sent.
    """
    encoder = Encoder(pickler, limits, describer)
    try:
        frames = encoder.frames(value)
        if reduces:
            check_outgoing_frames(frames, limits)
    except Exception as error:
        if reduces and type(value) is list:
            smaller = _reduced_frames(value, limits, describer)
            if smaller is not None:
                return smaller
        # Objects' own code runs here (__array__, iteration): anything can come out of it.
        from envhub_worker.protocol.codec.explain import explain

        raise LocalProtocolError(explain(value, error, limits, pickler, names)) from error
    check_outgoing_frames(frames, limits)
    return frames


def _reduced_frames(
    message: list[Any], limits: WireLimits, describer: Describer | None
) -> list[Buffer] | None:
    """Those of the message without what cannot be sent; None where that does not help."""
    from envhub_worker.protocol.codec.reduced import reduced

    def sendable(value: object) -> bool:
        try:
            check_outgoing_frames(Encoder(None, limits, describer).frames(value), limits)
        except Exception:
            return False
        return True

    try:
        frames = Encoder(None, limits, describer).frames(reduced(message, sendable, limits))
        check_outgoing_frames(frames, limits)
    except Exception:
        return None
    return frames


def decode(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Unpickler | None = None,
    tensors: TensorMaker | None = None,
    copy: bool = True,
    things: ThingReader | None = None,
) -> object:
    """Decodes frames into the value that was encoded.

    Trust: input from the worker. Sizes are checked before anything is allocated, every byte
    must be accounted for, and nothing is executed.

    Args:
        frames: As ``encode`` returned them.
        limits: What is accepted.
        unpickler: Decodes pickled objects; only a worker, which trusts its client, has one.
        tensors: Makes a tensor of an array and a dtype name (``"bfloat16"`` comes as uint16
            bits). Without it tensors come as arrays, bfloat16 as float32.
        copy: Arrays own their memory and can be written. Otherwise they are read-only and the
            large ones are views of ``frames``.
        things: Begins to make what is described. Decoders without it refuse descriptions.

    Raises:
        MessageTooLargeError: Over one of ``limits``.
        RemoteProtocolError: Malformed in any other way.
    """
    document, tail, buffers = split_frames(frames, limits)
    return Decoder(tail, buffers, limits, unpickler, tensors, things, copy).value(document)
