"""A server with a port of figures, and a reader of these."""

import contextlib
import http.client
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.remote.listening import Listening, listening
from tests.support.processes import eventually

parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is missing")


@dataclass
class Watched:
    """A server, and the port of its figures."""

    server: Listening
    port: int

    def get(self, path: str) -> tuple[int, str]:
        return get(self.port, path)

    def values(self) -> dict[tuple[str, ...], float]:
        """Every sample: its name and the values of its labels, in the labels' order."""
        status, text = self.get("/metrics")
        assert status == 200, text
        return {
            (one.name, *(one.labels[label] for label in sorted(one.labels))): one.value
            for family in parser.text_string_to_metric_families(text)
            for one in family.samples
        }

    def shows(self, *name: str, value: float) -> bool:
        return eventually(lambda: self.values().get(name) == value)


def get(port: int, path: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


@contextlib.contextmanager
def watched(folder: Path, *options: str) -> Iterator[Watched]:
    """A server with a port of figures."""
    with listening(folder, "--metrics", "0", *options) as server:
        found = re.search(r"metrics url=http://127\.0\.0\.1:(\d+)/metrics", server.said())
        assert found is not None, server.said()
        one = Watched(server, int(found[1]))
        assert eventually(lambda: one.get("/readyz")[0] == 200)
        yield one
