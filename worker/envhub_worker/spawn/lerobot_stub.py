"""Stands in for LeRobot where a repository imports it for names alone, and it is not installed.

An ``env.py`` often imports ``EnvConfig`` for an annotation, or constants that name observations.
LeRobot itself is gigabytes. So where nothing else brings these modules they have the names of
LeRobot's contract with environments; whatever else is imported of it is missing, as before.
"""

from __future__ import annotations

import sys
import types
import warnings
from collections.abc import Callable, Sequence
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


def install_lerobot_stub() -> None:
    """Have it found last, behind everything that the interpreter and its packages bring."""
    sys.meta_path.append(_Finder())


class _Finder(MetaPathFinder, Loader):
    """Finds and loads the modules of ``_MODULES``."""

    def __init__(self) -> None:
        self._said = False

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: object = None
    ) -> ModuleSpec | None:
        """The spec of a module of the stub; None for others, and below a LeRobot that is real."""
        root = sys.modules.get("lerobot")
        real = root is not None and not isinstance(getattr(root, "__loader__", None), _Finder)
        if name not in _MODULES or real:
            return None
        return ModuleSpec(name, self, origin="stub of envhub-sandbox", is_package=True)

    def create_module(self, spec: ModuleSpec) -> None:
        """An ordinary one."""

    def exec_module(self, module: types.ModuleType) -> None:
        """Fill it, and warn of it once."""
        vars(module).update(_MODULES[module.__name__]())
        if not self._said:
            self._said = True
            warnings.warn(
                "lerobot is not installed in the jail: a stub replaces it, with EnvConfig, "
                "HubEnvConfig, PolicyFeature, FeatureType and the constants of observations",
                stacklevel=2,
            )


def _nothing() -> dict[str, Any]:
    return {}


def _constants() -> dict[str, Any]:
    return dict(_CONSTANTS)


def _types() -> dict[str, Any]:
    from dataclasses import make_dataclass
    from enum import Enum

    made: Any = Enum  # made of a tuple, whose members mypy cannot see
    kind = made("FeatureType", [(name, name) for name in _FEATURES], type=str)
    feature = make_dataclass("PolicyFeature", [("type", kind), ("shape", tuple)])
    return {"FeatureType": kind, "PolicyFeature": feature}


def _configs() -> dict[str, Any]:
    from dataclasses import dataclass, field

    @dataclass
    class EnvConfig:
        """The fields that every configuration of an environment has."""

        task: str | None = None
        fps: int = 30
        features: dict[str, Any] = field(default_factory=dict)
        features_map: dict[str, str] = field(default_factory=dict)
        max_parallel_tasks: int = 1
        disable_env_checker: bool = True

        @classmethod
        def register_subclass(cls, name: str) -> Callable[[type[Any]], type[Any]]:
            """Nothing looks a configuration up by its name here."""
            return lambda kind: kind

        @property
        def gym_kwargs(self) -> dict[str, Any]:
            """A repository's ``make_env`` gets its arguments by itself."""
            return {}

    @dataclass
    class HubEnvConfig(EnvConfig):
        """A repository of the Hub."""

        hub_path: str | None = None

    for kind in (EnvConfig, HubEnvConfig):
        kind.__module__, kind.__qualname__ = "lerobot.envs.configs", kind.__name__
    return {"EnvConfig": EnvConfig, "HubEnvConfig": HubEnvConfig}


_MODULES: dict[str, Callable[[], dict[str, Any]]] = {
    **dict.fromkeys(("lerobot", "lerobot.envs", "lerobot.utils", "lerobot.configs"), _nothing),
    "lerobot.envs.configs": _configs,
    "lerobot.configs.types": _types,
    "lerobot.utils.constants": _constants,
    "lerobot.constants": _constants,
}
"""What each module of the stub has."""
