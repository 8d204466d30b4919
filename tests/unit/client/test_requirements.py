"""A stranger's requirements.txt is data: what could build or run code does not get through."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.hub import requirements
from envhub_sandbox.hub.requirements import Lock
from envhub_sandbox.sandboxes.docker import image
from tests.unit.docs.test_image import project

__all__ = ["project"]

LOCK = Lock(
    "minigrid==3.0.0 \\\n    --hash=sha256:aa \\\n    --hash=sha256:bb\nnumpy==2.1.0 \\\n"
    "    --hash=sha256:cc\n"
)


def read(tmp_path: Path, text: str) -> list[str]:
    """What of a file gets through."""
    path = tmp_path / "requirements.txt"
    path.write_text(text)
    return [str(one) for one in requirements.read(path)]


def test_plain_requirements_get_through(tmp_path: Path) -> None:
    """With extras, versions, markers and comments."""
    text = "# wanted\nnumpy>=2\n\nminigrid[wfc]==3.0 # pinned\nfoo; python_version<'3.12'\n"
    assert read(tmp_path, text) == [
        *("numpy>=2", "minigrid[wfc]==3.0", 'foo; python_version < "3.12"'),
    ]


@pytest.mark.parametrize(
    "line",
    [
        *("-e ./here", "--index-url https://index.example", "-r other.txt", "--no-binary :all:"),
        *("./here", "git+https://git.example/repo.git", "here @ file:///tmp/here", "/tmp/x.whl"),
        *(
            "here @ https://files.example/here.tar.gz",
            "--find-links .",
            "numpy --config-settings=a",
        ),
        *("numpy>=2 \\", "${SECRET}", "-c constraints.txt", "numpy==1.0 --hash=sha256:00"),
    ],
)
def test_whatever_could_run_code_does_not(tmp_path: Path, line: str) -> None:
    """The line is named, and the way for those who trust it."""
    with pytest.raises(DependencyError, match=r"line 2 of requirements\.txt"):
        read(tmp_path, f"numpy\n{line}\n")


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """Or too long to be one that somebody wrote."""
    path = tmp_path / "requirements.txt"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DependencyError, match="cannot be read"):
        requirements.read(path)
    path.write_text("numpy\n" * requirements.MAX_BYTES)
    with pytest.raises(DependencyError, match="bytes"):
        requirements.read(path)


def test_a_lock_names_its_packages() -> None:
    """Without their hashes."""
    assert LOCK.packages == ["minigrid==3.0.0", "numpy==2.1.0"]


def test_what_jails_import_is_what_the_image_installs(project: dict[str, Any]) -> None:
    """But for ZeroMQ, which no jail has."""
    group = set(project["dependency-groups"]["worker"])
    assert set(requirements.WORKERS) == {one for one in group if not one.startswith("pyzmq")}


def test_the_tag_is_the_hash_of_all_that_an_image_is_made_of() -> None:
    """Another base, another package or another library is another image."""
    tags = {
        image.tag_for("org/repo", base, lock, system)
        for base in ("sha256:1", "sha256:2")
        for lock in (LOCK, Lock(LOCK.text + "x==1 \\\n"))
        for system in ((), ("libgl1",))
    }
    assert len(tags) == 8
    assert all(tag.startswith("envhub-worker-org-repo:") for tag in tags)


@pytest.mark.parametrize("name", ["org/Repo.Name_1", "datasets/x/--y--", "../..", "Ünïcode/env"])
def test_a_repositorys_name_makes_a_tag(name: str) -> None:
    """Whatever it has in it."""
    repository, _, tag = image.tag_for(name, "sha256:1", LOCK, ()).partition(":")
    assert set(repository) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
    assert not repository.endswith("-")
    assert len(tag) == 16


def test_the_recipe_is_this_one() -> None:
    """Wheels by their hashes, into an interpreter of their own; then nobody's again."""
    recipe = image.dockerfile("envhub-worker", LOCK, ["libgl1"])
    assert recipe.startswith("FROM envhub-worker\nUSER root\nRUN apt-get update")
    for words in ("--require-hashes", "--no-deps", "--only-binary :all:", "'*.pth'"):
        assert words in recipe
    assert recipe.endswith(f"LABEL dev.envhub.lock={LOCK.digest}\nUSER 65532:65532\n")


@pytest.mark.parametrize("name", ["libgl1; reboot", "-o", "", "a b", "$(id)", "--allow-x"])
def test_a_system_package_is_a_name(name: str) -> None:
    """It stands in a shell's command line."""
    with pytest.raises(DependencyError, match="Debian"):
        image.dockerfile("envhub-worker", LOCK, [name])
