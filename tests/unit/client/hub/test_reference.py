"""Hub references: every form works or says what to write instead."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.errors import HubReferenceError
from envhub_sandbox.extras.sources.registered import entry
from envhub_sandbox.hub.listing import Snapshot
from envhub_sandbox.hub.reference import HubRef, is_local, pinned

COMMIT = "0123456789abcdef0123456789abcdef01234567"
SITE = "https://huggingface.co"
GITHUB = "https://github.com/org/repo"
WORKING = {
    # LeRobot's four forms.
    "org/repo": HubRef("org/repo"),
    "org/repo@main": HubRef("org/repo", "main"),
    "org/repo:envs/a.py": HubRef("org/repo", None, "envs/a.py"),
    "org/repo@v1.0:envs/a.py": HubRef("org/repo", "v1.0", "envs/a.py"),
    # Corners of the grammar.
    "org/repo@refs/pr/3": HubRef("org/repo", "refs/pr/3"),
    "org/repo@feature/x:a.py": HubRef("org/repo", "feature/x", "a.py"),
    "org/repo@v1@2": HubRef("org/repo", "v1@2"),
    "org/repo:envs/a@b.py": HubRef("org/repo", None, "envs/a@b.py"),
    "org/repo:a:b.py": HubRef("org/repo", None, "a:b.py"),
    "org/repo:my env.py": HubRef("org/repo", None, "my env.py"),
    "org/repo:./a//b.py": HubRef("org/repo", None, "a/b.py"),
    "  org/repo \n": HubRef("org/repo"),
    f"org/repo@{COMMIT.upper()}": HubRef("org/repo", COMMIT),
    # Types.
    "models/org/repo": HubRef("org/repo", repo_type="model"),
    "spaces/org/repo@dev": HubRef("org/repo", "dev", repo_type="space"),
    "datasets/org/repo:a.py": HubRef("org/repo", None, "a.py", "dataset"),
    # Pages of the site.
    f"{SITE}/org/repo": HubRef("org/repo"),
    f"{SITE}/org/repo.git": HubRef("org/repo"),
    "huggingface.co/org/repo/": HubRef("org/repo"),
    "https://hf.co/spaces/org/repo": HubRef("org/repo", repo_type="space"),
    f"{SITE}/spaces/org/repo/tree/main": HubRef("org/repo", "main", repo_type="space"),
    f"{SITE}/org/repo/blob/v1/envs/a.py#L3": HubRef("org/repo", "v1", "envs/a.py"),
    f"{SITE}/org/repo/resolve/v1/a.py?download=true": HubRef("org/repo", "v1", "a.py"),
    f"{SITE}/org/repo/blob/feature%2Fx/my%20env.py": HubRef("org/repo", "feature/x", "my env.py"),
    f"{SITE}/datasets/org/repo/blob/refs%2Fpr%2F3/a.py": HubRef(
        "org/repo", "refs/pr/3", "a.py", "dataset"
    ),
    f"{SITE}/org/repo/tree/refs/pr/3": HubRef("org/repo", "refs/pr/3"),
    f"{SITE}/org/repo/commit/{COMMIT}": HubRef("org/repo", COMMIT),
    # hf:// as in huggingface_hub's file system, and with a colon.
    "hf://org/repo": HubRef("org/repo"),
    "hf://org/repo/envs/a.py": HubRef("org/repo", None, "envs/a.py"),
    "hf://spaces/org/repo@dev/a.py": HubRef("org/repo", "dev", "a.py", "space"),
    "hf://org/repo@v1:a.py": HubRef("org/repo", "v1", "a.py"),
    # Commits of git, and environments of packages.
    "github:org/repo": HubRef(GITHUB, repo_type="git"),
    f"github:org/repo@{COMMIT.upper()}:a/b.py": HubRef(GITHUB, COMMIT, "a/b.py", "git"),
    f"git+{GITHUB}@v1.0": HubRef(GITHUB, "v1.0", repo_type="git"),
    "git+https://Git.Example:8443/a/b/c.git@feature/x": HubRef(
        "https://git.example:8443/a/b/c.git", "feature/x", repo_type="git"
    ),
    GITHUB: HubRef(GITHUB, repo_type="git"),
    f"{GITHUB}.git": HubRef(GITHUB, repo_type="git"),
    f"{GITHUB}/blob/v1/envs/a.py#L3": HubRef(GITHUB, "v1", "envs/a.py", "git"),
    f"{GITHUB}/tree/{COMMIT}": HubRef(GITHUB, COMMIT, repo_type="git"),
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
# The text, what the error says is wrong, and what it says to write.
REFUSED = [
    ("", "empty", "owner/name"),
    ("org/repo@", "revision after '@' is empty", "'org/repo'"),
    ("org/repo@:a.py", "revision after '@' is empty", "'org/repo:a.py'"),
    ("org/repo:", "path after ':' is empty", "'org/repo'"),
    ("org/", "name is missing", "owner/name"),
    ("@org/repo", "owner is missing", "owner/name"),
    ("cartpole-env", "owner is missing", "'./cartpole-env' for a local folder"),
    ("spaces/repo", "owner is missing", "'spaces/OWNER/repo'"),
    ("org/repo/envs/a.py", "after a colon", "'org/repo:envs/a.py'"),
    ("spaces/org/repo/envs", "after a colon", "'spaces/org/repo:envs/env.py'"),
    ("org//repo", "one slash", "owner/name"),
    ("org/repo:../a.py", "'..'", "inside the repository"),
    ("org/repo@v1:a/../b.py", "'..'", "'org/repo@v1:b.py'"),
    ("org/repo:/a.py", "absolute", "'org/repo:a.py'"),
    ("org/repo:envs\\a.py", "backslashes", "'org/repo:envs/a.py'"),
    ("org/repo:C:/a.py", "drive letter", "inside the repository"),
    ("C:\\envs\\a.py", "drive letter", "owner/name"),
    ("org/re po", "'re po' is not a valid name", "owner/name"),
    ("org/repo@ma in", "'ma in' cannot be a revision", "'org/repo@main'"),
    ("org/repo: a.py", "spaces around", "'org/repo:a.py'"),
    ("org/re\npo", "control characters", "owner/name"),
    ("org/repo:a\u2028.py", "control characters", "owner/name"),
    ("org/repo@a..b", "cannot be a revision", "'org/repo@main'"),
    ("org/repo:envs", "is a folder", "'org/repo:envs/env.py'"),
    ("org/repo:envs/", "is a folder", "'org/repo:envs/env.py'"),
    ("org/repo:README.md", "not a .py file", "inside the repository"),
    ("org/repo:a.py@v1", "before the path", "'org/repo@v1:a.py'"),
    ("org/repo.git", ".git", "'org/repo'"),
    ("o--x/repo", "'o--x' is not a valid name", "owner/name"),
    ("org/-repo", "'-repo' is not a valid name", "owner/name"),
    ("é/repo", "is not a valid name", "owner/name"),
    ("git@hf.co:org/repo.git", "git remote", "'org/repo'"),
    ("s3://bucket/env", "'s3://'", "owner/name"),
    ("./my-env", "folder of this machine", "make_env"),
    ("~/my-env", "folder of this machine", "make_env"),
    ("https://hf-mirror.com/org/repo", "not the Hugging Face Hub", "'https://hf-mirror.com'"),
    ("https://[bad", "cannot be read", "owner/name"),
    (f"{SITE}/", "names no repository", "owner/name"),
    (f"{SITE}/spaces/org", "names no repository", "owner/name"),
    (f"{SITE}/org/repo/tree/main/envs", "is a folder", "'org/repo@main:envs/env.py'"),
    (f"{SITE}/spaces/org/repo/discussions/4", "'discussions'", "'spaces/org/repo@refs/pr/4'"),
    (f"{SITE}/org/repo/settings", "'settings'", "'org/repo'"),
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
    # What is named as Gymnasium names environments leads to the reference of a package.
    ("minigrid#MiniGrid-Empty-5x5-v0", "of Gymnasium", "pypi:minigrid#MiniGrid-Empty-5x5-v0"),
    ("pip:minigrid@3.0.0#A/B-v0", "environment of Gymnasium", "pypi:minigrid@3.0.0#A/B-v0"),
    ("CartPole-v1", "environment of Gymnasium", "'pypi:PACKAGE#CartPole-v1'"),
    ("env.py", "does not exist here", "OWNER/NAME:env.py"),
]


@pytest.mark.parametrize("text", WORKING)
def test_form_is_read(text: str) -> None:
    ref = HubRef.parse(text)
    assert ref == WORKING[text] == HubRef.parse(str(ref))
    assert HubRef.parse(ref.meaning).meaning == ref.meaning


@pytest.mark.parametrize(("text", "what", "write"), REFUSED)
def test_refusal_names_the_reference_and_a_fix(text: str, what: str, write: str) -> None:
    """A refused text comes back in the error, with what is wrong and what to write. What stands
    between quotes is itself readable."""
    with pytest.raises(HubReferenceError) as caught:
        HubRef.parse(text)
    message = str(caught.value)
    assert repr(text.replace("u:secret@", "***@")) in message
    said, _, advice = message.rpartition("; write ")
    assert what in said
    assert write in advice
    if write[0] == "'":
        HubRef.parse(advice.split("'")[1])


@pytest.mark.parametrize(
    "text",
    [
        f"https://user:hf_secret@{SITE.removeprefix('https://')}/org/repo",
        "https://hf_secret@hf-mirror.com/org/repo",
        "git+https://user:hf_secret@hf.co/org/repo",
        "https://user:hf_secret@[bad",
    ],
)
def test_token_in_a_url_is_not_repeated(text: str) -> None:
    with pytest.raises(HubReferenceError) as caught:
        HubRef.parse(text)
    assert "hf_secret" not in str(caught.value)


def test_something_else_than_text_is_refused() -> None:
    with pytest.raises(HubReferenceError, match="owner/name@revision"):
        HubRef.parse(None)
    assert issubclass(HubReferenceError, ValueError)


@pytest.mark.parametrize("revision", [None, "main", COMMIT[:12], COMMIT + "0", COMMIT.upper()])
def test_only_a_full_commit_is_pinned(revision: str | None) -> None:
    """Branches, tags and short hashes can move or clash; 40 hexadecimal digits cannot."""
    assert HubRef("org/repo", COMMIT).is_pinned
    assert not HubRef("org/repo", revision).is_pinned


@pytest.mark.parametrize(
    "fields",
    [
        {"repo_id": "repo"},
        {"repo_id": "a/b/c"},
        *({"revision": ""}, {"path": "../env.py"}, {"path": "a/./env.py"}, {"repo_type": "kernel"}),
    ],
)
def test_reference_that_no_hub_has_cannot_be_built(fields: dict[str, str]) -> None:
    with pytest.raises(HubReferenceError):
        HubRef(**{"repo_id": "org/repo", **fields})


def test_local_folders_are_told_from_references() -> None:
    assert all(map(is_local, [".", "..", "~", "./env", "../env", "/env", "~/env", "examples:env"]))
    assert not any(map(is_local, ["env", "org/repo", ".hidden/name"]))


_names = st.from_regex(r"[a-zA-Z0-9](?:[a-zA-Z0-9_]|[-.](?=[a-zA-Z0-9])){0,20}", fullmatch=True)
_steps = st.from_regex(r"[a-zA-Z0-9@_:+-]{1,12}", fullmatch=True)
_revisions = st.none() | st.lists(
    st.from_regex(r"[a-zA-Z0-9][a-zA-Z0-9_@-]{0,12}", fullmatch=True), min_size=1, max_size=3
).map("/".join)
_paths = st.lists(_steps, min_size=1, max_size=4).map(lambda steps: "/".join(steps) + ".py")
_types = st.sampled_from([None, "model", "space", "dataset"])


@given(owner=_names, name=_names, revision=_revisions, path=_paths, repo_type=_types)
def test_printing_and_parsing_are_inverse(
    owner: str, name: str, revision: str | None, path: str, repo_type: str | None
) -> None:
    try:
        ref = HubRef(f"{owner}/{name}", revision, path, repo_type)
    except HubReferenceError:
        return
    assert HubRef.parse(str(ref)) == ref


@given(st.text(max_size=40) | st.text(alphabet="ab/@:.\\ ~-spaceshf://\n", max_size=40))
def test_any_text_is_read_or_refused_with_our_error(text: str) -> None:
    try:
        ref = HubRef.parse(text)
    except HubReferenceError:
        return
    assert HubRef.parse(str(ref)) == ref
    assert ".." not in ref.path.split("/")
    assert not ref.path.startswith("/")


def test_hub_imports_nothing_heavy() -> None:
    """A typo is refused, and a stored snapshot found, before an HTTP library is loaded."""
    code = """
