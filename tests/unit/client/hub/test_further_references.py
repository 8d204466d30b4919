"""References to commits of git and to environments of packages: each form, and what is refused."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from envhub_sandbox.errors import HubReferenceError
from envhub_sandbox.hub import registered
from envhub_sandbox.hub.listing import Snapshot
from envhub_sandbox.hub.reference import HubRef, pinned
from envhub_sandbox.hub.registered import entry

COMMIT = "0123456789abcdef0123456789abcdef01234567"
SITE = "https://github.com/org/repo"

WORKING = {
    "github:org/repo": HubRef(SITE, repo_type="git"),
    f"github:org/repo@{COMMIT.upper()}:a/b.py": HubRef(SITE, COMMIT, "a/b.py", "git"),
    f"git+{SITE}@v1.0": HubRef(SITE, "v1.0", repo_type="git"),
    "git+https://Git.Example:8443/a/b/c.git@feature/x": HubRef(
        "https://git.example:8443/a/b/c.git", "feature/x", repo_type="git"
    ),
    SITE: HubRef(SITE, repo_type="git"),
    f"{SITE}.git": HubRef(SITE, repo_type="git"),
    f"{SITE}/blob/v1/envs/a.py#L3": HubRef(SITE, "v1", "envs/a.py", "git"),
    f"{SITE}/tree/{COMMIT}": HubRef(SITE, COMMIT, repo_type="git"),
    "pypi:minigrid#MiniGrid-Empty-5x5-v0": HubRef(
        "minigrid#MiniGrid-Empty-5x5-v0", repo_type="pypi"
    ),
    "pypi:ale-py==0.11.0#ALE/Pong-v5": HubRef("ale-py#ALE/Pong-v5", "0.11.0", repo_type="pypi"),
    "pypi:ale-py@0.11.0#ALE/Pong-v5": HubRef("ale-py#ALE/Pong-v5", "0.11.0", repo_type="pypi"),
    "pypi:gymnasium[mujoco, box2d]#Ant-v5": HubRef(
        "gymnasium[mujoco,box2d]#Ant-v5", repo_type="pypi"
    ),
    "pypi:x#y.z:Id-v0": HubRef("x#y.z:Id-v0", repo_type="pypi"),
}

REFUSED = [
    ("git+http://h/x", "not fetched by 'http'", "git+https://"),
    ("git+file:///etc", "not fetched by 'file'", "git+https://"),
    ("git+ext::sh -c x", "ends with", "git+https://"),
    ("git+ext://sh/x", "not fetched by 'ext'", "git+https://"),
    ("git+https://u:secret@h/x", "user or token", "'git+https://h/x'"),
    ("git+https://-oProxyCommand=x/y", "not the address", "git+https://"),
    ("git+https://h/a/../b", "not the address", "git+https://"),
    ("git+https://h/x y", "not the address", "git+https://"),
    ("git+https://h/x?a=b", "ends with", "git+https://"),
    ("git+https://h/x@--upload-pack=y", "cannot be a revision", "'git+https://h/x@main'"),
    ("git+https://h/x@a:../b.py", "'..'", "inside the repository"),
    ("git+https://h/x@a\nb", "cannot be a revision", "@main"),
    ("git+https://huggingface.co/org/repo", "git remote of the Hub", "'org/repo'"),
    ("github:org/repo/envs/a.py", "not the address", "github:"),
    ("git@github.com:org/repo.git", "git remote", "'github:org/repo'"),
    ("ssh://git@git.example/org/repo", "git remote", "'git+https://git.example/org/repo'"),
    ("pypi:minigrid", "id is missing", "pypi:PACKAGE"),
    ("pypi:#X-v0", "not the name of a package", "pypi:PACKAGE"),
    ("pypi:--index-url#X-v0", "not the name of a package", "pypi:PACKAGE"),
    ("pypi:x @ https://h/x.whl#X-v0", "not a version", "'pypi:x#X-v0'"),
    ("pypi:x; os_name=='a'#X-v0", "not the name of a package", "pypi:PACKAGE"),
    ("pypi:x@1\n--pre#X-v0", "not a version", "'pypi:x#X-v0'"),
    ("pypi:x#", "not the id", "pypi:PACKAGE"),
    ("pypi:x#a'b", "not the id", "pypi:PACKAGE"),
    ('pypi:x#a"\nimport os', "not the id", "pypi:PACKAGE"),
]


@pytest.mark.parametrize("text", WORKING)
def test_form_is_read(text: str) -> None:
    """Each is read into what it can only mean; so is what that one prints."""
    ref = HubRef.parse(text)
    assert ref == WORKING[text] == HubRef.parse(str(ref))
    assert HubRef.parse(ref.meaning).meaning == ref.meaning


@pytest.mark.parametrize(("text", "what", "write"), REFUSED)
def test_refusal_says_what_to_write(text: str, what: str, write: str) -> None:
    with pytest.raises(HubReferenceError, match=what) as caught:
        HubRef.parse(text)
    assert write in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("name", ['x#a"b', "x#a\nb", "x\n--pre#a", "x #a", "x"])
def test_a_reference_that_was_not_parsed_is_checked_too(name: str) -> None:
    """What becomes source and a requirement has no quotes, ends of lines or options."""
    with pytest.raises(HubReferenceError):
        HubRef(name, repo_type="pypi")


def test_only_a_full_commit_is_pinned() -> None:
    """A version of a package is one whatever it looks like: what it needs is not in it."""
    assert HubRef.parse(f"github:org/repo@{COMMIT}").is_pinned
    assert not HubRef.parse("github:org/repo@v1").is_pinned
    assert not HubRef.parse(f"pypi:x@{COMMIT}#X-v0").is_pinned


def test_provenance_becomes_the_reference_again() -> None:
    for text, kind, name, commit, path in (
        (f"git+{SITE}@{COMMIT}:a.py", "git", SITE, COMMIT, "a.py"),
        ("pypi:x@1.0#X-v0", "pypi", "x@1.0#X-v0", "pypi-00", "env.py"),
        ("/srv/env:a.py", "local", "/srv/env", "local-00", "a.py"),
        (f"spaces/org/repo@{COMMIT}", "space", "org/repo", COMMIT, "env.py"),
        (f"models/org/repo@{COMMIT}", "model", "org/repo", COMMIT, "env.py"),
    ):
        assert pinned(kind, name, commit, path) == text
        assert Snapshot(name, kind, commit, path, Path(), ()).reference == text


def test_the_entry_says_what_the_reference_says() -> None:
    """Package, extras and version are a requirement; distribution and id are plain texts."""
    text = entry(HubRef.parse("pypi:gymnasium[mujoco]==1.2.0#a.b:Ant-v5").parts).decode()
    assert text.splitlines()[1] == '# dependencies = ["gymnasium[mujoco]==1.2.0"]'
    constants = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    assert (constants["DISTRIBUTION"], constants["ENV_ID"]) == ("gymnasium", "a.b:Ant-v5")
    assert registered.requirement(HubRef.parse("pypi:x#Y-v0").parts) == "x"
