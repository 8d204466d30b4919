"""``send`` and ``recv`` against ``step``: ``python -m benchmarks async --help``.

Three cases in which a learner waits for something that could go on meanwhile:

- *unlike*: sub-environments whose steps take 1 to 20 ms at random, each alike often or each length
  as often as its double (log-uniform). ``step`` waits for the longest of 16, ``recv(min_ready=4)``
  for the first four. *Bound*: the longest of 16 over the mean, of the lengths that were drawn;
  nothing that gives every sub-environment the same number of steps can be faster.
- *policy*: a policy that takes 5 ms for a batch, as on a GPU, and environments that take 5 ms.
  With twice as many sub-environments one half steps while the policy is at the other.
- *wire*: a server 10 ms away, each way. One action at a time gains nothing, for each answer takes
  20 ms: what hides the wire are several in flight, as of a policy that gives chunks of actions.

Each way has its turn in each round, within one process, in a new order; ratios are of
sub-environments' steps per second within a round. Reported: the median over the rounds, and the
quartiles.
"""

from __future__ import annotations

import argparse
import random
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import numpy as np

from benchmarks.load import load_average, stolen
from benchmarks.machine import machine
from benchmarks.remote import delaying, listening
from envhub_sandbox import RemoteSandbox, make_env

_REPOSITORY = str(Path(__file__).parent / "repositories" / "waiting")
_COUNT, _READY, _WIRE_MS, _POLICY_MS = 16, 4, 10, 5.0
_SHORTEST_MS, _LONGEST_MS = 1.0, 20.0
_DRAWN = 4096
Way = Callable[[float], float]
"""Goes on for so many seconds; returns sub-environments' steps per second."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table, a line as soon as it is measured."""
    options = _parser().parse_args(arguments)
    facts = machine()
    print(f"{facts['processor']}, {facts['cores']} cores\n")
    print("| case | steps/s by `step` | by `send`, `recv` | ratio | quartiles | bound | goal |")
    print("|---|---|---|---|---|---|---|", flush=True)
    before = stolen()
    for name in options.cases:
        for row in _CASES[name](options.rounds, options.seconds):
            print(row, flush=True)
    lost, passed = (late - early for late, early in zip(stolen(), before, strict=True))
    print(f"\n{lost / max(passed, 1):.1%} of the time stolen, load {load_average():.1f}")


def _row(title: str, ways: tuple[Way, Way], rounds: int, seconds: float, known: str) -> str:
    """One line; the two ways in turn, in a new order each round."""
    rates: list[tuple[float, float]] = []
    shuffled = random.Random(0)
    for way in ways:
        way(seconds / 4)
    for _ in range(rounds):
        found = [0.0, 0.0]
        for index in shuffled.sample((0, 1), 2):
            found[index] = ways[index](seconds)
        rates.append((found[0], found[1]))
    ratios = sorted(late / early for early, late in rates)
    low, middle, high = (float(np.percentile(ratios, part)) for part in (25, 50, 75))
    by_step, by_recv = (statistics.median(column) for column in zip(*rates, strict=True))
    cells = f"{title} | {by_step:.0f} | {by_recv:.0f} | {middle:.2f} | {low:.2f} to {high:.2f}"
    return f"| {cells} | {known} |"


# --- unlike ------------------------------------------------------------------------------------


def _unlike(rounds: int, seconds: float) -> Iterator[str]:
    rng = np.random.default_rng(0)
    even = rng.uniform(_SHORTEST_MS, _LONGEST_MS, _DRAWN)
    octaves = np.exp(rng.uniform(np.log(_SHORTEST_MS), np.log(_LONGEST_MS), _DRAWN))
    with make_env(_REPOSITORY, _COUNT, min_ready=_READY) as suites:
        suites.env.reset(seed=0)
        for name, drawn, goal in (("uniform", even, "-"), ("log-uniform", octaves, "2.5")):
            bound = drawn.reshape(-1, _COUNT).max(1).mean() / drawn.mean()
            ways = _stepping(suites.env, drawn), _receiving(suites.env, drawn)
            yield _row(f"1 to 20 ms, {name}", ways, rounds, seconds, f"{bound:.2f} | {goal}")


def _batches(drawn: Any, count: int) -> Iterator[Any]:
    start = 0
    while True:
        yield drawn[start : start + count]
        start = (start + count) % (len(drawn) - count)


