"""An environment that does what a random generator says. It travels to the sandbox by value."""

import datetime
import decimal
import enum
import fractions
import random
from typing import Any

import gymnasium as gym
import numpy as np


class Unhashable(enum.Enum):
    """Members can be keys, though their values cannot."""

    MAPPING = {"a": {1: 2}}  # noqa: RUF012
    LIST = [1, ["b"]]  # noqa: RUF012


class Level(enum.IntEnum):
    """Members are numbers, and cross as such."""

    LOW = 1
    HIGH = 2


class Mode(str, enum.Enum):
    """Members are texts, and cross as such."""

    FAST = "fast"
    SLOW = "slow"


ANY_KEYS = (
    *(*Unhashable, (1, (2,)), (Unhashable.MAPPING, 3), frozenset({3}), range(2), 1.5, 2**70, None),
    *(b"k", True, 2j, np.int8(3), np.str_("k"), np.datetime64("2024-05-06")),
    datetime.date(2024, 5, 6),
)
KEYS = ("a", "b", "speed", "episode", "is_success", "nothing", 7)
MEMBERS = (*Level, *Mode)
DTYPES = (np.int8, np.uint8, np.int32, np.int64, np.float16, np.float32, np.float64, np.bool_)


class Scripted(gym.Env[Any, Any]):
    """Observations are samples; what is told in infos, and when episodes end, is drawn.

    Args:
        observation_space, action_space: Its spaces.
        number: Of the case: decides all that is drawn, together with ``index``.
        index: Which of the sub-environments it is.
        variety: How often a key's value is of a kind that only this sub-environment has.
        reuses: Whether it fills the same arrays and mappings again and again.
        odd_rewards: Of what kinds its rewards are, but numbers.
        raises: How often a reset or a step raises, before anything has changed; then infos have
            values of one kind and dtype each, which any batch of rows can hold.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        number: int,
        index: int,
        variety: float,
        reuses: bool = False,
        odd_rewards: tuple[str, ...] = (),
        raises: float | None = None,
    ) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self.render_mode = "rgb_array"
        self.variety = variety
        self.note: Any = None
        self.held: Any = None
        self.number = number
        self.index = index
        self.odd_rewards = odd_rewards
        self.raises = raises
        self.count = 0
        self.buffers: Any = ({}, {}) if reuses else None
        self.draw = random.Random(f"{number} {index}")
        self.observation_space.seed(1000 * number % 2**31 + index)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """A sample, and how it was asked for."""
        super().reset(seed=seed)
        self.fail_now_and_then("reset")
        info = self.info()
        if options is not None and self.draw.random() < 0.5:
            info["options"] = said(options)
        return self.filled(self.observation_space.sample(), info)

    def step(self, action: Any) -> Any:
        """A sample; what the action was is told now and then."""
        self.fail_now_and_then("step")
        info = self.info()
        if self.draw.random() < 0.5:
            info["action"] = said(action)
        reward = self.draw.choice([0, 1.5, True, np.float32(0.1), self.np_random.random()])
        if self.odd_rewards and self.draw.random() < 0.3:
            reward = ODD_REWARDS[self.draw.choice(self.odd_rewards)]
        ends = self.draw.random()
        observation, info = self.filled(self.observation_space.sample(), info)
        return observation, reward, ends < 0.1, 0.1 < ends < 0.2, info

    def fail_now_and_then(self, name: str) -> None:
        """Raise as often as was said; which sub-environment, and how often it was asked."""
        self.count += 1
        if self.raises and self.draw.random() < self.raises:
            kind = self.draw.choice([ValueError, KeyError, RuntimeError, ZeroDivisionError])
            raise kind(f"{name} {self.count} of sub-environment {self.index}")

    def filled(self, observation: Any, info: dict[Any, Any]) -> tuple[Any, Any]:
        """An observation and an info, in the arrays and mappings of the last ones if it reuses."""
        if self.buffers is None:
            return observation, info
        buffers = refilled(self.buffers[0], observation), refilled(self.buffers[1], info)
        self.buffers = buffers
        return buffers

    def render(self) -> Any:
        return np.full((2, 3, 3), self.draw.randrange(256), np.uint8)

    def told(self, *args: Any, **kwargs: Any) -> Any:
        """What it was given, and a value of any kind."""
        return said((args, kwargs)), self.value(self.draw.choice(KINDS), 0)

    def keyed(self) -> Any:
        keys = random.Random(self.number).sample(ANY_KEYS, 3)
        return {key: {"inner": {key: self.number}} for key in keys}

    def holds(self) -> str:
        """What was set, in words: it may be what does not come back."""
        return said(self.held)

    def fails(self, kind: str) -> None:
        raise {"value": ValueError, "key": KeyError, "zero": ZeroDivisionError}[kind](self.number)

    def info(self) -> dict[Any, Any]:
        """Some of the keys, some with values of a kind of this sub-environment's own."""
        same = random.Random(self.number)  # for all sub-environments, in each step
        kinds = {key: same.choice(KINDS) for key in KEYS}
        found: dict[Any, Any] = {}
        for key in self.draw.sample(KEYS, self.draw.randrange(len(KEYS) + 1)):
            own = self.draw.random() < self.variety
            if self.raises is not None:
                found[key] = self.value(STEADY[KINDS.index(kinds[key]) % len(STEADY)], 0)
                continue
            found[key] = self.value(self.draw.choice(KINDS) if own else kinds[key], 0)
        return found

    def value(self, kind: str, depth: int) -> Any:
        draw = self.draw
        if kind == "steady":
            return DTYPES[self.number % len(DTYPES)](draw.randrange(100))
        if kind == "member":
            return draw.choice(MEMBERS)
        if kind == "scalar":
            return draw.choice(DTYPES)(draw.randrange(100))
        if kind == "array":
            # one shape for all sub-environments, most of the time
            shape = (2,) if draw.random() > self.variety / 4 else (3,)
            return np.full(shape, draw.randrange(100), DTYPES[self.number % len(DTYPES)])
        if kind == "objects":
            return draw.choice([np.array([draw.randrange(9), None, "x"]), np.array(None)])
        if kind in ("list", "tuple", "dict"):
            inner = SIMPLE if depth > 1 else KINDS
            items = [self.value(draw.choice(inner), depth + 1) for _ in range(draw.randrange(3))]
            if kind == "dict":
                keys = (*KEYS, *MEMBERS) if depth else KEYS
                return dict(zip(draw.sample(keys, len(items)), items, strict=True))
            return items if kind == "list" else tuple(items)
        simple: dict[str, Any] = {
            "int": draw.randrange(-(2**40), 2**40),
            "large": 2**70 + draw.randrange(9),
            "float": draw.choice([draw.random(), float("nan"), float("-inf"), -0.0]),
            "bool": draw.random() < 0.5,
            "text": draw.choice(["", "héllo", "word"]),
            "bytes": bytes([draw.randrange(256)]),
            "complex": complex(draw.random(), 1),
            "none": None,
            "set": frozenset({draw.randrange(3)}),
        }
        return simple[kind]


