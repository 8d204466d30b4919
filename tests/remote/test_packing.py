"""Large frames travel compressed where both sides can, and bombs do not go off."""

from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.messages import compression
from tests.remote.listening import Listening
from tests.remote.relay import relay
from tests.support.repositories import STILL, write_repository

lz4 = pytest.importorskip("lz4.block", reason="needs lz4: pip install lz4")
LIMITS = WireLimits(frame_bytes=1 << 20, message_bytes=2 << 20)
SMOOTH = bytes(1 << 18)
NOISE = np.random.default_rng(0).bytes(1 << 18)


def test_what_is_packed_is_the_same_again() -> None:
    """Small and noisy frames travel as they are, beside one that shrinks."""
    array = np.zeros((64, 64, 3), np.float32)
    frames = [b"header", SMOOTH, NOISE, memoryview(array)]
    packed = compression.pack_frames(frames, "lz4")
    assert sum(memoryview(frame).nbytes for frame in packed) < len(NOISE) + 20_000
    assert compression.unpack_frames(packed, LIMITS) == [b"header", SMOOTH, NOISE, array.tobytes()]


@pytest.mark.parametrize("frames", [[b"small"], [NOISE], [bytes(compression.SMALLEST - 1)]])
def test_what_does_not_pay_is_left_alone(frames: list[bytes]) -> None:
    assert compression.pack_frames(frames, "lz4") == frames
    assert compression.pack_frames(frames, "") == frames


def packed_by_hand(sizes: tuple[int, ...], *bodies: bytes, name: str = "lz4") -> list[bytes]:
    """A message as a liar would write it."""
    return [*map(bytes, m.pack_header(m.CompressionHeader(name, sizes), 0)), *bodies]


@pytest.mark.parametrize(
    ("frames", "error"),
    [
        (packed_by_hand((1 << 40,), b"x"), MessageTooLargeError),
        (packed_by_hand((1 << 20,) * 3, b"x", b"x", b"x"), MessageTooLargeError),
        (packed_by_hand((10,), lz4.compress(SMOOTH, store_size=False)), RemoteProtocolError),
        (packed_by_hand((1 << 19,), lz4.compress(SMOOTH, store_size=False)), RemoteProtocolError),
        (packed_by_hand((100,), b"no lz4 at all"), RemoteProtocolError),
        (packed_by_hand((-2,), b"x"), RemoteProtocolError),
        (packed_by_hand((1, 2), b"x"), RemoteProtocolError),
        (packed_by_hand(("a",), b"x"), RemoteProtocolError),
        (packed_by_hand((1,), b"x", name="zip"), RemoteProtocolError),
    ],
)
def test_a_lie_about_a_size_is_refused(frames: list[bytes], error: type[Exception]) -> None:
    """Before anything of that size is allocated, and never as another message."""
    with pytest.raises(error):
        compression.unpack_frames(frames, LIMITS)


def test_no_size_makes_the_others_seem_small() -> None:
    """All are looked at before the first is unpacked: a negative one would lessen their sum."""
    frames = packed_by_hand((1 << 20, 1 << 20, 1 << 20, -(1 << 20)), *[b"x"] * 4)
    with pytest.raises(RemoteProtocolError, match="an invalid size"):
        compression.unpack_frames(frames, LIMITS)


def test_images_take_less_of_a_wire_than_they_hold(server: Listening, tmp_path: Path) -> None:
    images = write_repository(tmp_path / "images", STILL + _IMAGES)
    with (
        relay(server.port) as wire,
        make_env(images, sandbox=server.sandbox(endpoint=wire.endpoint)) as suites,
    ):
        observation, _ = suites.env.reset(seed=1)
        assert observation.shape == (1, 256, 256, 3)
        assert (observation == 7).all()
        before = wire.received
        for _ in range(4):
            observation = suites.env.step(suites.env.action_space.sample())[0]
        assert (observation == 7).all()
        assert wire.received - before < observation.nbytes


_IMAGES = """
class Images(Still):
    observation_space = gym.spaces.Box(0, 255, (256, 256, 3), np.uint8)
    def reset(self, *, seed=None, options=None):
        return np.full((256, 256, 3), 7, np.uint8), {}
    def step(self, action):
        return np.full((256, 256, 3), 7, np.uint8), 0.0, False, False, {}
"""
