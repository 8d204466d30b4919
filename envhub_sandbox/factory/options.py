"""The arguments of ``make_env``, in one piece."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.factory import arguments
from envhub_sandbox.policy import Limits, Policy, Timeouts
from envhub_sandbox.sandboxes.base import Sandbox

_LANES = ("auto", "frames")
_ONLY_HERE = ("trust_remote_code", "token", "limits")
"""What a recipe does not hold: trust and secrets are nobody else's, limits are in the policy."""
_FOR_A_SANDBOX = (
    *("policy", "timeouts", "limits", "python", "dependencies", "lock", "num_workers", "prewarm"),
    *("validate", "server_key"),
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What ``make_env`` takes beside its reference, name by name and with its defaults.

    ``make_env`` has them in its signature, for those who read it; everything behind it has this.
    """

    n_envs: int
    use_async_envs: bool
    hub_cache_dir: str | Path | None
    trust_remote_code: bool
    sandbox: str | Sandbox | None
    env_kwargs: Mapping[str, Any] | None = field(repr=False)
    policy: Policy | Mapping[str, Any] | None
    timeouts: Timeouts | Mapping[str, Any] | None
    limits: Limits | Mapping[str, Any] | None
    token: str | bool | None = field(repr=False)
    endpoint: str | None = field(repr=False)
    python: str | Path | None
    dependencies: str | os.PathLike[str] | Mapping[str, Any]
    lock: str | os.PathLike[str] | None
    num_workers: int | None
    prewarm: int | None
    lane: str
    copy: bool
    validate: bool
    server_key: str | None

    def checked(self) -> Options:
        """The same, where each is of its own kind; nothing has been started yet.

        Raises:
            TypeError, ValueError: Something that nothing can be made of.
            PolicyError: An unknown lane.
        """
        if self.lane not in _LANES:
            raise PolicyError(f"lane is {self.lane!r}; it is one of {', '.join(_LANES)}")
        return replace(
            self,
            n_envs=arguments.sub_environments(self.n_envs),
            use_async_envs=arguments.flag("use_async_envs", self.use_async_envs),
            num_workers=arguments.workers(self.num_workers),
            prewarm=arguments.ahead(self.prewarm),
            env_kwargs=arguments.keyword_arguments(self.env_kwargs),
        )

    def refuse_what_does_nothing(self) -> None:
        """Without a sandbox; by name.

        Raises:
            PolicyError: Some of these were given.
        """
        given = {name: getattr(self, name) for name in _FOR_A_SANDBOX}
        if self.dependencies == "auto":
            del given["dependencies"]
        arguments.only_in_a_sandbox(given)

    def for_a_recipe(self, **changes: Any) -> dict[str, Any]:
        """Those that make the same environments elsewhere."""
        lock = None if self.lock is None else os.path.abspath(self.lock)
        names = [one.name for one in fields(self) if one.name not in _ONLY_HERE]
        return {**{name: getattr(self, name) for name in names}, "lock": lock, **changes}
