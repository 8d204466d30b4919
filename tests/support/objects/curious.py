"""What programs do with any object that they meet, and which names they look for in it then."""

import collections
import contextlib
import copy
import csv
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


def _of(module: str, *acts: Callable[[Any, Any], object]) -> tuple[Act, ...]:
    """What a library does, where it is installed."""

    def run(act: Callable[[Any, Any], object], thing: Any) -> object:
        return act(importlib.import_module(module), thing)

    return tuple(functools.partial(run, act) for act in acts)


Given = Callable[[Any, Any], tuple[Any, tuple[Any, ...]]]
_THING: Given = lambda module, thing: (module, (thing,))  # noqa: E731


def _named(module: str, names: str, given: Given = _THING) -> tuple[Act, ...]:
    """Functions of a library; ``given`` says whose they are and what they take."""

    def run(name: str, library: Any, thing: Any) -> object:
        owner, arguments = given(library, thing)
        return getattr(owner, name)(*arguments)

    return _of(module, *(functools.partial(run, name) for name in names.split()))


@dataclasses.dataclass
class Config:
    """What a program keeps an environment in."""

    env: object


_OURS: tuple[Act, ...] = (
    *(copy.copy, copy.deepcopy, pickle.dumps, json.dumps, hash, repr, str, dir, callable, len),
    *(bool, int, float, complex, bytes, memoryview, list, dict, set, next, reversed, round),
    *(os.fspath, pprint.pformat, reprlib.repr, pydoc.render_doc, weakref.ref, vars),
    *(collections.Counter, inspect.getmembers, inspect.signature, inspect.getdoc, inspect.unwrap),
    *(inspect.isawaitable, inspect.isabstract, dataclasses.is_dataclass, functools.partial),
    *(typing.get_type_hints, unittest.mock.create_autospec, "{:>3}".format),
    logging.getLogger(__name__).debug,
    lambda thing: (lambda **rest: rest)(**thing),
    lambda thing: isinstance(1, thing),
    lambda thing: functools.wraps(thing)(lambda: None),
    lambda thing: logging.getLogger(__name__).error("%s %r", thing, thing),
    lambda thing: sum([thing]),
    lambda thing: sorted([thing, thing]),
    lambda thing: json.dumps({"env": thing}, default=str),
    lambda thing: dataclasses.asdict(Config(thing)),
    lambda thing: dataclasses.replace(Config(thing)),
    lambda thing: csv.writer(io.StringIO()).writerow([thing]),
    lambda thing: [isinstance(thing, kind) for kind in vars(collections.abc).values()],
)
_NUMPYS: tuple[Act, ...] = (
    *(np.asarray, np.dtype, np.zeros_like, np.isnan, np.from_dlpack, np.iterable, np.copy),
    *(np.size, np.shape, np.ndim, np.isscalar, np.iscomplexobj, np.isreal, np.array2string),
    *(np.atleast_1d, np.result_type, np.float32),
    lambda thing: np.array([thing], object),
    lambda thing: np.array([thing, [thing]], object),
    lambda thing: np.asarray(thing, float),
    lambda thing: np.stack([thing, thing]),
    lambda thing: np.add(thing, 1),
    lambda thing: np.zeros(2) == thing,
    lambda thing: np.full(2, thing),
    lambda thing: np.array_equal(thing, thing),
    lambda thing: np.testing.assert_equal(thing, thing),
    lambda thing: np.save(io.BytesIO(), thing),
    lambda thing: np.savez(io.BytesIO(), thing),
)
_PANDAS = (
    *_named(
        "pandas",
        "to_string to_html to_json to_csv to_dict to_numpy to_records describe info isna nunique "
        "drop_duplicates sum copy explode convert_dtypes to_markdown",
        lambda m, it: (m.DataFrame({"a": [it]}), ()),
    ),
    *_named(
        "pandas",
        "unique value_counts factorize to_list mean max describe",
        lambda m, it: (m.Series([it, it]), ()),
    ),
    *_named("pandas", "DataFrame Series Index array isna to_numeric to_datetime unique"),
    *_named(
        "pandas.api.types",
        "is_list_like is_dict_like is_scalar is_array_like is_hashable is_iterator is_file_like "
        "is_named_tuple is_number is_numeric_dtype is_object_dtype is_extension_array_dtype",
    ),
    *_of(
        "pandas",
        lambda m, it: m.Series([it]) == it,
        lambda m, it: m.Series([1]) + it,
        lambda m, it: m.DataFrame({"a": [1]}).assign(b=it),
        lambda m, it: m.DataFrame([it]),
        lambda m, it: m.json_normalize([{"a": {"b": it}}]),
        lambda m, it: m.DataFrame({"a": [it]}).to_json(orient="records", default_handler=str),
    ),
)


def _drawn(act: Callable[[Any, Any], object]) -> Act:
    """An act on axes, which are drawn then."""

    def run(thing: Any) -> None:
        backend: Any = importlib.import_module("matplotlib.backends.backend_agg")
        figure: Any = importlib.import_module("matplotlib.figure").Figure()
        act(figure.subplots(), thing)
        backend.FigureCanvasAgg(figure).draw()

    return run


def _plotted(names: str, *before: object) -> tuple[Act, ...]:
    """Methods of axes with ``before`` and the thing."""

    def run(name: str, axes: Any, thing: Any) -> None:
        getattr(axes, name)(*before, thing)

    return tuple(_drawn(functools.partial(run, name)) for name in names.split())


