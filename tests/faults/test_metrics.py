"""The counters say what has happened, and so does what Prometheus reads, by its own parser."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import errors
from envhub_sandbox.session import counters
from envhub_sandbox.session.counters import KEPT, Counters, Labels, Ledger
from envhub_worker.protocol.lifecycle import Lifecycle
from tests.support import inside
from tests.support.processes import halted
from tests.support.repositories import write_repository
from tests.support.samples import sample
from tests.support.started import started

pytestmark = pytest.mark.usefixtures("neighbour")
Key = tuple[str, frozenset[tuple[str, str]]]


@pytest.fixture
def registry() -> Any:
    """A registry of its own with our collector, as a user would make it."""
    prometheus_client = pytest.importorskip("prometheus_client")
    from envhub_sandbox.integrations.metrics import EnvHubCollector

    found = prometheus_client.CollectorRegistry(auto_describe=True)
    found.register(EnvHubCollector())
    return found


def scraped(registry: Any, repository: str) -> dict[Key, float]:
    """The samples about one repository, out of the text that Prometheus would get."""
    from prometheus_client import generate_latest
    from prometheus_client.parser import text_string_to_metric_families

    text = generate_latest(registry).decode()
    return {
        (one.name, frozenset(one.labels.items()) - {("repository", repository)}): one.value
        for family in text_string_to_metric_families(text)
        for one in family.samples
        if one.labels.get("repository") == repository
    }


def key(name: str, **labels: str) -> Key:
    return name, frozenset({"suite": "hub_env", "task": "0", **labels}.items())


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    return write_repository(tmp_path / "echo", (sample("echo") / "env.py").read_text())


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_what_happens_is_counted_once_and_exported(
    registry: Any, repository: Path, lane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps, timeouts, deaths and restarts, over both lanes."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 120.0)
    with started(repository, policy={"restart": "on_reset", "lane": lane}, seed=None) as env:
        for _ in range(5):
            env.step([[1.0, 0.0]])
        with halted(inside.pids(env)):
            env.step_async([[1.0, 0.0]])
            with pytest.raises(errors.WorkerTimeoutError):
                env.step_wait(timeout=0.02)
        assert env.sandbox.stats()["state"] == "LATE"
        env.reset()
        with pytest.raises(errors.WorkerDiedError):
            env.step([[1.0, -1.0]])
        assert env.sandbox.stats()["state"] == "DEAD"
        env.reset()
        exported, told = scraped(registry, f"{repository}:env.py"), env.sandbox.stats()
    assert env.sandbox.stats()["state"] == "CLOSED"
    latency = told.pop("step_latency_s")
    assert latency["total"] >= latency["max"]
    assert 0 < latency["p50"] <= latency["p90"] <= latency["p99"] <= latency["max"]
    assert told["sent_bytes"] > 6 * 8
    assert told["received_bytes"] > 6 * (8 + 8 + 1 + 1)
    counted = {"requests": 3 + 5 + 1 + 1, "steps": 5, "stale_replies": 0, "state": "READY"}
    once = dict.fromkeys(("timeouts", "deaths", "restarts"), 1)
    assert told == {**told, **counted, **once}
    assert len(told) == len(counted) + len(once) + 2
    names = ("requests", "steps", "timeouts", "stale_replies", "sent_bytes", "received_bytes")
    expected = {key(f"envhub_{name}_total"): told[name] for name in names}
    expected |= {key(f"envhub_worker_{name}_total"): 1 for name in ("deaths", "restarts")}
    of = "envhub_step_latency_seconds"
    expected |= {key(f"{of}_count"): 5, key(f"{of}_sum"): latency["total"]}
    for quantile, name in (("0.5", "p50"), ("0.9", "p90"), ("0.99", "p99")):
        expected[key(of, quantile=quantile)] = latency[name]
    expected[key("envhub_environments", state="ready")] = 1
    assert {name: exported[name] for name in expected} == pytest.approx(expected)


def test_counts_outlive_their_environments(registry: Any, repository: Path) -> None:
    """A counter never falls: environments of the same labels add up, and stay when they go."""
    label = f"{repository}:env.py"
    counts = []
    for _ in range(3):
        with started(repository, seed=None) as env:
            env.step([[1.0, 0.0]])
            counts.append(scraped(registry, label)[key("envhub_steps_total")])
        del env
        gc.collect()
    assert counts == [1, 2, 3]
    found = scraped(registry, label)
    assert found[key("envhub_steps_total")] == 3
    assert not [name for name, _ in found if name == "envhub_environments"]


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_bytes_are_counted_over_both_lanes(lane: str) -> None:
    """At least the arrays that went, at most a little more; also after a restart."""
    policy = {"restart": "on_reset", "restart_backoff_s": 0, "lane": lane}
    with started(sample("echo"), n_envs=4, policy=policy, seed=None) as env:
        before = env.sandbox.stats()
        for _ in range(10):
            env.step(np.ones((4, 2)) * [1.0, 0.0])
        after = env.sandbox.stats()
        sent, received = (after[name] - before[name] for name in ("sent_bytes", "received_bytes"))
        assert 10 * 4 * 2 * 8 <= sent <= 10 * (4 * 2 * 8 + 500)
        assert 10 * 4 * (2 * 8 + 10) <= received <= 10 * (4 * (2 * 8 + 10) + 500)
        with pytest.raises(errors.WorkerDiedError):
            env.step(np.ones((4, 2)) * [1.0, -1.0])
        env.reset()
        assert env.sandbox.stats()["sent_bytes"] > after["sent_bytes"]
    assert env.sandbox.stats()["received_bytes"] > after["received_bytes"]


class Env:
    """What the ledger counts."""


def test_what_is_gone_takes_no_room() -> None:
    ledger, labels = Ledger(), Labels("r", "s", "t")
    for _ in range(1000):
        env, counted = Env(), Counters()
        ledger.add(env, labels, counted, Lifecycle())
        counted.stepped(10**9)
        counted.restarts = 2
        del env
    [row] = ledger.rows()
    assert (row.numbers["steps"], row.numbers["step_seconds"]) == (1000, 1000.0)
    assert (row.numbers["restarts"], row.states, row.latencies_s.size) == (2000, {}, 0)
    assert not inside.living(ledger)
    ledger.forget()
    assert ledger.rows() == []


def test_names_of_the_worker_cannot_break_the_exposition(
    registry: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger, env = Ledger(), Env()
    nasty = 'a"b\\c\nd} 5\x1b[31m'
    ledger.add(env, Labels("r", nasty, nasty * 1000), Counters(), Lifecycle())
    monkeypatch.setattr("envhub_sandbox.integrations.metrics.LEDGER", ledger)
    found = scraped(registry, "r")
    assert all("\x1b" not in value for _, labels in found for _, value in labels)
    suites = {dict(labels)["suite"] for _, labels in found}
    assert suites == {'a"b\\c\nd} 5\\x1b[31m'}
    assert counters.LEDGER is not ledger


def test_latencies_are_those_of_the_last_steps() -> None:
    counters = Counters()
    assert counters.snapshot()["step_latency_s"] == {"total": 0.0}
    for seconds in [1] * KEPT + [2] * KEPT:
        counters.stepped(seconds * 10**9)
    expected = {**dict.fromkeys(("p50", "p90", "p99", "max"), 2.0), "total": 3.0 * KEPT}
    told = counters.snapshot()
    assert (told["step_latency_s"], told["steps"]) == (expected, 2 * KEPT)
