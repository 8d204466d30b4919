"""The OpenEnv peer's server: ``python -m benchmarks.peers.openenv_server NAME PORT SESSIONS``."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import uvicorn
from openenv.core.env_server import Action, Environment, Observation, State, create_fastapi_app

from benchmarks.workloads import single


class Push(Action):
    """A discrete action."""

    action: int


class Seen(Observation):
    """An observation, as a list."""

    values: list[float]


class Served(Environment[Push, Seen, State]):
    """A Gymnasium environment that begins again after its last step, as vector ones do."""

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self, name: str) -> None:
        super().__init__()
        self._env = single(name)
        self._over = False

    def reset(self, seed: int | None = None, episode_id: str | None = None, **kwargs: Any) -> Seen:
        """Start again."""
        self._over = False
        observation, _ = self._env.reset(seed=seed)
        return Seen(values=observation.tolist())

    def step(self, action: Push, timeout_s: float | None = None, **kwargs: Any) -> Seen:
        """Step, or start again."""
        if self._over:
            return self.reset()
        observation, reward, terminated, truncated, _ = self._env.step(action.action)
        self._over = terminated or truncated
        return Seen(values=observation.tolist(), reward=float(reward), done=self._over)

    @property
    def state(self) -> State:
        """Nothing of interest."""
        return State()


def main() -> None:
    """Serve until terminated."""
    name, port, sessions = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    app = create_fastapi_app(partial(Served, name), Push, Seen, max_concurrent_envs=sessions)
    uvicorn.run(app, host="127.0.0.1", port=port, log_level="warning")


if __name__ == "__main__":
    main()
