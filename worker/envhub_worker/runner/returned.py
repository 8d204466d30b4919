"""Explains why a result of ``reset`` or ``step`` does not fit, and finds the line that returned it.

Gymnasium writes results into arrays, and numpy's errors name neither the call nor the space. The
call has returned by then, so this module finds the line in the source and calls nothing again.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import linecache
import os
from collections.abc import Iterator, Sequence
from types import CodeType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES

_SPACE_CHARS = 300
_MOST_LAYERS = 100
_CONVERTERS = {"observation": gym.ObservationWrapper, "reward": gym.RewardWrapper}
"""Gymnasium's wrappers whose subclasses define this method, in place of ``reset`` and ``step``."""
_NOT_THE_AUTHORS = tuple(
    os.path.dirname(os.path.abspath(path)) + os.sep for path in (gym.__file__, __file__)
)


def misfit(
    error: Exception,
    env: Any,
    method: str,
    index: int,
    result: Sequence[Any],
    space: gym.Space[Any],
    reward_shape: tuple[int, ...] = (),
) -> Exception:
    """Returns an error that says which part of a result does not fit, instead of numpy's error.

    Args:
        index: The sub-environment's index, counted over all workers.
        result: ``(observation, info)``, or ``(observation, reward, terminated, truncated, info)``.
        space: The observation space that the sub-environment had when it was made.
    """
    call = f"{method} of sub-environment {index} returned"
    for part, text in _misfits(call, env, index, result, space, reward_shape):
        kind = TypeError if isinstance(error, TypeError) else ValueError
        return raised_at(kind(text), env, method, part, result)
    return error


def _misfits(
    call: str, env: Any, index: int, result: Sequence[Any], space: Any, shape: tuple[int, ...]
) -> Iterator[tuple[str, str]]:
    """Yields a description of each part of a result that does not fit."""
    observation, *numbers, info = result
    for reward in numbers[:1]:
        if not _fits(reward, shape, np.float64):
            yield "reward", batches.reward_misfit(reward, index, shape)
    for name, flag in zip(("terminated", "truncated"), numbers[1:], strict=False):
        if not _fits(flag, (), np.bool_):
            yield name, f"{call} {batches.shown(flag)} as {name}, which has to be one bool"
    for path, sub, seen in parts(space, observation):
        position = f" as observation{path}" if path else ""
        declared = f"its observation_space{path} is {one_line(str(sub), _SPACE_CHARS)}"
        yield "observation", f"{call} {seen}{position}, {declared}{_changed(env, space)}"
    if not hasattr(info, "items"):
        yield "info", f"{call} {batches.shown(info)} as info, which has to be a dict"


def misfit_in_vector(error: Exception, env: Any, method: str) -> Exception:
    """Like ``misfit``, for a vector environment of a class derived from Gymnasium's, if an
    observation of one of its sub-environments does not fit.
    """
    with contextlib.suppress(Exception):
        for layer in _layers(env):
            members = zip(layer.envs, layer._env_obs, strict=True) if hasattr(layer, "envs") else ()
            for index, (member, observation) in enumerate(members):
                space = layer.single_observation_space
                named = misfit(error, member, method, index, (observation, {}), space)
                if named is not error:
                    return named
    return error


def _fits(value: Any, shape: tuple[int, ...], dtype: Any) -> bool:
    try:
        np.zeros((1, *shape), dtype)[0] = value
        return dtype is not np.bool_ or bool(value) in (True, False)
    except Exception:  # it may be of a class of the repository's
        return False


