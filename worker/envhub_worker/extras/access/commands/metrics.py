"""``listen --metrics``: the server's figures in Prometheus's format, and its health.

The server's own thread publishes figures from time to time; requests read the last ones and cost
that thread nothing. Needs prometheus_client (the extra ``metrics``) for the text.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from envhub_worker.extras.access.audit.figures import REFUSALS
from envhub_worker.extras.access.commands.http_port import Reply
from envhub_worker.protocol.confinement import REASONS

MISSING = (
    "--metrics needs prometheus_client, which is not installed in this interpreter: pip install "
    "'envhub-sandbox[metrics]', or prometheus-client if only the worker is installed"
)
STALE_S = 30.0
"""A server publishes every second. One that has not for so long is stuck."""
_TEXT = "text/plain; charset=utf-8"


class MetricsPage:
    """The pages of the port. ``render``: returns figures as text, with the content type."""

    def __init__(
        self,
        usable: bool,
        render: Callable[[Mapping[str, Any]], tuple[str, bytes]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._usable = usable
        self._render = render
        self._clock = clock
        self._published: tuple[float, Mapping[str, Any]] | None = None
        self._rendered: tuple[Mapping[str, Any], Reply] | None = None

    def publish(self, figures: Mapping[str, Any]) -> None:
        """Replace the figures; the caller does not change them afterwards."""
        self._published = self._clock(), {**figures, "ready": self._usable and not _drains(figures)}

    def answer(self, path: str) -> Reply:
        """Returns the page of a path."""
        if path not in ("/metrics", "/healthz", "/readyz"):
            return 404, _TEXT, b"/metrics, /healthz, /readyz\n"
        published = self._published  # another thread replaces it
        published_at, figures = (0.0, None) if published is None else published
        age_s = self._clock() - published_at
        wrong, right = "", "ready" if path == "/readyz" else "well"
        if figures is None:
            wrong = "it has only just been started"
        elif age_s > STALE_S:
            wrong = f"its loop has not run for {age_s:.0f} s"
        elif path == "/metrics":
            if self._rendered is None or self._rendered[0] is not figures:  # once a publication
                self._rendered = figures, (200, *self._render(figures))
            return self._rendered[1]
        elif path == "/readyz" and _drains(figures):
            wrong = "it drains: it accepts nothing new"
        elif path == "/readyz" and not self._usable:
            wrong = "no jail can be opened here: see its log, or envhub doctor"
        return 503 if wrong else 200, _TEXT, f"{wrong or right}\n".encode()


def _drains(figures: Mapping[str, Any]) -> bool:
    return figures["draining_s"] is not None


# --- as Prometheus reads them ------------------------------------------------------------------

# the metric (counters without the _total that the exposition adds), the figures' key, the help
_GAUGES = (
    ("envhub_server_start_time_seconds", "started", "When it was started, in Unix time."),
    ("envhub_server_ready", "ready", "1 while it accepts new clients."),
    ("envhub_server_connections", "connections", "Open connections, of unknown hosts too."),
    ("envhub_server_connections_limit", "max_connections", "Maximum number of connections."),
)
_CLIENT_GAUGES = (
    ("envhub_server_sessions", "sessions", "Processes of a client that are connected."),
    ("envhub_server_jails", "jails", "Open jails."),
    ("envhub_server_runners", "runners", "Processes of environments in open jails."),
    ("envhub_server_memory_limit_bytes", "memory_limit_bytes", "Sum of open jails' limits."),
    ("envhub_server_memory_bytes", "memory_bytes", "Memory of open jails, looked at now and then."),
    ("envhub_server_upload_bytes", "upload_bytes", "What a client's snapshots are charged."),
    ("envhub_server_inflight_bytes", "inflight_bytes", "Requests that are not answered yet."),
)
_CLIENT_COUNTERS = (
    ("envhub_server_jails_opened", "opened", "Jails that were opened."),
    ("envhub_server_cpu_seconds", "cpu_s", "Processor time of jails, looked at now and then."),
)


class ServerCollector:
    """The families of one publication; see ``prometheus_client.registry.Collector``."""

    def __init__(self, figures: Mapping[str, Any]) -> None:
        self._figures = figures

    def collect(self) -> Iterator[Any]:
        """The metrics, one family each."""
        from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily

        figures = self._figures
        words = ("version", "python", "profile", "weakest_profile")
        yield InfoMetricFamily(
            "envhub_server",
            "Versions, and what can be enforced.",
            {**{word: str(figures[word]) for word in words}, "protocol": str(figures["protocol"])},
        )
        for name, key, text in _GAUGES:
            yield GaugeMetricFamily(name, text, float(figures[key]))
        yield GaugeMetricFamily(
            "envhub_server_draining", "1 once its end has begun.", float(_drains(figures))
        )
        yield from self._of_words()
        yield from self._of_clients(figures["clients"])

    def _of_words(self) -> Iterator[Any]:
        figures, disk = self._figures, self._figures["disk"]
        # all of them from the start on: what has not happened yet is 0, and no gap
        refusals = {word: figures["refusals"].get(word, 0) for word in (*REFUSALS, "other")}
        deaths = {word: figures["deaths"].get(word, 0) for word in REASONS}
        disk = {"free": disk["free_bytes"], "size": disk["size_bytes"]}
        for name, text, label, values, counts in (
            ("quota", "Of one client key.", "quota", figures["quotas"], False),
            ("waiting", "Clients that wait for room.", "quota", figures["waiting"], False),
            ("state_disk_bytes", "The disk of keys and snapshots.", "what", disk, False),
            ("refusals", "Requests that were not carried out.", "reason", refusals, True),
            ("deaths", "Jails that ended unasked.", "reason", deaths, True),
        ):
            rows = [([word], value) for word, value in values.items()]
            yield _family(f"envhub_server_{name}", text, (label,), rows, counts=counts)

    def _of_clients(self, clients: Mapping[str, Any]) -> Iterator[Any]:
        for table in (_CLIENT_GAUGES, _CLIENT_COUNTERS):
            for name, key, text in table:
                rows = [([client], share[key]) for client, share in clients.items()]
                counts = table is _CLIENT_COUNTERS
                yield _family(name, text, ("client",), rows, counts=counts)
        rows = [
            ([client, word], value)
            for client, share in clients.items()
            for word, value in share["requests"].items()
        ]
        text = "What clients asked of their environments."
        labels = ("client", "operation")
        yield _family("envhub_server_requests", text, labels, rows, counts=True)


def _family(
    name: str,
    text: str,
    labels: Sequence[str],
    rows: Sequence[tuple[Sequence[str], float]],
    *,
    counts: bool,
) -> Any:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    family = (CounterMetricFamily if counts else GaugeMetricFamily)(name, text, labels=labels)
    for values, value in rows:
        family.add_metric(values, value)
    return family


def exposition() -> Callable[[Mapping[str, Any]], tuple[str, bytes]]:
    """Returns a function that renders figures as text. Raises ``ImportError``."""
    try:
        from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, ProcessCollector
        from prometheus_client.exposition import generate_latest
    except ImportError as missing:
        raise ImportError(MISSING) from missing

    def render(figures: Mapping[str, Any]) -> tuple[str, bytes]:
        registry = CollectorRegistry(auto_describe=False)
        ProcessCollector(registry=registry)  # the server's own memory, descriptors and time
        registry.register(ServerCollector(figures))
        return CONTENT_TYPE_LATEST, generate_latest(registry)

    return render