SIMPLE = ("int", "float", "bool", "text", "bytes", "complex", "none", "scalar", "set", "member")
STEADY = ("int", "float", "bool", "text", "bytes", "none", "steady", "array", "list", "tuple")
KINDS = (*SIMPLE, "array", "objects", "list", "tuple", "dict", "dict", "large")
ODD_REWARDS: dict[str, Any] = {
    "numbers": np.int64(3),
    "bool": np.bool_(True),
    "zero dimensions": np.array(0.25),
    "fraction": fractions.Fraction(1, 3),
    "decimal": decimal.Decimal("0.1"),
    "text": "1.5",
    "not finite": float("-inf"),
    "long": np.longdouble(0.1),
    "large": 2**70,
    "none": None,
    "list": [1.0, 2.0],
    "complex": 1j,
    "word": "word",
    "array": np.array([0.5, 1.5]),
}


def refilled(old: Any, new: Any) -> Any:
    """The old mapping or array with the new one's values, where it can hold them; else the new."""
    if type(old) is not type(new):
        return new
    if isinstance(new, dict):
        held = {key: refilled(old.get(key), item) for key, item in new.items()}
        old.clear()
        old.update(held)
        return old
    if isinstance(new, np.ndarray) and (old.dtype, old.shape) == (new.dtype, new.shape):
        old[...] = new
        return old
    return new


def said(value: Any) -> str:
    if isinstance(value, dict):
        inner = ", ".join(f"{key!r}: {said(item)}" for key, item in value.items())
    elif isinstance(value, (list, tuple)):
        inner = ", ".join(map(said, value))
    elif isinstance(value, (set, frozenset)):  # which have another order in another process
        inner = ", ".join(sorted(map(said, value)))
    elif isinstance(value, np.ndarray):
        inner = f"{value.dtype}{value.shape} {value.tolist()}"
    else:
        inner = repr(value)
    return f"{type(value).__name__}({inner})"
