"""Random spaces, of every kind that Gymnasium has."""

from collections.abc import Callable
from random import Random
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

Space = gym.Space[Any]
_FLAT = ("box", "discrete", "multi_discrete", "multi_binary")
_LOOSE = ("text", "sequence", "graph", "one_of")
_DEEP = ("dict", "tuple")
_FLOATS = (np.float16, np.float32, np.float64)
_INTEGERS = (np.int8, np.uint8, np.int16, np.int32, np.int64)
_DEPTH = 2


def space(draw: Random, *, loose: bool, depth: int = 0, least: int = 1) -> Space:
    """A random space; only if it may be ``loose``, one that has no fixed layout. Composite ones
    have at least so many members."""
    kinds = [*_FLAT, *(_LOOSE if loose else ()), *(_DEEP if depth < _DEPTH else ())]
    kind = draw.choice(kinds)
    if kind in _DEEP:
        count = draw.randrange(least, 4)
        inner = [space(draw, loose=loose, depth=depth + 1, least=least) for _ in range(count)]
        if kind == "tuple":
            return spaces.Tuple(inner)
        return spaces.Dict(dict(zip(draw.sample("zyxab", len(inner)), inner, strict=True)))
    return _ONE[kind](draw)


def flat_space(draw: Random) -> Space:
    return _ONE[draw.choice(_FLAT)](draw)


def _box(draw: Random) -> Space:
    shape = draw.choice([(), (1,), (3,), (2, 2), (0,)])
    if draw.random() < 0.6:
        bound = draw.choice([1.0, 5.0, float(np.inf)])
        return spaces.Box(-bound, bound, shape, draw.choice(_FLOATS))
    return spaces.Box(0, draw.choice([1, 100]), shape, draw.choice(_INTEGERS))


def _graph(draw: Random) -> Space:
    edges = draw.choice([None, spaces.Discrete(4), spaces.Box(0, 1, (2,))])
    return spaces.Graph(draw.choice([spaces.Box(-1, 1, (2,)), spaces.Discrete(3)]), edges)


_ONE: dict[str, Callable[[Random], Space]] = {
    "box": _box,
    "discrete": lambda draw: spaces.Discrete(
        draw.randrange(1, 9), start=draw.choice([0, 0, -3, 5])
    ),
    "multi_discrete": lambda draw: spaces.MultiDiscrete(
        draw.choice([[3], [2, 5], [[3, 4], [5, 6]]]), dtype=draw.choice([np.int32, np.int64])
    ),
    "multi_binary": lambda draw: spaces.MultiBinary(draw.choice([1, 4, [2, 3]])),
    "text": lambda draw: spaces.Text(
        draw.randrange(1, 6), charset=draw.choice(["ab", "héß", "xyz0123"])
    ),
    "sequence": lambda draw: spaces.Sequence(flat_space(draw), stack=draw.random() < 0.3),
    "graph": _graph,
    "one_of": lambda draw: spaces.OneOf([flat_space(draw) for _ in range(draw.randrange(1, 4))]),
}