import sys
import envhub_sandbox.hub.snapshot
from envhub_sandbox.hub.reference import HubRef
HubRef.parse("org/repo")
heavy = {"huggingface_hub", "numpy", "gymnasium", "requests", "httpx", "httpx2", "platformdirs"}
print(heavy & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("name", ['x#a"b', "x#a\nb", "x\n--pre#a", "x #a", "x"])
def test_a_reference_that_was_not_parsed_is_checked_too(name: str) -> None:
    with pytest.raises(HubReferenceError):
        HubRef(name, repo_type="pypi")


def test_only_a_full_commit_of_git_is_pinned() -> None:
    """A version of a package is one whatever it looks like: what it needs is not in it."""
    assert HubRef.parse(f"github:org/repo@{COMMIT}").is_pinned
    assert not HubRef.parse("github:org/repo@v1").is_pinned
    assert not HubRef.parse(f"pypi:x@{COMMIT}#X-v0").is_pinned


def test_provenance_becomes_the_reference_again() -> None:
    for text, kind, name, commit, path in (
        (f"git+{GITHUB}@{COMMIT}:a.py", "git", GITHUB, COMMIT, "a.py"),
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
    assert '# dependencies = ["x"]' in entry(HubRef.parse("pypi:x#Y-v0").parts).decode()
