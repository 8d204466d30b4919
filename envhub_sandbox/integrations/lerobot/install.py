"""Makes LeRobot's own ``make_env`` run the Hub's code in the sandbox.

LeRobot's factory loads a repository in three steps, download, import and call, each a function that
``make_env`` looks up by name in its module. ``install`` replaces these functions. It cannot replace
``make_env`` itself, because LeRobot's programs have imported it already.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import gymnasium
import lerobot.envs.factory

from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.integrations.lerobot.config import ASKS_CONFIGS, SandboxedEnvConfig
from envhub_sandbox.settings.options import OPTIONS
from envhub_sandbox.vector.suites import EnvSuites, for_lerobot
from envhub_sandbox.vector.vector_env import SandboxVectorEnv

_HELPERS = ("_download_hub_file", "_import_hub_module", "_call_make_env")
_GIVEN = ("n_envs", "use_async_envs", "hub_cache_dir", "trust_remote_code")


def install(**options: Any) -> None:
    """From now on, have LeRobot's ``make_env`` make environments of the Hub in the sandbox.

    This holds for references and for every ``HubEnvConfig``; ``trust_remote_code`` is ignored.
    A later call replaces the options of an earlier one.
    ``options``: those of ``envhub_sandbox.make_env``, for all repositories.
    Raises ``TypeError``: ``make_env`` has no such option; ``RuntimeError``: this LeRobot lacks the
    functions to replace.
    """
    names = [key for key in OPTIONS if not OPTIONS[key].field and key not in _GIVEN]
    unknown = [name for name in options if name not in names]
    if unknown:
        raise TypeError(f"there is no option {', '.join(unknown)}; there are {', '.join(names)}")
    if options.get("sandbox", "process") is None:
        raise TypeError("sandbox is None: without install() LeRobot runs code in this process")
    factory = lerobot.envs.factory
    missing = [name for name in _HELPERS if not callable(getattr(factory, name, None))]
    if missing:
        raise RuntimeError(
            f"lerobot.envs.factory has no {', '.join(missing)}: this LeRobot loads repositories in "
            "another way than the versions that are known here (docs/lerobot.md). Nothing was "
            "changed, and its make_env would run their code in this process"
        )
    routed = _Routing(options)
    factory._download_hub_file = routed.download
    factory._import_hub_module = routed.load
    factory._call_make_env = routed.call
    if not ASKS_CONFIGS:
        hub_configs = lerobot.envs.configs.HubEnvConfig, SandboxedEnvConfig
        factory.HubEnvConfig = hub_configs  # the factory only passes it to isinstance()
        _let_videos_be_written()


@dataclass(frozen=True)
class _HubRequest:
    """Replaces the downloaded file, and then the module that LeRobot would import from it."""

    reference: str
    hub_cache_dir: str | None


@dataclass(frozen=True)
class _Routing:
    """Replaces LeRobot's three steps; only the last makes environments."""

    options: dict[str, Any]

    def download(
        self, cfg_str: str, trust_remote_code: bool, hub_cache_dir: str | None
    ) -> tuple[str, str, _HubRequest, None]:
        """Download nothing; return the request for the next steps."""
        return cfg_str, "", _HubRequest(cfg_str, hub_cache_dir), None

    def load(self, local_file: _HubRequest, repo_id: str) -> _HubRequest:
        """Import nothing; return the request."""
        return local_file

    def call(self, module: _HubRequest, n_envs: int, use_async_envs: bool, cfg: Any) -> EnvSuites:
        """Make the environments in the sandbox."""
        if isinstance(cfg, SandboxedEnvConfig):
            return cfg.create_envs(n_envs, use_async_envs)
        suites = make_env(
            module.reference if cfg is None else cfg,
            n_envs=n_envs,
            use_async_envs=use_async_envs,
            hub_cache_dir=module.hub_cache_dir,
            **self.options,
        )
        return for_lerobot(suites)


class _AsyncOrSandboxed(type):
    """The metaclass of a class whose instances ``lerobot_eval`` renders by ``call("render")``."""

    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, (gymnasium.vector.AsyncVectorEnv, SandboxVectorEnv))


def _let_videos_be_written() -> None:
    """Let LeRobot before 0.6 render ours, too: it renders only Gymnasium's two vector classes.

    Only its evaluation sees a ``gymnasium`` whose ``vector.AsyncVectorEnv`` includes our class.
    """
    try:
        import lerobot.scripts.lerobot_eval as evaluation
    except ImportError:
        return  # without this module there is no evaluation
    seen, vector = ModuleType("gymnasium"), ModuleType("gymnasium.vector")
    vars(vector).update(vars(gymnasium.vector))
    vars(vector)["AsyncVectorEnv"] = _AsyncOrSandboxed("AsyncVectorEnv", (), {})
    vars(seen).update({**vars(gymnasium), "vector": vector})
    evaluation.gym = seen
