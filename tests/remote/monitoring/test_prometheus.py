"""A real Prometheus scrapes a server at work, and every panel of the dashboard is asked of it."""

import json
import os
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.errors import ServerBusyError, WorkerDiedError
from tests.remote.monitoring.watched import Watched, watched
from tests.support.processes import eventually
from tests.support.started import started
from tests.unit.docs.test_deployment import DASHBOARD, expressions

pytestmark = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None,
    reason="there is no prometheus here",
)
pytest.importorskip("prometheus_client", reason="prometheus-client is missing")
_SCRAPES = """
global: {{scrape_interval: 1s}}
scrape_configs:
  - job_name: envhub
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
"""


class Prometheus:
    """Its HTTP interface."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self.process = process
        self._log = log

    def said(self) -> str:
        return self._log.read_text("utf-8", "replace")

    @property
    def address(self) -> str:
        """Where it listens, as it says; empty before it does."""
        lines = (line for line in self.said().splitlines() if "Listening on" in line)
        return next((line.rpartition("address=")[2] for line in lines), "")

    @property
    def is_ready(self) -> bool:
        """Whether it answers queries; it listens before it does."""
        try:
            with urllib.request.urlopen(f"http://{self.address}/-/ready", timeout=60):
                return True
        except urllib.error.HTTPError:
            return False

    def query(self, expression: str) -> list[Any]:
        words = urllib.parse.urlencode({"query": expression})
        url = f"http://{self.address}/api/v1/query?{words}"
        try:
            with urllib.request.urlopen(url, timeout=60) as answer:
                found: list[Any] = json.load(answer)["data"]["result"]
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{expression}: {error.read().decode()}") from None
        return found


@contextmanager
def scraping(folder: Path, port: int) -> Iterator[Prometheus]:
    """A Prometheus that looks at one server each second."""
    folder.mkdir()
    (folder / "prometheus.yml").write_text(_SCRAPES.format(port=port))
    options = ["--config.file=prometheus.yml", "--storage.tsdb.path=data"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            ["prometheus", *options, "--web.listen-address=127.0.0.1:0"],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    try:
        found = Prometheus(process, folder / "log")
        assert eventually(lambda: bool(found.address) or process.poll() is not None)
        assert process.poll() is None, found.said()
        assert eventually(lambda: found.is_ready), found.said()
        yield found
    finally:
        process.kill()
        process.wait()


def test_every_panel_of_the_dashboard_shows_something(tmp_path: Path, repository: Path) -> None:
    """With a client at work, one that was refused, and a jail that was killed."""
    asked = [
        one.replace("$instance", ".*").replace("$__rate_interval", "5m")
        for one in expressions(json.loads(DASHBOARD.read_text()))
    ]
    with (
        watched(tmp_path / "server", "--max-jails", "1") as one,
        scraping(tmp_path / "prometheus", one.port) as prometheus,
    ):
        # an increase is one between two scrapes: the first has to come before what is counted
        assert eventually(lambda: bool(prometheus.query("envhub_server_ready == 1")))
        with started(repository, sandbox=one.server.sandbox()) as env:
            assert eventually(lambda: bool(prometheus.query("envhub_server_requests_total > 0")))
            for _ in range(5):
                env.step(np.array([0]))
            with pytest.raises(ServerBusyError), started(repository, sandbox=one.server.sandbox()):
                pass
            empty = [
                expression
                for expression in asked
                if "deaths" not in expression
                and not eventually(lambda one=expression: bool(prometheus.query(one)))
            ]
            assert not empty, empty
            os.kill(one.server.sessions()[0]["jails"][0]["pids"][0], 9)
            with pytest.raises(WorkerDiedError):
                env.step(np.array([0]))
        [deaths] = [expression for expression in asked if "deaths" in expression]
        assert eventually(lambda: bool(prometheus.query(deaths)))


def test_promtool_finds_no_fault_with_the_page(tmp_path: Path, repository: Path) -> None:
    with watched(tmp_path / "server") as one, started(repository, sandbox=one.server.sandbox()):
        assert eventually(lambda: "envhub_server_sessions{" in _page_of(one))  # each second anew
        command = ["promtool", "check", "metrics"]
        done = subprocess.run(
            command, input=_page_of(one), capture_output=True, text=True, timeout=60
        )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    wrong = subprocess.run(
        command,
        input="# TYPE a_total gauge\na_total 1\n",
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert wrong.returncode != 0


def _page_of(one: Watched) -> str:
    status, text = one.get("/metrics")
    assert status == 200
    return text
