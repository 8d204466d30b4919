"""``--env.type=envhub_sandbox``: a repository of the Hub as one of LeRobot's own configurations.

The type is no ``HubEnvConfig``, because LeRobot refuses those without ``trust_remote_code``, which
the sandbox does not need, and ``lerobot-train`` refuses all of them.
"""

from __future__ import annotations

import json
import sys
import threading
import warnings
from collections.abc import Hashable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.configs.types import PolicyFeature
from lerobot.envs.configs import EnvConfig

from envhub_sandbox.errors import EnvHubError, HubReferenceError
from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.integrations.lerobot.features import (
    Step,
    as_features,
    features_of,
    left_out,
    processors,
    steps_for,
)
from envhub_sandbox.settings.options import OPTIONS, on_lerobots_command_line, use_option_names
from envhub_sandbox.vector.suites import EnvSuites, closed_if_it_fails, for_lerobot, keep_only
from envhub_worker.protocol.text import printable

ASKS_CONFIGS = hasattr(EnvConfig, "create_envs")
"""Whether this LeRobot asks a configuration for its environments: 0.6 does, 0.4 and 0.5 do not."""

_SAID_OTHERWISE = {"n_envs", "use_async_envs", "trust_remote_code", "token"}
_OPTIONS = {
    key: OPTIONS[key] for key in OPTIONS if not OPTIONS[key].field and key not in _SAID_OTHERWISE
}


class SpareSuites:
    """Keeps environments that were opened to read their spaces, for the request that follows.

    LeRobot reads the features of an environment before it makes any. The same jail is used for
    both, so that a simulator is loaded once. If no request follows within ``seconds``, as before a
    training whose first evaluation is an hour away, they are closed. Each key keeps one ``suites``.
    """

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._kept: dict[Hashable, EnvSuites] = {}

    def put(self, key: Hashable, suites: EnvSuites) -> None:
        """Keep environments under a key; close those that had the key before."""
        with self._lock:
            before, self._kept[key] = self._kept.get(key), suites
        if before is not None:
            before.close()
        timer = threading.Timer(self._seconds, self._give_up, (key, suites))
        timer.daemon = True
        timer.start()

    def take(self, key: Hashable) -> EnvSuites | None:
        """Remove and return the environments of a key; the caller has to close them."""
        with self._lock:
            return self._kept.pop(key, None)

    def _give_up(self, key: Hashable, suites: EnvSuites) -> None:
        with self._lock:
            if self._kept.get(key) is not suites:
                return
            del self._kept[key]
        suites.close()


_SPARES = SpareSuites()
_LONGEST = 200
"""The most characters of the repository's names in a text."""
_NO_REPO = "env.repo is missing: which repository? --env.repo=org/repo@<commit>"


def _with_options(config: type[Any]) -> type[Any]:
    """Decorate a configuration: add a field for each option, of its command line type."""
    for key, option in _OPTIONS.items():
        if option.kind is dict:
            config.__annotations__[key] = dict[str, Any]
            setattr(config, key, field(default_factory=dict))
        elif option.kind is list:
            config.__annotations__[key] = list[str]
            setattr(config, key, field(default_factory=list))
        else:
            optional = option.default is None
            config.__annotations__[key] = option.kind | None if optional else option.kind
            setattr(config, key, option.default)
    return config


