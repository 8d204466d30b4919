"""The only importer of repository code: imports the entry file and calls its ``make_env``.

The entry becomes the module ``hub_env.<path>``, a real importable name, so that dataclasses with
postponed annotations, ``from .sibling import x``, and pickling of the repository's classes to its
own child processes work; its folder and the repository's root are importable too (``import
sibling``). Followed: LeRobot's ``_import_hub_module`` and ``_call_make_env``.
"""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any

from envhub_worker.protocol.messages import Load, LoadTask
from envhub_worker.runner.configs import config_of
from envhub_worker.runner.parameters import Parameters, parameters_of, takes

PACKAGE = "hub_env"


class EntryError(AttributeError):
    """The entry file has no usable ``make_env``."""


class ArgumentsError(TypeError):
    """``make_env`` takes other arguments."""


def import_entry(snapshot: str, entry: str, scratch: str) -> Callable[..., Any]:
    """Import the entry file and give its ``make_env``.

    Args:
        scratch: A writable folder that outlives this call.

    Raises:
        EntryError: There is no ``make_env``, or it is not callable.
        BaseException: Whatever the repository raises.
    """
    path = PurePosixPath(entry)
    root = Path(snapshot)
    folder, parts = _package_of(root, path)
    _make_importable(root, root / path.parent, scratch, folder)
    module = importlib.import_module(".".join([PACKAGE, *parts]))
    make_env = getattr(module, "make_env", None)
    if not callable(make_env):
        kind = f"{type(make_env).__module__}.{type(make_env).__qualname__}"
        lacks = "it has no such name" if make_env is None else f"its make_env is a {kind}"
        raise EntryError(
            f"{entry} must expose `make_env(n_envs=int, use_async_envs=bool)`; {lacks}"
        )
    return make_env  # type: ignore[no-any-return]


def call_make_env(make_env: Callable[..., Any], request: Load | LoadTask) -> Any:
    """Call ``make_env`` with those of our arguments that it takes.

    Raises:
        ArgumentsError: It needs others, or does not take the caller's ``env_kwargs``.
    """
    offered: dict[str, Any] = {
        "n_envs": request.n_envs,
        "use_async_envs": request.use_async_envs,
    }
    if request.cfg is not None:
        offered["cfg"] = config_of(request.cfg, _class_named)
    parameters = parameters_of(make_env)
    if parameters is None:
        return make_env(**offered, **request.env_kwargs)
    taken = {name: value for name, value in offered.items() if takes(parameters, name)}
    _check_arguments(parameters, taken, request.env_kwargs)
    return make_env(**(taken | request.env_kwargs))


def _class_named(module: str, qualified_name: str) -> type[Any] | None:
    try:
        found = attrgetter(qualified_name)(importlib.import_module(module))
    except Exception:  # not here, or not importable, or local to a function
        return None
    return found if isinstance(found, type) else None


def _package_of(root: Path, path: PurePosixPath) -> tuple[Path, list[str]]:
    """The folder that the package stands for, and the entry's dotted path in it."""
    parts = [*path.parent.parts, path.name.removesuffix(".py")]
    if any("." in part for part in parts[:-1]):
        return root / path.parent, parts[-1:]  # a folder named "v1.0" has no dotted path
    return root, parts


def _make_importable(root: Path, folder: Path, scratch: str, package_path: Path) -> None:
    stub = Path(scratch) / "import" / PACKAGE
    stub.mkdir(parents=True, exist_ok=True)
    # the runners of a jail share the folder: none may import another's half-written file
    draft = stub / f"{os.getpid()}.draft"
    draft.write_text(f"__path__ = [{os.fspath(package_path)!r}]\n")
    draft.replace(stub / "__init__.py")
    source = root / "src"
    wanted = [folder, root, *([source] if source.is_dir() else []), stub.parent]
    fresh = dict.fromkeys(os.fspath(item) for item in wanted)
    sys.path[:0] = [item for item in fresh if item not in sys.path]
    sys.dont_write_bytecode = True  # the snapshot is read-only
    importlib.invalidate_caches()


def _check_arguments(parameters: Parameters, taken: dict[str, Any], given: dict[str, Any]) -> None:
    unknown = [name for name in given if not takes(parameters, name)]
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
        and name not in given
    ]
    if missing:
        raise ArgumentsError(
            f"make_env needs {', '.join(missing)}; pass it in env_kwargs, or a config object for "
            "cfg"
        )