_MATPLOTLIBS = (
    *_plotted("plot hist imshow pie boxplot set_title set_xlabel matshow stem legend"),
    *_plotted("plot scatter bar errorbar step", [1]),
    *_plotted("text", 0, 0),
    _drawn(lambda axes, it: axes.plot([it])),
    _drawn(lambda axes, it: axes.plot([1], label=it)),
    _drawn(lambda axes, it: axes.scatter([1], [1], c=it)),
    _drawn(lambda axes, it: axes.bar([it], [1])),
    _drawn(lambda axes, it: axes.table([[it]])),
)


def _inspector(module: Any) -> Any:
    """What answers ``thing?`` in IPython; from 9 on it has to be told of colours."""
    takes = inspect.signature(module.Inspector).parameters
    return module.Inspector(**({"theme_name": "nocolor"} if "theme_name" in takes else {}))


def _console() -> Any:
    return importlib.import_module("rich.console").Console(file=io.StringIO(), width=100)


_SHOWN: tuple[Act, ...] = (
    *_of("IPython.core.formatters", lambda m, it: m.DisplayFormatter().format(it)),
    *_of("IPython.core.oinspect", lambda m, it: _inspector(m).info(it, detail_level=1)),
    *_of("IPython.core.oinspect", lambda m, it: _inspector(m).pdoc(it)),
    *_named("IPython.utils.dir2", "dir2"),
    *_named("IPython.lib.pretty", "pretty"),
    *_named("rich.pretty", "pretty_repr"),
    lambda it: _console().print(it, [it], {"a": it}),
    lambda it: _console().log(it, log_locals=True),
    lambda it: importlib.import_module("rich").inspect(it, console=_console(), all=True),
    lambda it: _console().print(importlib.import_module("rich.columns").Columns([it])),
    lambda it: _console().print(importlib.import_module("rich.scope").render_scope({"a": it})),
    *_named("markupsafe", "escape"),
    *_of("jinja2", lambda m, it: m.Template("{{ it }}").render(it=it)),
    *_of("tabulate", lambda m, it: m.tabulate([[it]]), lambda m, it: m.tabulate({"a": [it]})),
    *_named("hypothesis.vendor.pretty", "pretty"),
    *_named("_pytest._io.saferepr", "saferepr"),
    *_named("_pytest.assertion.rewrite", "_saferepr _format_assertmsg _should_repr_global_name"),
    *_named(
        "_pytest.assertion.util",
        "_compare_eq_any",
        lambda m, it: (m, (it, it, lambda text, **_: text, 2)),
    ),
    *_of("pytest", lambda m, it: m.approx(it) == 1),
    *_of("tqdm", lambda m, it: m.tqdm([1], file=io.StringIO()).set_postfix(a=it)),
    *_of("tqdm", lambda m, it: len(m.tqdm(it, file=io.StringIO()))),
    *_named(
        "wandb.util",
        "json_friendly json_friendly_val json_dumps_safer make_json_if_not_number "
        "make_safe_for_json maybe_compress_summary",
    ),
    *_of("spyder_kernels.utils.nsview", lambda m, it: m.get_size(it)),
)
_CONVERTED: tuple[Act, ...] = (
    *_named("torch", "as_tensor tensor from_dlpack from_numpy is_tensor asarray"),
    *_of("torch", lambda m, it: m.tensor([it]), lambda m, it: m.add(m.zeros(1), it)),
    *_of("torch", lambda m, it: m.zeros(1) == it, lambda m, it: m.save(it, io.BytesIO())),
    *_of("torch.utils.data", lambda m, it: m.default_collate([it])),
    *_named("torch.utils.data", "default_convert"),
    *_named("torch.utils.data._utils.pin_memory", "pin_memory"),
    *_named("torch.utils._pytree", "tree_flatten"),
    *_named("jax", "device_put block_until_ready"),
    *_named("jax.numpy", "asarray"),
    *_named("tensorflow", "convert_to_tensor is_tensor"),
    *_named("scipy.sparse", "issparse"),
    *_named("sympy", "sympify"),
    *_named("cloudpickle", "dumps"),
    *_named("dill", "dumps"),
    *_named("joblib", "hash"),
    *_named("dask.base", "tokenize is_dask_collection"),
    *_named("msgpack", "packb"),
    *_named("yaml", "dump safe_dump"),
    *_of("simplejson", lambda m, it: m.dumps(it, for_json=True)),
    *_named("ujson", "dumps"),
    *_named("msgspec", "to_builtins"),
    *_of("pyarrow", lambda m, it: m.array([it]), lambda m, it: m.scalar(it)),
    *_of("polars", lambda m, it: m.Series([it])),
    *_named("xarray", "_repr_html_", lambda m, it: (m.Dataset(attrs={"a": it}), ())),
    *_of("omegaconf", lambda m, it: m.OmegaConf.create({"a": it}, flags={"allow_objects": True})),
    *_of("gymnasium.utils.env_checker", lambda m, it: m.data_equivalence(it, it)),
)
ACTS: tuple[Act, ...] = (*_OURS, *_NUMPYS, *_PANDAS, *_MATPLOTLIBS, *_SHOWN, *_CONVERTED)
"""An environment is put into containers, logs and tables, shown, copied, compared, and taken for
an array. Not here: what takes it for a file, a figure, a module, a date or a text that is written
to, drawn on, trained or parsed, which is a mistake of who hands it there."""


def do(act: Act, thing: object) -> None:
    """An act, whatever comes of it: most fail on such a thing, in as many ways."""
    with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
        act(thing)


@functools.cache
def names_asked_for() -> set[str]:
    """Every name that one of these acts looks for, by trying them all."""
    spy = Spy()
    for act in ACTS:
        do(act, spy)
    return spy.asked
