"""The image that is derived for a repository's packages: what it is made of, and its name."""

from __future__ import annotations

import pytest

from envhub_sandbox.dependencies.resolve import Lock
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.sandboxes.docker import image

LOCK = Lock(
    "minigrid==3.0.0 \\\n    --hash=sha256:aa \\\n    --hash=sha256:bb\nnumpy==2.1.0 \\\n"
    "    --hash=sha256:cc\n"
)


def test_a_lock_names_its_packages() -> None:
    """Without their hashes."""
    assert LOCK.packages == ["minigrid==3.0.0", "numpy==2.1.0"]


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
