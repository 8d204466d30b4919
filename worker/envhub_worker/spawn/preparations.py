"""Prepares a repository's surroundings in its jail: a Hub cache, a display, a stub of LeRobot.

The cache has huggingface_hub's layout: for each repository a folder with ``refs/main``, which names
the commit, and ``snapshots/COMMIT``, which is a link to the files. ``HF_HUB_OFFLINE`` (see
``lockdown.mechanisms.environment``) makes ``snapshot_download`` and ``hf_hub_download`` look there
and nowhere else.

The display is Xvfb, as confined as the programs that draw on it. It listens only on a socket file
in the jail's own ``/tmp``, neither on TCP nor on an abstract socket, so no other jail and no
program of the host reaches it. The host's displays do not exist in the jail.

A stub replaces LeRobot if a repository needs only its names. An ``env.py`` often imports
``EnvConfig`` for an annotation, or constants that name observations, and a caller's configuration
is an instance of a class of LeRobot. LeRobot itself takes gigabytes, and seconds to import. The
stub has the names of LeRobot's contract with environments; all other names come from LeRobot
itself, if that is installed.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import select
import shutil
import subprocess
import sys
import types
import warnings
from abc import ABCMeta
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import Any

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.spec import JailSpec

_GRANTED = ("HF_HOME", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE")
"""Variables by which a caller gives another cache to the jail."""


def make_hub_cache(spec: JailSpec) -> None:
    """Lay out the cache in the jail's home. All runners of a jail make the same cache."""
    if any(name in spec.confinement.environment for name in _GRANTED):
        return
    for copy in spec.hub_copies:
        folder = f"{os.environ['HF_HOME']}/hub/{copy.folder}"
        for revision in copy.revisions:
            _write(f"{folder}/refs/{revision}", copy.commit)
        os.makedirs(f"{folder}/snapshots", exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.symlink(copy.tree or spec.snapshot, f"{folder}/snapshots/{copy.commit}")


def _write(path: str, text: str) -> None:
    os.makedirs(os.path.dirname(path), exist_ok=True)
    draft = f"{path}.{os.getpid()}.draft"
    with open(draft, "w") as file:
        file.write(text)
    os.replace(draft, path)


_PROGRAM = "Xvfb"
_SCREEN = "1280x1024x24"
_START_S = 60.0
_HEADLESS = ("PYOPENGL_PLATFORM", "SDL_VIDEODRIVER")
"""Variables of ``jail_environment`` that keep libraries from looking for a display."""
_running: list[subprocess.Popen[bytes]] = []


def check_display(spec: JailSpec, environment: Mapping[str, str]) -> None:
    """Check that Xvfb is installed, before this process gives up any right.
    Raises ``LayerUnavailableError``: the policy asks for a display, and Xvfb is missing.
    """
    is_virtual = spec.confinement.display == "virtual"
    if is_virtual and shutil.which(_PROGRAM, path=environment.get("PATH")) is None:
        raise LayerUnavailableError(
            "display",
            f"a virtual display needs {_PROGRAM}, which is not installed where the jail runs",
            "Install it there (on Debian and Ubuntu: apt-get install xvfb), or leave the display "
            "out and render to arrays.",
        )


def start_display(spec: JailSpec) -> None:
    """Start this process's display, if the policy has one, and set ``DISPLAY``.

    Call this function in the confined process: the display inherits the confinement. It ends with
    this process's session. Raises ``SystemExit``: the display did not start.
    """
    if spec.confinement.display != "virtual":
        return
    ready, theirs = os.pipe()
    words = [_PROGRAM, "-displayfd", str(theirs), "-screen", "0", _SCREEN]
    words += ["-nolisten", "tcp", "-nolisten", "local", "-noreset"]
    none = subprocess.DEVNULL
    _running.append(
        subprocess.Popen(words, pass_fds=[theirs], stdin=none, stdout=none, stderr=none)
    )
    os.close(theirs)
    number = _line(ready)
    os.close(ready)
    if not number.isdigit():
        raise SystemExit(f"the virtual display ({_PROGRAM}) did not come up in the jail")
    os.environ["DISPLAY"] = f":{number.decode()}"
    for name in _HEADLESS:
        if name not in spec.confinement.environment:
            os.environ.pop(name, None)


def _line(ready: int) -> bytes:
    """Reads the display's number from Xvfb; empty or incomplete if Xvfb ends or is too slow."""
    text = b""
    while b"\n" not in text and select.select([ready], [], [], _START_S)[0]:
        piece = os.read(ready, 16)
        if not piece:
            return b""
        text += piece
    return text.strip()


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
