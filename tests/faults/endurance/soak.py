"""Many steps with injected deaths, stalls and time-outs, each result against an oracle.

    python -m tests.faults.endurance.soak [--steps 1000000] [--lane both]

The oracle is a ``SyncVectorEnv`` of the same class in this process, with the same seeds and
actions. Under ``--restart transparent`` a death is part of the step: the rows that the infos name
must be those of whole shards, and are compared with sub-environments of the oracle that are reset
with the documented seeds; all others with the oracle's own. After a time-out both are reset.

Prints one JSON object; exits with 1 if a result differs, or descriptors or memory of this process
or of its worker server have grown. "untold" faults are those that met only sub-environments at the
end of an episode, which do not look at their action.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import sys
import time
from typing import Any

import numpy as np
import psutil

from envhub_sandbox import errors, make_env
from envhub_sandbox.session.recovery import RESTARTED, derived_seed
from tests.support import inside
from tests.support.samples import make_env_of, sample

REPOSITORY = sample("walk")
LANES = ("auto", "frames")
MIB = 1 << 20
LIVE, SLOW, HANG, EXIT = 0, 4, 5, 6
SLOW_S = 0.02
_COUNTED = (
    *("steps", "resets", "slow", "late", "stalls", "hangs", "exits", "kills"),
    *("revived_rows", "untold", "mismatches"),
)
_WARM_UP = 0.1
_MORE_FDS = 4
_MORE_MIB = 24
_SETTLE_S = 60.0


class Soak:
    """The environment, its oracle, and the count of what was done to them."""

    def __init__(self, arguments: argparse.Namespace, lane: str) -> None:
        self._rng = np.random.default_rng(arguments.seed)
        self._n = arguments.n_envs
        self._faults = arguments.fault_every
        self._transparent = arguments.restart == "transparent"
        self.counts = dict.fromkeys(_COUNTED, 0)
        self._oracle = make_env_of(REPOSITORY)(self._n)
        policy = {"restart": arguments.restart, "restart_budget": 10**9, "restart_backoff_s": 0}
        self.suites = make_env(
            REPOSITORY,
            n_envs=self._n,
            use_async_envs=True,
            num_workers=arguments.num_workers,
            lane=lane,
            policy=policy | {"crash_history": 0},
        )
        self.env = self.suites.env
        self.reset()

    def reset(self) -> None:
        """Begin anew, with a seed of its own."""
        self.counts["resets"] += 1
        self._seed = int(self._rng.integers(2**31))
        *got, infos = self.env.reset(seed=self._seed)
        infos.pop(RESTARTED, None), infos.pop(f"_{RESTARTED}", None)
        self._compare((*got, infos), self._oracle.reset(seed=self._seed))

    def _compare(self, got: Any, expected: Any) -> None:
        if not same(got, expected):
            self.counts["mismatches"] += 1

    def step(self) -> None:
        """One step; now and then something is done to it."""
        self.counts["steps"] += 1
        actions = self._rng.integers(0, SLOW, self._n)
        if self._rng.random() * self._faults < 1:
            faults = [self._slow, self._late, self._stall, self._hang, self._exit, self._kill]
            self._rng.choice(faults)(actions)
        else:
            self._step(actions)

    def _step(self, actions: Any) -> bool:
        """Step both and compare; whether anybody has died."""
        return self._check(self.env.step(actions), actions)

    def _check(self, got: Any, actions: Any) -> bool:
        expected = self._oracle.step(np.where(actions == EXIT, LIVE, actions))
        lost = got[4].get(RESTARTED)
        if lost is not None:
            self._revive(expected, lost)
        self._compare(got, expected)
        return lost is not None

    def _revive(self, expected: Any, lost: Any) -> None:
        """Do to the oracle what was promised for the rows that came back."""
        observations, rewards, terminations, truncations, infos = expected
        shards = [lost[start:stop] for start, stop in inside.bounds(self.env)]
        if any(shard.any() != shard.all() for shard in shards):
            self.counts["mismatches"] += 1
        restart = self.env.sandbox.stats()["restarts"]
        for row in np.flatnonzero(lost).tolist():
            self.counts["revived_rows"] += 1
            seed = derived_seed(self._seed + row, restart)
            observations[row], _ = self._oracle.envs[row].reset(seed=seed)
        rewards[lost], terminations[lost], truncations[lost] = 0, False, True
        self._oracle._autoreset_envs[lost] = True
        for key in [key for key in infos if not key.startswith("_")]:
            infos[key][lost], infos[f"_{key}"][lost] = 0, False
            if not infos[f"_{key}"].any():
                del infos[key], infos[f"_{key}"]
        infos[RESTARTED] = infos[f"_{RESTARTED}"] = lost

    def _slow(self, actions: Any) -> None:
        self.counts["slow"] += 1
        actions[self._rng.integers(self._n)] = SLOW
        self._step(actions)

    def _late(self, actions: Any) -> None:
        """The reply comes after the deadline, and must never be taken for another."""
        self.counts["late"] += 1
        actions[:] = SLOW
        self.env.step_async(actions)
        self._expect(errors.WorkerTimeoutError, lambda: self.env.step_wait(timeout=SLOW_S / 4))

    def _stall(self, actions: Any) -> None:
        """A process that does not run for a while."""
        self.counts["stalls"] += 1
        pid = int(self._rng.choice(inside.pids(self.env)))
        os.kill(pid, signal.SIGSTOP)
        self.env.step_async(actions)
        time.sleep(SLOW_S)
        os.kill(pid, signal.SIGCONT)
        self._check(self.env.step_wait(), actions)

    def _hang(self, actions: Any) -> None:
        self.counts["hangs"] += 1
        actions[:] = HANG
        self.env.step_async(actions)
        self._expect(errors.WorkerTimeoutError, lambda: self.env.step_wait(timeout=0.05))

    def _exit(self, actions: Any) -> None:
        self.counts["exits"] += 1
        if self._transparent:
            actions[self._rng.integers(self._n)] = EXIT
            self.counts["untold"] += not self._step(actions)
            return
        actions[:] = EXIT
        self._expect(errors.WorkerDiedError, lambda: self.env.step(actions))

    def _kill(self, actions: Any) -> None:
        """From outside, at any moment: a step before may still succeed."""
        self.counts["kills"] += 1
        os.kill(int(self._rng.choice(inside.pids(self.env))), signal.SIGKILL)
        if self._transparent:
            while not self._step(actions):
                pass
            return
        self._expect(errors.WorkerDiedError, lambda: self._until_it_fails(actions))

    def _until_it_fails(self, actions: Any) -> None:
        while True:
            self._step(actions)

    def _expect(self, kind: type[Exception], action: Any) -> None:
        try:
            action()
        except kind:
            pass
        else:
            self.counts["untold"] += 1
        self.reset()


def same(got: Any, expected: Any) -> bool:
    """Whether two steps gave the very same arrays and infos."""
    *arrays, infos = got
    *expected_arrays, expected_infos = expected
    pairs = zip(arrays, expected_arrays, strict=True)
    return (
        all(_equal(a, b) for a, b in pairs)
        and infos.keys() == expected_infos.keys()
        and all(_equal(infos[key], expected_infos[key]) for key in infos)
    )


def _equal(a: Any, b: Any) -> bool:
    return bool(a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b))


def _footprint(soak: Soak) -> dict[str, float]:
    """Descriptors, resident MiB and processes of this process and of its worker server."""
    gc.collect()
    server = psutil.Process(inside.server(soak.env).process.pid)
    found: dict[str, float] = {"processes": len(server.children(recursive=True))}
    for name, process in (("client", psutil.Process()), ("server", server)):
        found[f"{name}_descriptors"] = process.num_fds()
        found[f"{name}_mib"] = round(process.memory_info().rss / MIB, 1)
    return found


def _settled(soak: Soak, before: dict[str, float]) -> dict[str, float]:
    """The same once what was given up has ended, for which nobody waits; but not for ever."""
    end = time.monotonic() + _SETTLE_S
    while (now := _footprint(soak)) and _grown(before, now) and time.monotonic() < end:
        time.sleep(0.1)
    return now


def run(arguments: argparse.Namespace, lane: str) -> dict[str, Any]:
    """Soak one lane; what was done, and what has grown since the warm-up."""
    soak = Soak(arguments, lane)
    warm = max(1, int(arguments.steps * _WARM_UP))
    started = time.monotonic()
    with soak.suites:
        before = _footprint(soak)
        for number in range(arguments.steps):
            if number == warm:
                before = _footprint(soak)
            soak.step()
            if number and number % arguments.report_every == 0:
                print(lane, json.dumps(soak.counts), file=sys.stderr, flush=True)
        soak.reset()
        after = _settled(soak, before)
        stats = soak.env.sandbox.stats()
    return {
        **soak.counts,
        "seconds": round(time.monotonic() - started, 1),
        "after_warm_up": before,
        "at_the_end": after,
        "stats": stats,
    }


def passed(found: dict[str, Any]) -> bool:
    """Whether no result differed and nothing has grown."""
    return not _grown(found["after_warm_up"], found["at_the_end"]) and not found["mismatches"]


def _grown(before: dict[str, float], after: dict[str, float]) -> bool:
    allowed = {"descriptors": _MORE_FDS, "mib": _MORE_MIB, "processes": 0}
    return any(after[name] - before[name] > allowed[name.rpartition("_")[2]] for name in after)


def main(argv: list[str] | None = None) -> int:
    """Run the soak that the arguments describe; 0 if nothing differs and nothing has grown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="over all lanes")
    parser.add_argument("--n-envs", type=int, default=4)
    parser.add_argument("--num-workers", type=int, default=2)
    parser.add_argument("--lane", choices=(*LANES, "both"), default="both")
    parser.add_argument("--restart", choices=("on_reset", "transparent"), default="transparent")
    parser.add_argument("--fault-every", type=int, default=2000, help="steps between two faults")
    parser.add_argument("--report-every", type=int, default=50_000, help="steps; to stderr")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    lanes = LANES if arguments.lane == "both" else (arguments.lane,)
    arguments.steps //= len(lanes)
    found = {lane: run(arguments, lane) for lane in lanes}
    print(json.dumps(found, indent=1))
    return 0 if all(map(passed, found.values())) else 1


if __name__ == "__main__":
    sys.exit(main())
