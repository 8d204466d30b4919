"""Small pictures: what is shown is what was rendered, whatever its size."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from numpy.typing import NDArray

from envhub_sandbox.vector.pictures import png, small_picture


def pixels(data: bytes) -> NDArray[np.uint8]:
    """Those of a PNG with eight bits of RGB, as its standard says to read it."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    found, at = {}, 8
    while at < len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", data, at + 8 + length) == (zlib.crc32(name + body),)
        found[name], at = body, at + 12 + length
    width, height, *form = struct.unpack(">IIBBBBB", found[b"IHDR"])
    assert form == [8, 2, 0, 0, 0]
    lines = np.frombuffer(zlib.decompress(found[b"IDAT"]), np.uint8).reshape(height, -1)
    assert set(lines[:, 0].tolist()) == {2}, "each line is what is added to the one above"
    summed = np.cumsum(lines[:, 1:].astype(np.int64), axis=0) % 256
    return summed.astype(np.uint8).reshape(height, width, 3)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (9, 2, 3), (30, 40, 3)])
def test_a_png_has_the_very_pixels(shape: tuple[int, ...]) -> None:
    frame = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    assert np.array_equal(pixels(png(frame)), frame)
    assert np.array_equal(pixels(png(frame[::-1, ::-1])), frame[::-1, ::-1])


def test_a_pixel_is_the_mean_of_those_that_it_stands_for() -> None:
    frame = np.zeros((4, 6, 3), np.uint8)
    frame[:2, :2, 1] = [[0, 100], [200, 255]]
    small = small_picture(frame, 3)
    assert small.shape == (2, 3, 3)
    assert small[0, 0].tolist() == [0, 139, 0]
    assert not small[1:].any()
    assert small_picture(frame, 6) is frame, "nothing is enlarged"


@pytest.mark.parametrize("size", [(1, 4096), (4096, 1), (2, 321), (4096, 4096), (319, 4095)])
def test_no_side_is_longer_and_none_is_nothing(size: tuple[int, int]) -> None:
    small = small_picture(np.zeros((*size, 3), np.uint8), 320)
    assert min(small.shape[:2]) >= 1
    assert max(small.shape[:2]) <= 320
