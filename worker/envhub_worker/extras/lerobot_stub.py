"""A stub that replaces LeRobot if a repository needs only its names.

An ``env.py`` often imports ``EnvConfig`` for an annotation, or constants that name observations,
and a caller's configuration is an instance of a class of LeRobot. LeRobot itself takes gigabytes,
and seconds to import. The stub has the names of LeRobot's contract with environments; all other
names come from LeRobot itself, if that is installed.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import types
import warnings
from abc import ABCMeta
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import Any

_CONSTANTS = {
    "OBS_STR": "observation",
    "OBS_PREFIX": "observation.",
    "OBS_ENV_STATE": "observation.environment_state",
    "OBS_STATE": "observation.state",
    "OBS_IMAGE": "observation.image",
    "OBS_IMAGES": "observation.images",
    "OBS_LANGUAGE": "observation.language",
    "ACTION": "action",
    "REWARD": "next.reward",
    "TRUNCATED": "next.truncated",
    "DONE": "next.done",
    "SUCCESS": "next.success",
    "INFO": "info",
}
_FEATURES = ("STATE", "VISUAL", "ENV", "ACTION", "REWARD", "LANGUAGE")


def install() -> None:
    """Put the stub before LeRobot itself, whose import takes seconds of CPU in each jail."""
    sys.meta_path.insert(0, _Stub())


class _Stub(MetaPathFinder, Loader):
    """Finds and loads the modules of ``_MODULES``. When the repository imports another part of
    LeRobot, LeRobot itself replaces the stub, if it is installed.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: object = None
    ) -> ModuleSpec | None:
        """Returns the spec of a module of the stub or of LeRobot itself."""
        if name in _MODULES:
            return ModuleSpec(name, self, origin="stub of envhub-sandbox", is_package=True)
        if name.startswith("lerobot.") and self._step_aside():
            return importlib.util.find_spec(name)
        return None

    def create_module(self, spec: ModuleSpec) -> None:
        """Returns None: the import system makes an ordinary module."""

    def exec_module(self, module: types.ModuleType) -> None:
        """Fill a module of the stub; the first one warns if LeRobot is not installed."""
        name = module.__name__

        def other(attribute: str) -> Any:
            # inspect asks every module for its __file__, which must not import anything
            meant = not attribute.startswith("__") or attribute in ("__all__", "__version__")
            if meant and self._step_aside():
                return getattr(importlib.import_module(name), attribute)
            raise AttributeError(f"module {name!r} has no attribute {attribute!r}")

        vars(module).update(_MODULES[name](), __getattr__=other)
        if name == "lerobot" and not self._is_installed():
            warnings.warn(
                "lerobot is not installed in the jail: a stub replaces it, with EnvConfig, "
                "HubEnvConfig, PolicyFeature, FeatureType and the constants of observations",
                stacklevel=2,
            )

    def _is_installed(self) -> bool:
        finders = [finder for finder in sys.meta_path if finder is not self]
        return any(finder.find_spec("lerobot", None) is not None for finder in finders)

    def _step_aside(self) -> bool:
        """Whether LeRobot itself is imported now."""
        if self in sys.meta_path and self._is_installed():
            sys.meta_path.remove(self)
            for name in _MODULES:
                sys.modules.pop(name, None)
            importlib.import_module("lerobot")
        return self not in sys.meta_path


class _AnyOfThisName(ABCMeta):
    """The metaclass of the stub's classes: instances of LeRobot's class of the same name pass
    ``isinstance``.
    """

    def __instancecheck__(cls, instance: Any) -> bool:
        name = (cls.__module__, cls.__qualname__)
        return any((c.__module__, c.__qualname__) == name for c in type(instance).__mro__)


@lru_cache
def _types() -> dict[str, Any]:
    from dataclasses import make_dataclass
    from enum import Enum

    make_enum: Any = Enum  # made of a tuple, whose members mypy cannot see
    kind = make_enum("FeatureType", [(name, name) for name in _FEATURES], type=str)
    feature = make_dataclass("PolicyFeature", [("type", kind), ("shape", tuple)])
    return {"FeatureType": kind, "PolicyFeature": feature}


@lru_cache
def _configs() -> dict[str, Any]:
    from dataclasses import dataclass, field

    @dataclass
    class EnvConfig(metaclass=_AnyOfThisName):
        """The fields that every configuration of an environment has."""

        task: str | None = None
        fps: int = 30
        features: dict[str, Any] = field(default_factory=dict)
        features_map: dict[str, str] = field(default_factory=dict)
        max_parallel_tasks: int = 1
        disable_env_checker: bool = True

        @classmethod
        def register_subclass(cls, name: str) -> Callable[[type[Any]], type[Any]]:
            """Returns the class unchanged: nothing here looks up configurations by name."""
            return lambda kind: kind

        @property
        def gym_kwargs(self) -> dict[str, Any]:
            """No arguments: the repository's ``make_env`` chooses its own."""
            return {}

    @dataclass
    class HubEnvConfig(EnvConfig):
        """The configuration of an environment from a repository of the Hub."""

        hub_path: str | None = None

    for kind in (EnvConfig, HubEnvConfig):
        kind.__module__, kind.__qualname__ = "lerobot.envs.configs", kind.__name__
    return {"EnvConfig": EnvConfig, "HubEnvConfig": HubEnvConfig}


_MODULES: dict[str, Callable[[], dict[str, Any]]] = {
    **dict.fromkeys(("lerobot", "lerobot.utils"), dict),
    **dict.fromkeys(("lerobot.envs", "lerobot.envs.configs"), _configs),
    **dict.fromkeys(("lerobot.configs", "lerobot.configs.types"), _types),
    **dict.fromkeys(("lerobot.utils.constants", "lerobot.constants"), _CONSTANTS.copy),
}
"""What each module of the stub has."""