def parts(space: Any, value: Any, path: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yields the parts of an observation that cannot be written: path, space and description."""
    keys: Any = ()
    if isinstance(space, spaces.Dict):
        keys = space.spaces
    elif isinstance(space, spaces.Tuple):
        keys = range(len(space.spaces))
    elif isinstance(space, ARRAY_SPACES):
        if type(value) is np.ndarray and (value.shape, value.dtype) == (space.shape, space.dtype):
            return
        try:
            np.stack([value], out=np.empty((1, *(space.shape or ())), space.dtype))
        except Exception:
            yield path, space, batches.shown(value)
    for key in keys:
        try:
            part = value[key]
        except Exception:
            yield path, space, f"{batches.shown(value)} without {key!r}"
            return
        yield from parts(space[key], part, f"{path}[{key!r}]")


def _changed(env: Any, space: Any) -> str:
    """Returns a clause about the environment's current space if it differs from the first one."""
    try:
        now = env.observation_space
        return "" if now == space else f", and has become {one_line(str(now), _SPACE_CHARS)}"
    except Exception:
        return ""


def raised_at(
    error: Exception, env: Any, method: str, part: str = "", result: Sequence[Any] = ()
) -> Exception:
    """Returns the error with the line of the method's ``return`` at the end of its traceback.

    The outermost layer whose code is neither ours nor Gymnasium's made the result. If the method
    has several ``return`` statements, their literals decide which one it was; if these do not
    decide, the error shows the method's first line.
    """
    with contextlib.suppress(Exception):  # it is an environment's, which may have any attribute
        for layer in _layers(env):
            code = _code(type(layer), method, part)
            if code is not None:
                if layer is not env:  # Gymnasium's wrappers may change all parts but terminated
                    result = [value if at == 2 else ... for at, value in enumerate(result)]
                return _with_line(error, code, _line_of_return(code, result))
    return error


def _layers(env: Any) -> Iterator[Any]:
    for _ in range(_MOST_LAYERS):
        if env is None:
            return
        yield env
        env = getattr(env, "env", None)


def _code(cls: type, method: str, part: str) -> CodeType | None:
    """Returns the code that made this part of a result, unless it is Gymnasium's or ours."""
    converter = _CONVERTERS.get(part)
    converts = converter is not None and issubclass(cls, converter)
    for name in (method, part) if converts else (method,):
        function: Any = getattr(cls, name, None)
        code = getattr(inspect.unwrap(function), "__code__", None)
        if isinstance(code, CodeType) and not code.co_filename.startswith(_NOT_THE_AUTHORS):
            return code
    return None


def _line_of_return(code: CodeType, result: Sequence[Any]) -> int:
    try:
        tree = ast.parse("".join(linecache.getlines(code.co_filename)))
        functions: list[Any] = [node for node in ast.walk(tree) if _is_of(node, code)]
        [function] = functions
    except (MemoryError, RecursionError, SyntaxError, ValueError):
        return code.co_firstlineno
    returns = [node for node in _returns(function) if node.value is not None]
    likely = [node for node in returns if _may_be(node.value, result)]
    return likely[0].lineno if len(likely) == 1 else function.lineno


def _is_of(node: Any, code: CodeType) -> bool:
    if not isinstance(node, ast.FunctionDef) or node.name != code.co_name:
        return False
    begins = min([node.lineno, *(part.lineno for part in node.decorator_list)])
    return begins == code.co_firstlineno


def _returns(function: Any) -> Iterator[ast.Return]:
    """Yields a function's ``return`` statements, without those of nested functions."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Return):
            yield node
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield from _returns(node)


def _may_be(node: Any, result: Sequence[Any]) -> bool:
    """Whether an expression may have produced a result: none of its literals contradicts it."""
    if not isinstance(node, ast.Tuple) or len(node.elts) != len(result):
        return True
    return all(map(_is_like, node.elts, result))


def _is_like(node: Any, value: Any) -> bool:
    if value is ... or not isinstance(node, ast.Constant):
        return True
    return type(value) is type(node.value) and bool(value == node.value)


def _with_line(error: Exception, code: CodeType, line: int) -> Exception:
    """Returns an error whose traceback ends in a line, as if the line had raised it."""
    source = linecache.getline(code.co_filename, line).rstrip().encode()
    tree = ast.parse("raise error")
    for node in ast.walk(tree):  # all of the line, since Python 3.11 underlines a part
        if isinstance(node, (ast.stmt, ast.expr)):
            node.lineno = node.end_lineno = line
            node.col_offset, node.end_col_offset = len(source) - len(source.lstrip()), len(source)
    raising = compile(tree, code.co_filename, "exec").replace(co_name=code.co_name)
    try:
        exec(raising, {"error": error})
    except type(error) as raised:
        return raised
    return error