@EnvConfig.register_subclass("envhub_sandbox")
@dataclass
@_with_options
class SandboxedEnvConfig(EnvConfig):
    """The environments of a repository, each in a sandbox.

    Creating a configuration downloads the repository and reads its spaces, in a jail. From then on
    ``repo`` has the full commit, also in files that LeRobot saves. There is no field for a token,
    because LeRobot prints and saves configurations; the token is huggingface_hub's own.

    Attributes:
        repo: As in ``envhub_sandbox.make_env``: a hub reference, or a folder.
        suite: The only suite to make; all by default.
        task: The id of the only task to make; all by default.
        fps: The environments' ``render_fps``, if their metadata has it.
        features: The features of the spaces; the user's are added, and win for the same key.
        features_map: The policies' name of each feature; by default that of LeRobot's processors.
        state_keys: For observations in the form of Isaac Lab Arena, the keys of ``policy`` that
            form the state, separated by commas; all by default.
        camera_keys: The same for ``camera_obs``.

    The other fields are ``make_env``'s options; ``dependencies`` takes its mapping as JSON.
    """

    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)
    repo: str | None = None
    suite: str | None = None
    state_keys: str | None = None
    camera_keys: str | None = None

    def __post_init__(self) -> None:
        self._steps: list[Step] = []
        try:
            self._open()
        except (EnvHubError, ValueError, TypeError) as error:
            if not _on_lerobots_command_line():
                raise
            # draccus would catch a ValueError or TypeError, and print a hundred lines around it
            sys.exit(f"{Path(sys.argv[0]).name}: {error}")

    def _open(self) -> None:
        if not self.repo:
            if _on_lerobots_command_line():
                raise ValueError(_NO_REPO)
            return  # LeRobot's tests make each type without arguments; create_envs raises later
        endpoint = self._options()["endpoint"]
        if endpoint is not None and without_login(endpoint) != endpoint:
            raise HubReferenceError(
                "env.endpoint contains a login, and LeRobot prints and saves configurations; put "
                "it into the environment variable HF_ENDPOINT"
            )
        n_envs, use_async_envs = _expected()
        with closed_if_it_fails(self._made(n_envs, use_async_envs)) as suites:
            self.repo = suites.reference
            self._describe(suites)
        _SPARES.put(self._key(n_envs, use_async_envs), suites)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Empty, since Gymnasium's registry does not make these environments."""
        return {}

    @property
    def gym_id(self) -> str:
        """Raise ``RuntimeError``: only a LeRobot that asks no configuration reads it."""
        raise RuntimeError(
            "this version of LeRobot does not let a configuration make its environments: run "
            "lerobot-eval-sandboxed instead of lerobot-eval, or call "
            "envhub_sandbox.integrations.lerobot.install()"
        )

    @property
    def hub_path(self) -> str | None:
        """The repository, for a LeRobot in which ``install()`` has to route this, too."""
        return self.repo

    def get_env_processors(self) -> tuple[Any, Any]:
        """The processors that the repository declares, or LeRobot's own for this form."""
        return processors(self._steps), processors([])

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> EnvSuites:
        """``{suite: {task_id: VectorEnv}}``; raises as ``envhub_sandbox.make_env``."""
        if not self.repo:
            raise ValueError(_NO_REPO)
        spare = _SPARES.take(self._key(n_envs, use_async_envs))
        return self._made(n_envs, use_async_envs) if spare is None else spare

    def _options(self) -> dict[str, Any]:
        """The options of ``make_env`` from the fields."""
        values = {key: getattr(self, key) for key in _OPTIONS}
        values |= {key: values[key] or None for key in _OPTIONS if _OPTIONS[key].kind is dict}
        if isinstance(values["dependencies"], str) and values["dependencies"].startswith("{"):
            values["dependencies"] = json.loads(values["dependencies"])
        return values

    def _made(self, n_envs: int, use_async_envs: bool) -> EnvSuites:
        options = {"n_envs": n_envs, "use_async_envs": use_async_envs, **self._options()}
        with use_option_names(on_lerobots_command_line()):
            suites = for_lerobot(make_env(self.repo, **options))
        with closed_if_it_fails(suites):
            keep_only(suites, self.suite, self.task)
        return suites

    def _describe(self, suites: EnvSuites) -> None:
        first, *others = [env for tasks in suites.values() for env in tasks.values()]
        spaces = (first.single_observation_space, first.single_action_space)
        for env in others:
            if (env.single_observation_space, env.single_action_space) != spaces:
                raise ValueError(
                    f"{self.repo}: its tasks have different spaces, and LeRobot has one set of "
                    "features for all: choose one by env.suite and env.task"
                )
        keys = {"state_keys": self.state_keys, "camera_keys": self.camera_keys}
        self._steps = steps_for(spaces[0], first.metadata, keys)
        seen = features_of(*spaces, self._steps, others=ASKS_CONFIGS)
        self._merge(*as_features(seen))
        lost = [name for name in left_out(spaces[0], seen) if name not in self.features]
        if lost:
            names = printable(", ".join(lost), _LONGEST)
            warnings.warn(
                f"{self.repo}: LeRobot's policies will not see {names} of its observations "
                "(docs/lerobot.md says what they see)",
                UserWarning,
                stacklevel=2,
            )
        fps = first.metadata.get("render_fps")
        if fps is not None:
            self.fps = fps

    def _merge(self, features: dict[str, PolicyFeature], names: dict[str, str]) -> None:
        """Merge features of the spaces with the user's, which have precedence."""
        self.features = {**features, **self.features}
        self.features_map = {**names, **self.features_map}
        for key in self.features.keys() ^ self.features_map.keys():
            if key in self.features:
                raise ValueError(
                    f"env.features has {key!r}, and env.features_map does not say what a policy "
                    f'calls it: --env.features_map=\'{{"{key}": "observation.NAME"}}\''
                )
            names_there = printable(", ".join(self.features), _LONGEST)
            raise ValueError(f"env.features_map names {key!r}; {self.repo} has {names_there}")

    def _key(self, n_envs: int, use_async_envs: bool) -> str:
        own = [item.name for item in fields(SandboxedEnvConfig)]
        values = {name: getattr(self, name) for name in own if not name.startswith("features")}
        return repr((n_envs, bool(use_async_envs), values))


def _on_lerobots_command_line() -> bool:
    """Whether a program of LeRobot's makes this configuration of its arguments, or of its file."""
    kind = parser.parse_arg("env.type")
    return kind == "envhub_sandbox" or parser.parse_arg("config_path") is not None


def _expected() -> tuple[int, bool]:
    """Guess the number of sub-environments that LeRobot will request, and whether async.

    A right guess saves a second jail; after a wrong one the request opens another jail.
    """
    if parser.parse_arg("env.repo") is None:
        return 1, False
    texts = {item.name: parser.parse_arg(f"eval.{item.name}") for item in fields(EvalConfig)}
    arguments = [f"--{name}={text}" for name, text in texts.items() if text is not None]
    chosen = draccus.parse(config_class=EvalConfig, args=arguments)
    return chosen.batch_size, chosen.use_async_envs
