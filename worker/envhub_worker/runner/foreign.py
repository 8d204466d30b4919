"""Environments of another library than Gymnasium: ``old_gym`` adapts those of ``gym``."""

from __future__ import annotations

from typing import Any

from envhub_worker.find_extra import find_extra


class _NoAdapter:
    """Adapts nothing, and knows no environments but Gymnasium's: see ``old_gym``."""

    def is_env(self, value: object) -> bool:
        """Whether it is an environment of that library."""
        return False

    is_vector = is_env

    def adapted(self, env: Any) -> Any:
        """An environment as one of Gymnasium."""
        return env

    adapted_vector = space_of = adapted

    def explained(self, error: Exception, env: Any, method: str) -> Exception:
        """The error, or one that says what is old about the environment's ``method``."""
        return error


old_gym: Any = find_extra("old_gym") or _NoAdapter()
