"""What programs do with any object that they meet, and which names they look for in it then."""

from __future__ import annotations

import collections
import contextlib
import copy
import dataclasses
import functools
import importlib
import inspect
import io
import json
import logging
import os
import pickle
import pprint
import pydoc
import reprlib
import typing
import unittest.mock
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

Act = Callable[[Any], object]


class Spy:
    """An object that has nothing, and notes what it is asked for."""

    def __init__(self) -> None:
        self.asked: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        if name == "asked":
            raise AttributeError(name)
        self.asked.add(name)
        raise AttributeError(name)


def _of(module: str, act: Callable[[Any, Any], object]) -> Act:
    """Something that a library does, where it is installed."""

    def run(thing: Any) -> object:
        return act(importlib.import_module(module), thing)

    return run


_OURS: tuple[Act, ...] = (
    *(
        copy.copy,
        copy.deepcopy,
        pickle.dumps,
        json.dumps,
        hash,
        repr,
        str,
        dir,
        callable,
        len,
        bool,
    ),
    *(
        bool,
        int,
        float,
        complex,
        bytes,
        memoryview,
        list,
        dict,
        set,
        next,
        reversed,
        round,
        os.fspath,
    ),
    *(pprint.pformat, reprlib.repr, pydoc.render_doc, weakref.ref, vars, collections.Counter),
    *(inspect.getmembers, inspect.signature, inspect.getdoc, inspect.unwrap, inspect.isawaitable),
    *(inspect.isabstract, dataclasses.is_dataclass, functools.partial, typing.get_type_hints),
    *(unittest.mock.create_autospec, "{:>3}".format, logging.getLogger(__name__).debug),
    lambda thing: (lambda **rest: rest)(**thing),
    lambda thing: isinstance(1, thing),
    lambda thing: functools.wraps(thing)(lambda: None),
    lambda thing: logging.getLogger(__name__).error("%s %r", thing, thing),
    lambda thing: sum([thing]),
    lambda thing: sorted([thing, thing]),
)
_NUMPYS: tuple[Act, ...] = (
    *(np.asarray, np.dtype, np.zeros_like, np.isnan, np.from_dlpack, np.iterable, np.copy),
    lambda thing: np.array([thing], object),
    lambda thing: np.asarray(thing, float),
    lambda thing: np.stack([thing, thing]),
    lambda thing: np.add(thing, 1),
    lambda thing: np.array_equal(thing, thing),
    lambda thing: np.testing.assert_equal(thing, thing),
    lambda thing: np.save(io.BytesIO(), thing),
)
_OTHERS: tuple[Act, ...] = (
    _of("IPython.core.formatters", lambda m, it: m.DisplayFormatter().format(it)),
    _of("IPython.core.oinspect", lambda m, it: m.Inspector().info(it, detail_level=1)),
    _of("IPython.core.oinspect", lambda m, it: m.Inspector().pdoc(it)),
    _of("IPython.utils.dir2", lambda m, it: m.dir2(it)),
    _of("IPython.lib.pretty", lambda m, it: m.pretty(it)),
    _of("rich.pretty", lambda m, it: m.pretty_repr(it)),
    _of("rich", lambda m, it: m.print(it, file=io.StringIO())),
    _of("torch", lambda m, it: m.as_tensor(it)),
    _of("torch", lambda m, it: m.tensor(it)),
    _of("torch", lambda m, it: m.from_dlpack(it)),
    _of("torch", lambda m, it: m.add(m.zeros(1), it)),
    _of("torch", lambda m, it: m.save(it, io.BytesIO())),
    _of("torch.utils.data", lambda m, it: m.default_collate([it])),
    _of("torch.utils.data._utils.pin_memory", lambda m, it: m.pin_memory(it)),
    _of("torch.utils._pytree", lambda m, it: m.tree_flatten(it)),
    _of("markupsafe", lambda m, it: m.escape(it)),
    _of("jinja2", lambda m, it: m.Template("{{ it }}").render(it=it)),
    _of("sympy", lambda m, it: m.sympify(it)),
    _of("cloudpickle", lambda m, it: m.dumps(it)),
    _of("msgpack", lambda m, it: m.packb(it)),
    _of("pandas", lambda m, it: m.DataFrame({"a": [it]}).to_string()),
    _of("gymnasium.utils.env_checker", lambda m, it: m.data_equivalence(it, it)),
    _of("hypothesis.vendor.pretty", lambda m, it: m.pretty(it)),
    _of("_pytest._io.saferepr", lambda m, it: m.saferepr(it)),
    _of("pytest", lambda m, it: m.approx(it) == 1),
)
CANARIES = frozenset({"awehoi234_wdfjwljet234_234wdfoijsdfmmnxpi492"})
"""Names that nobody has: rich asks for it, and asks for nothing else of whoever has it."""


def names_asked_for() -> set[str]:
    """Every name that one of these acts looks for, by trying them all."""
    asked: set[str] = set()
    for act in (*_OURS, *_NUMPYS, *_OTHERS):
        spy = Spy()
        # most of them fail on such a thing, in as many ways
        with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
            act(spy)
        asked |= spy.asked
    return asked - CANARIES
