"""The only importer of repository code: imports the entry file and calls its ``make_env``.

The entry becomes the module ``hub_env.<path>``, a real importable name, so that dataclasses with
postponed annotations, ``from .sibling import x``, and pickling of the repository's classes to its
own child processes work; its folder and the repository's root are importable too (``import
sibling``). Followed: LeRobot's ``_import_hub_module`` and ``_call_make_env``.

``config_of`` rebuilds a caller's config object from plain values. Each object comes with the names
of its class and of that class's bases. If the class can be imported here, it is used; otherwise a
dataclass of the same name, which inherits from the nearest base that can be imported.
Followed: ``dataclasses.make_dataclass``.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import MISSING, field, fields, is_dataclass, make_dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from envhub_worker.protocol.messages import CONFIG_CLASS, Load, LoadTask
from envhub_worker.runner import gymnasium_compat as compat


class ConfigMapping(dict[str, Any]):
    """Stands for a mapping other than dict: ``cfg.a["b"]`` and ``cfg.a.b`` both work."""

    def __init__(self, values: Any) -> None:
        super().__init__(values)
        self.__dict__ = self


def config_of(value: object) -> Any:
    """Rebuilds a config object, or another config value, from its plain value."""
    if isinstance(value, (list, tuple)):
        return type(value)(config_of(item) for item in value)
    if not isinstance(value, dict):
        return value
    members = {key: config_of(item) for key, item in value.items() if key != CONFIG_CLASS}
    described: Any = value.get(CONFIG_CLASS)
    if described is None:
        return members
    names, field_names, computed = described
    if not names:
        return ConfigMapping(members)
    if field_names is None:  # an enum's member, or a path
        cls = _class_named(*names[0])
        return members["value"] if cls is None else cls(members["value"])
    return _instance(names, field_names, members, config_of(computed))


def _instance(names: Any, field_names: Any, values: dict[str, Any], computed: Any) -> Any:
    cls = _class_named(*names[0])
    if cls is not None:
        with contextlib.suppress(Exception):  # it cannot be made without its arguments
            return _filled(cls, values)
    classes = (_class_named(*names_of_class) for names_of_class in names[1:])
    for base in (next(filter(None, classes), None), None):
        with contextlib.suppress(Exception):  # of a kind that no dataclass can inherit from
            return _filled(_stand_in(names[0], base, field_names, computed), values)
    raise TypeError(f"cfg: {names[0][1]} cannot be made from {', '.join(values)}")


def _filled(cls: type[Any], values: dict[str, Any]) -> Any:
    """Makes an instance with these attributes like unpickling: runs no constructor of its class."""
    instance: Any = cls.__new__(cls)  # type: ignore[call-overload]
    for item in fields(cls) if is_dataclass(cls) else ():
        if item.name not in values and not hasattr(instance, item.name):
            absent = None if item.default_factory is MISSING else item.default_factory()
            object.__setattr__(instance, item.name, absent)
    for name, value in values.items():
        object.__setattr__(instance, name, value)
    return instance


def _stand_in(
    name: tuple[str, str], base: type[Any] | None, field_names: Iterable[str], computed: Any
) -> type[Any]:
    parameters: Any = getattr(base, "__dataclass_params__", None)
    namespace = {"__module__": name[0], **computed}
    if name[0].startswith("lerobot."):  # which is not imported for it, but may be later
        namespace["__class__"] = property(lambda self: _loaded_class(*name) or type(self))
    stand_in = make_dataclass(
        name[1].rpartition(".")[2],
        [(name, Any, field(default=None)) for name in field_names],
        bases=() if base is None else (base,),
        namespace=namespace,
        kw_only=True,
        frozen=bool(parameters and parameters.frozen),
    )
    stand_in.__module__ = name[0]
    stand_in.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]  # its methods stayed there
    return stand_in


PACKAGE = "hub_env"


class EntryError(AttributeError):
    """The entry file has no usable ``make_env``."""


class ArgumentsError(TypeError):
    """The arguments of the call do not fit the signature of ``make_env``."""


def import_entry(snapshot: str, entry: str, scratch: str) -> Callable[..., Any]:
    """Imports the entry file and returns its ``make_env``; ``scratch`` is a folder that lasts.

    Raises ``EntryError`` if there is no callable ``make_env``, and whatever the repository raises.
    """
    path = PurePosixPath(entry)
    root = Path(snapshot)
    folder, parts = _package_of(root, path)
    _make_importable(root, root / path.parent, scratch, folder)
    compat.restore_numpys_names()
    module = importlib.import_module(".".join([PACKAGE, *parts]))
    make_env = getattr(module, "make_env", None)
    if not callable(make_env):
        kind = f"{type(make_env).__module__}.{type(make_env).__qualname__}"
        import difflib  # late: few need it

        close = difflib.get_close_matches("make_env", vars(module), 1)
        meant = f" (did you mean {close[0]!r}?)" if close else ""
        lacks = f"it has no such name{meant}" if make_env is None else f"its make_env is a {kind}"
        raise EntryError(
            f"{entry} must expose `make_env(n_envs=int, use_async_envs=bool)`; {lacks}"
        )
    return make_env  # type: ignore[no-any-return]


def call_make_env(make_env: Callable[..., Any], request: Load | LoadTask) -> Any:
    """Calls ``make_env`` with those of our arguments that it takes.
    Raises ``ArgumentsError``: it requires others, or does not take the caller's ``env_kwargs``.
    """
    offered: dict[str, Any] = {"n_envs": request.n_envs, "use_async_envs": request.use_async_envs}
    if request.cfg is not None:
        offered["cfg"] = config_of(request.cfg)
    parameters = compat.parameters_of(make_env)
    if parameters is None:
        return make_env(**offered, **request.env_kwargs)
    taken = {name: value for name, value in offered.items() if compat.takes(parameters, name)}
    _check_arguments(parameters, taken, request.env_kwargs)
    return make_env(**(taken | request.env_kwargs))


def _loaded_class(module: str, qualified_name: str) -> type[Any] | None:
    """Returns the real class if the repository has imported it, so that ``isinstance`` holds."""
    found = vars(sys.modules.get(module, object)).get(qualified_name)
    return found if isinstance(found, type) else None


def _class_named(module: str, qualified_name: str) -> type[Any] | None:
    try:
        named: Any = importlib.import_module(module)
        for part in qualified_name.split("."):  # what it has: getattr may import LeRobot itself
            named = vars(named)[part]
    except Exception:  # not here, or not importable, or local to a function
        return None
    return named if isinstance(named, type) else None


def _package_of(root: Path, path: PurePosixPath) -> tuple[Path, list[str]]:
    """Returns the folder of the package ``hub_env`` and the entry's dotted path in it."""
    parts = [*path.parent.parts, path.name.removesuffix(".py")]
    if any("." in part for part in parts[:-1]):
        return root / path.parent, parts[-1:]  # a folder named "v1.0" has no dotted path
    return root, parts


