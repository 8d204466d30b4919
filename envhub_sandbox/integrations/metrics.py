"""The counters of all environments of this process, for Prometheus.

    >>> import prometheus_client
    >>> from envhub_sandbox.integrations.metrics import EnvHubCollector
    >>> prometheus_client.REGISTRY.register(EnvHubCollector())

Needs ``pip install 'envhub-sandbox[metrics]'``. A scrape reads counters that every environment has
anyway, and sends no request to a worker. Labels are ``repository`` (with commit and entry file),
``suite`` and ``task``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.session.counters import LEDGER, Row
from envhub_worker.protocol.text import printable

try:
    from prometheus_client.core import (
        CounterMetricFamily,
        GaugeMetricFamily,
        Metric,
        SummaryMetricFamily,
    )
    from prometheus_client.registry import Collector
except ImportError as missing:
    raise DependencyError(
        "metrics need prometheus_client: pip install 'envhub-sandbox[metrics]'"
    ) from missing

_LABELS = ("repository", "suite", "task")
_QUANTILES = (0.5, 0.9, 0.99)
_LABEL_CHARS = 256

# the metric, without the _total that the exposition adds; the number in the ledger; the help
_COUNTERS = (
    ("envhub_requests", "requests", "Requests sent, steps among them."),
    ("envhub_steps", "steps", "Vector steps that were answered."),
    ("envhub_timeouts", "timeouts", "Requests that were not answered in time."),
    ("envhub_worker_deaths", "deaths", "Worker processes that ended under a request."),
    ("envhub_worker_restarts", "restarts", "Workers that were started after a death."),
    ("envhub_stale_replies", "stale_replies", "Late replies that were dropped."),
    ("envhub_sent_bytes", "sent_bytes", "Bytes sent to workers, over both lanes."),
    ("envhub_received_bytes", "received_bytes", "Bytes received from workers, over both lanes."),
)


class EnvHubCollector(Collector):
    """Collects the numbers of all environments; ``register`` it with a registry."""

    def collect(self) -> Iterator[Metric]:
        """Yield a family for each metric."""
        rows = LEDGER.rows()
        for name, number, text in _COUNTERS:
            counter = CounterMetricFamily(name, text, labels=_LABELS)
            for row in rows:
                counter.add_metric(_values(row), row.numbers[number])
            yield counter
        gauge = GaugeMetricFamily(
            "envhub_environments", "Environments, by their state.", labels=(*_LABELS, "state")
        )
        for row in rows:
            for state, count in row.states.items():
                if state != "CLOSED":
                    gauge.add_metric([*_values(row), state.lower()], count)
        yield gauge
        yield _latency(rows)


def _latency(rows: list[Row]) -> Metric:
    name = "envhub_step_latency_seconds"
    family = SummaryMetricFamily(
        name,
        "From the request of a vector step to its reply; quantiles of the last 1024 steps of each "
        "environment.",
        labels=_LABELS,
    )
    for row in rows:
        values = _values(row)
        family.add_metric(values, int(row.numbers["steps"]), row.numbers["step_seconds"])
        if row.latencies_s.size:
            quantiles = np.quantile(row.latencies_s, _QUANTILES).tolist()
            for quantile, seconds in zip(_QUANTILES, quantiles, strict=True):
                labels = {**dict(zip(_LABELS, values, strict=True)), "quantile": str(quantile)}
                family.add_sample(name, labels, seconds)
    return family


def _values(row: Row) -> list[str]:
    """Return the values of the labels. Trust: the worker chose suite and task."""
    return [printable(value, _LABEL_CHARS) for value in row.labels]
