"""The value that frames hold, as ``codec.encoder.encode`` made them; a message has one, too."""

from collections.abc import Sequence

from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker, ThingReader, Unpickler
from envhub_worker.protocol.codec.wire import Buffer, split_frames
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits


def decode(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Unpickler | None = None,
    tensors: TensorMaker | None = None,
    things: ThingReader | None = None,
) -> object:
    document, tail, buffers = split_frames(frames, limits)
    return Decoder(tail, buffers, limits, unpickler, tensors, things).value(document)
