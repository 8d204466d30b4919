"""What it costs to open a file where denials are recorded: ``python -m benchmarks.recording``.

The same files are opened in a jail that records and in one that does not, in turns.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from envhub_sandbox import make_env
from envhub_sandbox.vector.vector_env import SandboxVectorEnv

_ENTRY = '''
import os, time
import gymnasium as gym

class Opening(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}

    def opens(self, path, count):
        """Microseconds of opening and closing it once."""
        start = time.perf_counter()
        for _ in range(count):
            os.close(os.open(path, os.O_RDONLY))
        return (time.perf_counter() - start) / count * 1e6

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Opening] * n_envs)
'''
_PLACES = {"a library": "/usr/lib/os-release", "its own": "env.py"}


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recording", description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--count", type=int, default=500, help="files opened in each turn")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        Path(folder, "env.py").write_text(_ENTRY)
        times = measured(folder, options.rounds, options.count)
    print("| opened | plain, microseconds | recorded | times |\n| --- | --- | --- | --- |")
    for name in _PLACES:
        plain, recorded = (statistics.median(times[name, one]) for one in (False, True))
        print(f"| {name} | {plain:.1f} | {recorded:.1f} | {recorded / plain:.0f} |")
    return 0


def measured(folder: str, rounds: int, count: int) -> dict[tuple[str, bool], list[float]]:
    """The times of each place, plain and recorded."""
    times: dict[tuple[str, bool], list[float]] = {}
    plain, recorded = (
        make_env(folder, policy={"record_denials": recording}) for recording in (False, True)
    )
    with plain, recorded:
        envs: dict[bool, SandboxVectorEnv] = {False: plain.env, True: recorded.env}
        for env in envs.values():
            env.reset(seed=0)
        for _ in range(rounds):
            for name, path in _PLACES.items():
                for recording, env in envs.items():
                    (took,) = env.call("opens", path, count)
                    times.setdefault((name, recording), []).append(took)
    return times


if __name__ == "__main__":
    raise SystemExit(main())
