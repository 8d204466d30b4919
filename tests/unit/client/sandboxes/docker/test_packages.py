"""Packages for a container: whether the image has them, or this machine's fit; and images."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.docker import packages
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.packages import interpreter_fitting
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import parse_requirement
from envhub_sandbox.extras.packages.interpreters import InstalledPackage
from envhub_sandbox.extras.packages.modules import Guess
from envhub_sandbox.extras.packages.request import PackageRequest
from tests.attacks.output.painting import ESCAPES, paints
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import locked

OURS = interpreters.own()
NEWER = replace(OURS, path="/opt/envhub-worker/bin/python", libc="99.0")
THERE = {
    "Wanted_One": InstalledPackage(
        "1.5", ("deeper>=2; python_version >= '3.11'", "more; extra == 'x'")
    ),
    "deeper": InstalledPackage("1.0", ()),
}


def declares(*lines: str, supports: str = "", python: str = "") -> PackageRequest:
    wanted = tuple(parse_requirement(line, "a line") for line in lines)
    return PackageRequest("requirements.txt", wanted, supports, python)


@pytest.mark.parametrize(
    ("line", "python", "lacking"),
    [
        ("deeper", "3.12.1", None),
        ("deeper>1", "3.12.1", "deeper>1"),
        ("wanted-one>=1", "3.10.4", None),
        ("wanted-one>=1", "3.12.1", 'deeper>=2; python_version >= "3.11"'),
        ("pytest", "3.12.1", "pytest"),  # which is here, and not there
    ],
)
def test_what_an_image_has_is_in_its_metadata(line: str, python: str, lacking: str | None) -> None:
    """With the markers of the image's Python, and nothing of this one."""
    assert interpreters.first_unmet(declares(line), THERE, python) == lacking


def test_what_it_imports_is_in_the_image_or_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the names of distributions: nothing of an image is imported to see."""
    monkeypatch.setattr(packages, "image_packages", lambda engine, image: (NEWER, THERE))
    target = packages.ImageTarget(lambda: None, "image")
    for brought_by, met in ((("absent", "wanted-one"), True), (("absent",), False)):
        guess = Guess("module", parse_requirement("absent", "env.py, line 1"), brought_by)
        assert target.meets(replace(declares(), guesses=(guess,))) == met


def test_an_image_that_is_built_again_is_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its name is the same, its id is another; one of a known id is not started again."""
    monkeypatch.setattr(packages, "own_limits", lambda engine: ())
    started: list[str] = []

    class Engine:
        image_id, kind = "", "docker"

        def run(self, *words: str) -> str:
            if words[0] == "image":
                return self.image_id
            started.append(self.image_id)
            return json.dumps(["cpython", f"3.1{self.image_id[-1]}.0", "x86_64", "2.36", {}])

    engine: Any = Engine()
    for engine.image_id, version in (
        ("sha256:1", "3.11"),
        ("sha256:1", "3.11"),
        ("sha256:2", "3.12"),
    ):
        assert packages.target_of(engine, "name").version == version
    assert started == ["sha256:1", "sha256:2"]


def test_an_interpreter_of_its_kind_fits() -> None:
    """Another patch release does; wheels that were chosen for an older glibc do."""
    minor = ".".join(OURS.version.split(".")[:2])
    assert interpreter_fitting(replace(NEWER, version=f"{minor}.99"), declares()).path == OURS.path


@pytest.mark.parametrize(
    ("theirs", "said"),
    [
        (replace(NEWER, libc="2.1"), "glibc 2.1"),
        (replace(NEWER, libc=""), "glibc unknown"),
        (replace(NEWER, machine="s390x"), "s390x"),
        (replace(NEWER, implementation="pypy"), "cannot be used"),
        (replace(NEWER, version="3.99.0"), "which does not have it"),
    ],
)
def test_one_of_another_kind_does_not(
    theirs: interpreters.Interpreter, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wheel that was chosen for the one may crash in the other; the text has the other way."""
    monkeypatch.setenv("PATH", "/nowhere")  # each interpreter there would be asked
    with refused_dependency("interpreter", match=said) as caught:
        interpreter_fitting(theirs, declares())
    assert "envhub image build" in str(caught.value)


def test_the_images_python_is_the_one_that_there_is() -> None:
    for request in (
        declares(python="3.99"),
        declares(python="/usr/bin/python3"),
        declares(supports=">=3.99"),
    ):
        with refused_dependency("interpreter", match="the image has"):
            interpreter_fitting(NEWER, request)


LOCK = locked("minigrid==3.0.0", "numpy==2.1.0")


def test_the_tag_is_the_hash_of_all_that_an_image_is_made_of() -> None:
    tags = {
        packages.tag_for("org/repo", base, lock, system)
        for base in ("sha256:1", "sha256:2")
        for lock in (LOCK, locked("minigrid==3.0.0", "numpy==2.1.0", sha256="1" * 64))
        for system in ((), ("libgl1",))
    }
    assert len(tags) == 8
    assert all(tag.startswith("envhub-worker-org-repo:") for tag in tags)


@pytest.mark.parametrize("name", ["org/Repo.Name_1", "datasets/x/--y--", "../..", "Ünïcode/env"])
def test_a_repositorys_name_makes_a_tag(name: str) -> None:
    repository, _, tag = packages.tag_for(name, "sha256:1", LOCK, ()).partition(":")
    assert set(repository) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
    assert not repository.endswith("-")
    assert len(tag) == 16


def test_the_recipe_is_this_one() -> None:
    """Wheels by their hashes, into an interpreter of their own; then nobody's again."""
    recipe = packages.dockerfile("envhub-worker", LOCK, ["libgl1"])
    assert recipe.startswith("FROM envhub-worker\nUSER root\nRUN apt-get update")
    for words in ("--require-hashes", "--no-deps", "--only-binary :all:", "'*.pth'"):
        assert words in recipe
    assert recipe.endswith(f"LABEL dev.envhub.lock={LOCK.digest}\nUSER 65532:65532\n")


@pytest.mark.parametrize("name", ["libgl1; reboot", "-o", "", "a b", "$(id)", "--allow-x"])
def test_a_system_package_is_a_name(name: str) -> None:
    with pytest.raises(DependencyError, match="Debian"):
        packages.dockerfile("envhub-worker", LOCK, [name])


def test_what_the_engine_prints_does_not_paint(tmp_path: Path) -> None:
    """It prints names that packages choose, of files among others."""
    command = tmp_path / "engine"
    command.write_text(
        f"#!{sys.executable}\nprint({ESCAPES!r} + 'no wheel')\nraise SystemExit(1)\n"
    )
    command.chmod(0o755)
    engine = Engine("docker", str(command), "", rootless=False)
    with pytest.raises(DependencyError, match="no wheel") as caught:
        packages.build(engine, "FROM x", LOCK, "tag", None)
    assert not paints(str(caught.value))