def _stepping(env: Any, drawn: Any) -> Way:
    def run(seconds: float) -> float:
        batches, count, begun = _batches(drawn, env.num_envs), 0, perf_counter()
        while perf_counter() - begun < seconds:
            env.step(next(batches))
            count += env.num_envs
        return count / (perf_counter() - begun)

    return run


def _receiving(env: Any, drawn: Any, ahead: int = 1) -> Way:
    def run(seconds: float) -> float:
        for _, batch in zip(range(ahead), _batches(drawn, env.num_envs), strict=False):
            env.send(batch)
        batches = _batches(drawn, _READY)
        count, begun = 0, perf_counter()
        while perf_counter() - begun < seconds:
            received = env.recv()
            count += len(received.env_ids)
            env.send(_of(next(batches), len(received.env_ids)), received.env_ids)
        rate = count / (perf_counter() - begun)
        env.reset()  # takes what is in flight
        return rate

    return run


def _of(batch: Any, count: int) -> Any:
    return batch if len(batch) == count else np.resize(batch, count)


# --- policy ------------------------------------------------------------------------------------


def _policy(rounds: int, seconds: float) -> Iterator[str]:
    think = lambda: sleep(_POLICY_MS / 1e3)  # noqa: E731
    same = np.full(_DRAWN, _POLICY_MS)
    with ExitStack() as stack:
        one = stack.enter_context(make_env(_REPOSITORY, 4, min_ready=4)).env
        two = stack.enter_context(make_env(_REPOSITORY, 8, min_ready=4)).env
        for env in (one, two):
            env.reset(seed=0)
        title = "policy 5 ms, environment 5 ms: two halves of 4 against"
        double = _in_halves(two, same, think)
        alone = _thinking(one, same, think), double
        yield _row(f"{title} 4", alone, rounds, seconds, "2.00 | 1.8")
        together = _thinking(two, same, think), double
        yield _row(f"{title} 8 at once", together, rounds, seconds, "1.00 | -")


def _thinking(env: Any, drawn: Any, think: Callable[[], None]) -> Way:
    def run(seconds: float) -> float:
        batch, count, begun = drawn[: env.num_envs], 0, perf_counter()
        while perf_counter() - begun < seconds:
            think()
            env.step(batch)
            count += env.num_envs
        return count / (perf_counter() - begun)

    return run


def _in_halves(env: Any, drawn: Any, think: Callable[[], None]) -> Way:
    half = env.num_envs // 2

    def run(seconds: float) -> float:
        env.send(drawn[:half], np.arange(half))
        think()
        env.send(drawn[:half], np.arange(half, 2 * half))
        count, begun = 0, perf_counter()
        while perf_counter() - begun < seconds:
            received = env.recv(half)
            count += len(received.env_ids)
            think()
            env.send(drawn[: len(received.env_ids)], received.env_ids)
        rate = count / (perf_counter() - begun)
        env.reset()
        return rate

    return run


# --- wire --------------------------------------------------------------------------------------


def _wire(rounds: int, seconds: float) -> Iterator[str]:
    nothing = np.zeros(_DRAWN)
    with _distant() as place, ExitStack() as stack:
        ways = [(1, 1, "1.00 | -"), (1, 16, "16.00 | 8"), (_COUNT, 1, "1.00 | -")]
        envs = {
            workers: stack.enter_context(
                make_env(_REPOSITORY, _COUNT, num_workers=workers, min_ready=_READY, sandbox=place)
            ).env
            for workers in (1, _COUNT)
        }
        for workers, ahead, known in ways:
            env = envs[workers]
            env.reset(seed=0)
            title = f"10 ms each way, {_COUNT} in {workers}, {ahead} in flight"
            pair = _stepping(env, nothing), _receiving(env, nothing, ahead)
            yield _row(title, pair, rounds, seconds, known)


@contextmanager
def _distant() -> Iterator[RemoteSandbox]:
    """A server with keys behind a wire that delays."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        state = Path(folder, "state")
        endpoint = stack.enter_context(listening(state))
        public, secret = ((state / name).read_text() for name in ("server.pub", "client.key"))
        yield RemoteSandbox(stack.enter_context(delaying(endpoint, _WIRE_MS)), public, secret)


_CASES = {"unlike": _unlike, "policy": _policy, "wire": _wire}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks async",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--cases", nargs="+", choices=_CASES, default=list(_CASES))
    add("--rounds", type=int, default=7)
    add("--seconds", type=float, default=1.5, help="of each turn")
    return parser
