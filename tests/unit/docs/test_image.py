"""The container image installs what the worker imports, and cannot drift from pyproject.toml."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

import envhub_worker
from tests.unit.docs.test_imports import WORKERS_OWN

pytestmark = pytest.mark.same_for("users", "versions")

CHECKOUT = Path(__file__).resolve().parents[3]
_IMPORTED_AS = {"pyzmq": "zmq"}


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    if sys.version_info < (3, 11):
        tomllib = pytest.importorskip("pip._vendor.tomli")
    else:
        import tomllib
    return tomllib.loads((CHECKOUT / "pyproject.toml").read_text())


def name_of(requirement: str) -> str:
    """The distribution that a requirement names."""
    return re.split(r"[^\w-]", requirement, maxsplit=1)[0]


def test_the_workers_group_is_what_the_worker_imports(project: dict[str, Any]) -> None:
    """No more and no less; word for word as the package needs it."""
    group = project["dependency-groups"]["worker"]
    assert set(group) <= set(project["project"]["dependencies"])
    names = {name_of(one) for one in group}
    assert {_IMPORTED_AS.get(name, name) for name in names} == WORKERS_OWN - {"envhub_worker"}


def test_the_image_can_be_watched(project: dict[str, Any]) -> None:
    """It installs what the worker imports, and what its figures need, word for word."""
    installed = re.findall(r"--group (\S+)", (CHECKOUT / "Dockerfile").read_text())
    group = project["dependency-groups"]["image"]
    assert installed == ["image"]
    assert {"include-group": "worker"} in group
    assert set(project["project"]["optional-dependencies"]["metrics"]) <= {
        one for one in group if isinstance(one, str)
    }


def test_nothing_but_the_worker_goes_into_the_image() -> None:
    """What is not listed never reaches the engine: no tests, no client, no history."""
    lines = (CHECKOUT / ".dockerignore").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules == ["*", "!pyproject.toml", "!worker", "**/__pycache__"]


def test_the_image_runs_as_nobody_and_carries_the_projects_version() -> None:
    text = (CHECKOUT / "Dockerfile").read_text()
    assert f"ARG VERSION={envhub_worker.__version__}\n" in text
    final = text.rpartition("\nFROM ")[2]
    assert re.search(r"^USER (\d+):\1$", final, re.MULTILINE)
    assert not re.search(r"^USER (root|0)", final, re.MULTILINE)
