"""Both distributions and the image hold what they should, and what an index looks at. ``python -m
tests.distributions`` builds, checks and installs both; this is what needs no network."""

import re
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml

import envhub_sandbox
import envhub_worker
from tests.unit.docs.test_imports import WORKERS_OWN

NAME = "lerobot_env_envhub_sandbox"
BUILD = """
import sys
from setuptools import build_meta
print(getattr(build_meta, sys.argv[1])(sys.argv[2]))
"""


def built(kind: str, source: Path, into: Path) -> Path:
    into.mkdir(exist_ok=True)
    command = [sys.executable, "-c", BUILD, f"build_{kind}", str(into)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    return into / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def plugin(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plugin's wheel, built of its unpacked source distribution, as an index would have it."""
    folder = tmp_path_factory.mktemp("plugin")
    source = folder / "source"
    for path in (checkout / "plugins" / NAME).rglob("*"):
        if path.is_file() and path.suffix in ("", ".md", ".py", ".toml"):
            copy = source / path.relative_to(checkout / "plugins" / NAME)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    archive = built("sdist", source, folder / "sdist")
    with tarfile.open(archive) as packed:
        for member in packed.getmembers():
            if member.isfile():
                unpacked = folder / "again" / member.name
                unpacked.parent.mkdir(parents=True, exist_ok=True)
                extracted = packed.extractfile(member)
                unpacked.write_bytes(extracted.read())
    [root] = (folder / "again").iterdir()
    return built("wheel", root, folder / "wheel")


def told_by(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        [name] = [one for one in archive.namelist() if one.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def assert_fit(told: Message) -> None:
    assert told["Description-Content-Type"] == "text/markdown"
    assert len(str(told.get_payload() or told["Description"])) > 300
    assert (told["License-Expression"], told.get_all("License-File")) == ("Apache-2.0", ["LICENSE"])
    assert told["Requires-Python"] == ">=3.10"


def test_the_version_stands_in_one_place(checkout: Path) -> None:
    citation = yaml.safe_load((checkout / "CITATION.cff").read_text())
    version = envhub_worker.__version__
    assert version == envhub_sandbox.__version__ == metadata.version("envhub-sandbox")
    assert citation["version"] == version
    project = (checkout / "pyproject.toml").read_text().partition("\n\n[")[2]
    assert not re.search(r'^version = "', project, re.M)


def test_both_are_fit_for_an_index(plugin: Path, checkout: Path) -> None:
    """The plugin under the name by which LeRobot finds it, with that module, and our version."""
    assert_fit(metadata.metadata("envhub-sandbox"))
    files = metadata.files("envhub-sandbox") or []
    assert files
    assert [one for one in files if {"tests", "benchmarks", "conftest.py"} & {*one.parts}] == []
    told = told_by(plugin)
    assert_fit(told)
    copy = checkout / "plugins" / NAME / "LICENSE"  # nothing outside gets into a distribution
    assert copy.read_bytes() == (checkout / "LICENSE").read_bytes()
    assert told["Name"] == NAME
    with zipfile.ZipFile(plugin) as archive:
        modules = [name for name in archive.namelist() if name.endswith(".py")]
    assert modules == [f"{NAME}/__init__.py"]
    ours = metadata.version("envhub-sandbox")
    assert told["Version"] == ours
    assert told.get_all("Requires-Dist") == [f"envhub-sandbox>={ours}"]


# --- The container image installs what the worker imports, and cannot drift from pyproject.toml


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
    return re.split(r"[^\w-]", requirement, maxsplit=1)[0]


def test_the_workers_group_is_what_the_worker_imports(project: dict[str, Any]) -> None:
    """No more and no less; word for word as the package needs it."""
    group = project["dependency-groups"]["worker"]
    assert set(group) <= set(project["project"]["dependencies"])
    names = {name_of(one) for one in group}
    assert {_IMPORTED_AS.get(name, name) for name in names} == WORKERS_OWN - {"envhub_worker"}


def test_the_image_can_be_watched(project: dict[str, Any]) -> None:
    recipe = (CHECKOUT / "Dockerfile").read_text()
    installed = re.findall(r"--require-hashes -r /build/(\S+)", recipe)
    group = project["dependency-groups"]["image"]
    assert installed == ["image.txt"]
    assert "--group image --output" in (CHECKOUT / ".ci/lock.sh").read_text()
    assert {"include-group": "worker"} in group
    assert set(project["project"]["optional-dependencies"]["metrics"]) <= {
        one for one in group if isinstance(one, str)
    }


def test_nothing_but_the_worker_goes_into_the_image() -> None:
    """What is not listed never reaches the engine: no tests, no client, no history."""
    lines = (CHECKOUT / ".dockerignore").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules == ["*", "!.ci/locks/image.txt", "!worker", "**/__pycache__"]


def test_the_image_runs_as_nobody_and_carries_the_projects_version() -> None:
    text = (CHECKOUT / "Dockerfile").read_text()
    assert f"ARG VERSION={envhub_worker.__version__}\n" in text
    final = text.rpartition("\nFROM ")[2]
    assert re.search(r"^USER (\d+):\1$", final, re.MULTILINE)
    assert not re.search(r"^USER (root|0)", final, re.MULTILINE)
