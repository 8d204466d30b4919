"""One environment of a repository as an ordinary ``gymnasium.Env``, also by Gymnasium's registry.

    >>> env = SandboxEnv("org/repo@<commit>")
    >>> name = "envhub_sandbox.integrations.gym:Hub-v0"
    >>> env = gymnasium.make(name, ref="org/repo@<commit>")
    >>> envs = gymnasium.make_vec(name, num_envs=4, ref="org/repo@<commit>")

Gymnasium imports the module before the colon, which registers the id.
"""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import LoadError
from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.session.repository import ENV_ID
from envhub_sandbox.vector.single_env import SingleEnv
from envhub_sandbox.vector.suites import choose, closed_if_it_fails
from envhub_sandbox.vector.tracebacks import short_traceback
from envhub_sandbox.vector.vector_env import SandboxVectorEnv, refuse_limit


class SandboxEnv(SingleEnv, gymnasium.Env[Any, Any]):
    """One environment of a repository, in its own sandbox.

    Args:
        ref: As in ``make_env``: a hub reference, a folder, a config with ``hub_path``.
        suite: A suite of the repository; needed if there are several.
        task: A task of the suite; needed if there are several.
        render_mode: Passed to the repository's ``make_env``, unless it is None.
        options: Further arguments of ``envhub_sandbox.make_env``.

    Raises:
        ValueError: The repository has several environments, or lacks the named one.
        EnvHubError: As ``make_env``.
    """

    @short_traceback
    def __init__(
        self,
        ref: Any,
        *,
        suite: str | None = None,
        task: int | str | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        suites = make_env(ref, n_envs=1, **_with_render_mode(options, render_mode))
        with closed_if_it_fails(suites):
            super().__init__(choose(suites, suite, task), suites.close)


@short_traceback
def make_again(ref: Any, *, render_mode: str | None = None, **options: Any) -> SandboxEnv:
    """Make an environment again from its spec; ``gymnasium.make(env.spec)`` calls it.

    As ``SandboxEnv``, except if the repository's ``make_env`` takes no ``render_mode``. Then the
    repository chooses the render mode, and a warning says if it differs from the requested one.
    """
    try:
        return SandboxEnv(ref, render_mode=render_mode, **options)
    except LoadError as error:
        if render_mode is None or "make_env takes no render_mode" not in str(error):
            raise
    env = SandboxEnv(ref, **options)
    if env.render_mode != render_mode:
        warnings.warn(
            f"{env}: make_env takes no render_mode, so it is {env.render_mode!r} and not "
            f"{render_mode!r}",
            UserWarning,
            stacklevel=2,
        )
    return env


@short_traceback
def make_vector(
    ref: Any,
    num_envs: int = 1,
    *,
    suite: str | None = None,
    task: int | str | None = None,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    **options: Any,
) -> VectorEnv[Any, Any, Any]:
    """Make a repository's vector environment; ``gymnasium.make_vec`` calls it.

    Args:
        ref: As in ``envhub_sandbox.make_env``.
        num_envs: Number of sub-environments.
        suite: A suite of the repository; needed if there are several.
        task: A task of the suite; needed if there are several.
        render_mode: Passed to the repository's ``make_env``, unless it is None.
        max_episode_steps: The repository's own limit; another one is an error.
        options: Further arguments of ``envhub_sandbox.make_env``.

    Raises:
        ValueError: ``max_episode_steps`` differs from the repository's limit.
    """
    suites = make_env(ref, n_envs=num_envs, **_with_render_mode(options, render_mode))
    with closed_if_it_fails(suites):
        vector = choose(suites, suite, task)
        if isinstance(vector, SandboxVectorEnv):
            refuse_limit(vector, max_episode_steps)
        return vector


def _with_render_mode(options: dict[str, Any], render_mode: str | None) -> dict[str, Any]:
    if render_mode is None:
        return options
    env_kwargs = {**(options.get("env_kwargs") or {}), "render_mode": render_mode}
    return {**options, "env_kwargs": env_kwargs}


if ENV_ID not in gymnasium.registry:
    gymnasium.register(
        ENV_ID, entry_point=f"{__name__}:SandboxEnv", vector_entry_point=f"{__name__}:make_vector"
    )