def _make_importable(root: Path, folder: Path, scratch: str, package_path: Path) -> None:
    stub = Path(scratch) / "import" / PACKAGE
    stub.mkdir(parents=True, exist_ok=True)
    # The runners of a jail share the folder; none may import another's half-written file.
    draft = stub / f"{os.getpid()}.draft"
    draft.write_text(f"__path__ = [{os.fspath(package_path)!r}]\n")
    draft.replace(stub / "__init__.py")
    source = root / "src"
    wanted = [folder, root, *([source] if source.is_dir() else []), stub.parent]
    fresh = dict.fromkeys(os.fspath(item) for item in wanted)
    sys.path[:0] = [item for item in fresh if item not in sys.path]
    sys.dont_write_bytecode = True  # the snapshot is read-only
    for item in fresh:  # not invalidate_caches(), after which each folder of packages is read again
        sys.path_importer_cache.pop(item, None)


def _check_arguments(
    parameters: compat.Parameters, taken: dict[str, Any], arguments: dict[str, Any]
) -> None:
    unknown = [name for name in arguments if not compat.takes(parameters, name)]
    if unknown:
        raise ArgumentsError(
            f"make_env takes no {', '.join(unknown)}; it takes {', '.join(parameters) or 'nothing'}"
        )
    missing = [
        name
        for name, item in parameters.items()
        if item.default is inspect.Parameter.empty
        and item.kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        and name not in taken
        and name not in arguments
    ]
    if missing:
        raise ArgumentsError(
            f"make_env needs {', '.join(missing)}; pass it in env_kwargs, or a config object for "
            "cfg"
        )
