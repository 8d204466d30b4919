"""What operators are given beside the program: a unit of systemd and a dashboard of Grafana."""

import argparse
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.extras.access.audit.figures import Client, facts_for_clients, facts_for_operators
from envhub_worker.extras.access.commands import identity, listen_options, metrics
from envhub_worker.extras.access.keys import AuthorizedClients
from envhub_worker.extras.access.quotas import Permissions, Quotas, Rules

ROOT = Path(__file__).parents[3]
UNIT = ROOT / "examples" / "deployment" / "envhub-worker.service"
DASHBOARD = ROOT / "examples" / "deployment" / "grafana-dashboard.json"
_WORST = 40
"""Of 100, where ``systemd-analyze security`` counts what a service could do."""
_OURS = re.compile(r"\b(?:envhub_server|process)_[a-z_]+\b")
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here"
)


def exported() -> dict[str, set[str]]:
    parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is missing")
    rules = Rules(
        keys=None,
        authorized=AuthorizedClients(None, {}),
        operators=frozenset(),
        quotas=Quotas(),
        permissions=Permissions(),
        idle_s=0,
    )
    share = vars(Client(requests={"step": 1}))
    told = {
        **facts_for_clients(rules),
        **facts_for_operators(rules, "/"),
        "started": 0.0,
        "draining_s": None,
        "ready": True,
        "connections": 0,
        "waiting": {"jails": 0},
        "refusals": {},
        "deaths": {},
        "clients": {"alice": share},
    }
    _, text = metrics.exposition()(told)
    found: dict[str, set[str]] = {}
    for family in parser.text_string_to_metric_families(text.decode()):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


def expressions(dashboard: Any) -> Iterator[str]:
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            yield target["expr"]


def test_the_dashboard_asks_for_what_is_exported() -> None:
    """No panel stays empty because of a name; and nothing that is exported is left out."""
    dashboard, names = json.loads(DASHBOARD.read_text()), exported()
    asked = {name for expr in expressions(dashboard) for name in _OURS.findall(expr)}
    assert asked <= set(names)
    assert {name for name in names if name.startswith("envhub_")} <= asked
    for variable in dashboard["templating"]["list"][1:]:
        assert set(_OURS.findall(variable["definition"])) <= set(names)
    panels = dashboard["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    assert len({(one["gridPos"]["x"], one["gridPos"]["y"]) for one in panels}) == len(panels)


def test_the_dashboard_groups_by_labels_that_there_are() -> None:
    names = exported()
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        for target in panel["targets"]:
            expr = target["expr"]
            known = {"instance"} | {label for name in _OURS.findall(expr) for label in names[name]}
            words = [*re.findall(r"\b(?:by|on) \(([a-z_, ]+)\)", expr), target["legendFormat"]]
            asked = set(re.findall(r"{{(\w+)}}", words[-1]))
            for group in words[:-1]:
                asked |= set(group.split(", "))
            asked |= set(re.findall(r'([a-z_]+)=~?"', expr))
            assert asked <= known, expr


def test_the_page_has_every_metric() -> None:
    page = (ROOT / "docs" / "observing.md").read_text()
    named = set(re.findall(r"`(envhub_server_\w+)`", page))
    assert named == {name for name in exported() if name.startswith("envhub_")}


def lines(name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", UNIT.read_text(), re.MULTILINE)


def test_the_unit_starts_what_there_is() -> None:
    """Its options are those of ``listen``, and it waits for longer than a drain takes."""
    [command] = lines("ExecStart")
    words = command.split()
    assert words[1] == "listen"
    parser = argparse.ArgumentParser(exit_on_error=False)
    listen_options.add_options(parser)
    options = parser.parse_args(words[2:])
    identity.check_bind(options.bind, options.insecure_loopback)
    assert options.drain_s < int(lines("TimeoutStopSec")[0])
    assert str(options.state_dir) == f"/var/lib/{lines('StateDirectory')[0]}"
    assert lines("KillMode") == ["mixed"]


def test_the_unit_masks_nothing_that_a_jail_needs() -> None:
    """The kernel lets nobody mount a ``/proc`` where the one in sight is masked."""
    text = UNIT.read_text()
    settings = set(re.findall(r"^(\w+)=", text, re.MULTILINE))
    spoilers = {
        *("ProtectKernelTunables", "ProtectKernelLogs", "ProtectControlGroups", "ProtectProc"),
        *("ProcSubset", "ProtectHostname", "PrivateUsers", "MemoryDenyWriteExecute"),
    }
    assert not settings & spoilers
    assert all(f"{name}=" in text for name in spoilers), "each is named, and why"


def analyzed(folder: Path, unit: str, *words: str) -> subprocess.CompletedProcess[str]:
    """What ``systemd-analyze`` says of a unit; it wants a program that is there."""
    path = folder / "envhub-worker.service"
    path.write_text(unit.replace("/opt/envhub-worker/bin/envhub-worker", sys.executable))
    command = ["systemd-analyze", *words, str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@needs_systemd
def test_systemd_reads_the_unit(tmp_path: Path) -> None:
    """Without a word to say about it; the control has a setting that there is not."""
    done = analyzed(tmp_path, UNIT.read_text(), "verify", "--man=no")
    if "Failed to" in done.stderr and done.returncode:
        pytest.skip(f"systemd-analyze cannot look at units here: {done.stderr.strip()[:200]}")
    assert (done.returncode, done.stderr) == (0, "")
    wrong = UNIT.read_text().replace("ProtectHome=yes", "ProtectHouse=yes")
    assert "ProtectHouse" in analyzed(tmp_path, wrong, "verify", "--man=no").stderr


@needs_systemd
def test_the_unit_is_hardened(tmp_path: Path) -> None:
    """As systemd counts it; the control is the same service with nothing of that."""
    words = ("security", "--offline=true", f"--threshold={_WORST}", "--no-pager")
    done = analyzed(tmp_path, UNIT.read_text(), *words)
    if "exposure level" not in done.stdout + done.stderr:
        pytest.skip(f"systemd-analyze does not rate files here: {done.stderr.strip()[:200]}")
    assert done.returncode == 0, done.stdout
    bare = re.sub(
        r"(?m)^(Protect|Restrict|Private|Cap|System|NoNew|Lock)\w+=.*\n", "", UNIT.read_text()
    )
    assert analyzed(tmp_path, bare, *words).returncode != 0
