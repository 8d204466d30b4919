"""Environments of libraries other than Gymnasium: the extra ``old_gym`` adapts those of ``gym``."""

from __future__ import annotations

from typing import Any

from envhub_worker.find_extra import find_extra


class _NoAdapter:
    """Stands for ``old_gym`` where that extra is missing: adapts no environment."""

    def is_env(self, value: object) -> bool:
        """Whether an object is an environment of the other library."""
        return False

    is_vector = is_env

    def adapted(self, env: Any) -> Any:
        """Adapts an environment to Gymnasium's interface."""
        return env

    adapted_vector = space_of = adapted

    def explained(self, error: Exception, env: Any, method: str) -> Exception:
        """Returns the error, or one that explains how the environment's ``method`` is outdated."""
        return error


old_gym: Any = find_extra("old_gym") or _NoAdapter()
