"""Every way in which a Hub can say no: each has an error of its own that says what to do."""

import base64
import logging
import os
import re
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import HubReferenceError, RepositoryUnavailableError
from envhub_sandbox.hub.client import HubClient
from envhub_sandbox.hub.listing import Repository
from tests.hub.stub_hub import StubHub
from tests.integration.hub.conftest import Fetch
from tests.support.command_line import python
from tests.support.processes import eventually
from tests.support.repositories import STILL

TOKEN = "hf_SECRETSECRETSECRET"
INTERRUPTED = """
from envhub_sandbox import make_env
try:
    make_env("models/org/repo", token=False)
except KeyboardInterrupt:
    print("interrupted")
if AGAIN:
    with make_env("models/org/repo", token=False) as suites:
        suites.env.reset(seed=0)
        print("loaded")
"""


def failure(get: Fetch, text: str = "models/org/repo", **rest: Any) -> RepositoryUnavailableError:
    with pytest.raises(RepositoryUnavailableError) as caught:
        get(text, **rest)
    assert text in str(caught.value)
    assert caught.value.__cause__ is not None
    return caught.value


API = "/api/models/org/repo/revision/"

# Where it strikes, status, headers, and what the error must say.
ANSWERS = [
    (API, 403, {"X-Error-Code": "GatedRepo"}, ["gated", "Accept its terms at", "hf auth login"]),
    (API, 401, {}, ["no model repository org/repo", "(401)", "hf auth login"]),
    (
        API,
        401,
        {"X-Error-Message": "Invalid credentials in Authorization header"},
        ["refused your token (401)", "hf auth login", "token=False"],
    ),
    (API, 403, {"X-Error-Message": "no read scope"}, ['(403); it said: "no read scope"', "read"]),
    (
        API,
        403,
        {"X-Error-Message": "Access to this resource is disabled."},
        ["was disabled", "another repository"],
    ),
    (API, 404, {"X-Error-Code": "RepoNotFound"}, ["no model repository", "(404)", "spelling"]),
    (API, 404, {"X-Error-Code": "RevisionNotFound"}, ["has no revision", "/org/repo/commits/"]),
    (API, 429, {"Retry-After": "17"}, ["rate limit", "(429)", "Wait 17 s"]),
    (API, 429, {}, ["rate limit", "Wait a few minutes"]),
    (API, 500, {}, ["has a problem (500)", "try again later"]),
    (API, 503, {"X-Error-Message": "over\x07loaded"}, ["(503)", '"over loaded"']),
    (API, 407, {}, ["proxy", "(407)", "HTTPS_PROXY"]),
    (API, 418, {}, ["Hub client failed", "418", "endpoint"]),
    (API, 0, {}, ["cannot be reached", "proxy"]),
    (API, 200, {}, ["Check the endpoint"]),  # of a server that is no Hub
    ("/tree/", 403, {"X-Error-Code": "GatedRepo"}, ["gated"]),
    ("/resolve/", 403, {"X-Error-Code": "GatedRepo"}, ["gated", "Accept its terms"]),
    ("/resolve/", 404, {"X-Error-Code": "EntryNotFound"}, ["its own listing names"]),
    ("/resolve/", 403, {"X-Error-Message": "no read scope"}, ['(403); it said: "no read scope"']),
]


@pytest.mark.parametrize(("where", "status", "headers", "said"), ANSWERS)
def test_answer_of_the_hub_becomes_advice(
    stub_hub: StubHub, get: Fetch, where: str, status: int, headers: dict[str, str], said: list[str]
) -> None:
    """The error names the reference and endpoint, says what happened, and what to do."""
    stub_hub.fail(where, status, headers=headers)
    message = str(failure(get))
    assert stub_hub.endpoint in message
    for words in said:
        assert words.lower() in message.lower()


def test_failed_download_leaves_nothing_in_the_store(
    stub_hub: StubHub, get: Fetch, snapshot_store: Path
) -> None:
    """After a failure in the middle there is no commit that could later be believed. It is not
    repeated: only a failure of the Xet route is worth a second way."""
    stub_hub.fail("/resolve/.*mesh.bin", 403, headers={"X-Error-Code": "GatedRepo"})
    failure(get)
    assert len([r for r in stub_hub.requests if "mesh.bin" in r and "/resolve/" in r]) == 1
    assert not [path for path in snapshot_store.rglob("*") if path.is_file()]


def test_gated_model_is_not_searched_as_a_space(stub_hub: StubHub, get: Fetch) -> None:
    """A repository that exists and refuses is the answer; no other type is tried."""
    stub_hub.fail(API, 403, headers={"X-Error-Code": "GatedRepo"})
    assert "gated" in str(failure(get, "org/repo"))
    assert not any("/api/spaces/" in request for request in stub_hub.requests)


@pytest.mark.parametrize(
    ("text", "types", "said"),
    [
        ("org/repo@v9", ("model", "space"), "has no revision 'v9'"),
        ("org/repo", ("model",), "has no revision 'main' (is it empty?)"),
    ],
    ids=["missing", "empty"],
)
def test_a_revision_that_is_in_no_type_is_told_for_each(
    stub_hub: StubHub, get: Fetch, text: str, types: tuple[str, ...], said: str
) -> None:
    if "space" in types:
        stub_hub.add("org/repo", {"env.py": "s"}, "space")
    else:
        stub_hub.repositories["model", "org/repo"].refs.clear()
    message = str(failure(get, text))
    assert all(f"the {one} repository org/repo {said}" in message for one in types), message


@pytest.mark.parametrize(("status", "stall"), [(401, False), (500, False), (0, False), (0, True)])
def test_stale_branch_is_never_returned(
    stub_hub: StubHub, get: Fetch, monkeypatch: pytest.MonkeyPatch, status: int, stall: bool
) -> None:
    """huggingface_hub returns the cached commit of a branch when it cannot ask: we refuse."""
    commit = get().commit
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_ETAG_TIMEOUT", 0.5)
    stub_hub.fail("/api/", status, stall=stall)
    message = str(failure(get))
    assert f"'models/org/repo@{commit}' (main, " in message
    assert get(f"models/org/repo@{commit}").commit == commit


def test_refused_connection_fails_at_once_and_says_that_the_store_is_empty(
    stub_hub: StubHub, get: Fetch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No retries are spent on a Hub that is not there."""
    stub_hub.stop()
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    message = str(failure(get))
    for part in ("cannot be reached", "onnection refused", "No commit of it is in the store"):
        assert part in message
    assert sum(slept) < 5, "huggingface_hub's own retries wait for 24 s"


def test_a_cache_of_the_hub_that_cannot_be_used_is_named(get: Fetch, tmp_path: Path) -> None:
    """With its path, what the system says and the variable: the network is not to blame."""
    (tmp_path / "file").write_text("")
    message = str(failure(get, hub_cache_dir=tmp_path / "file" / "hub"))
    assert re.search(rf"NotADirectoryError: .*{tmp_path}/file.*HF_HOME", message), message


def test_silent_hub_is_left(stub_hub: StubHub, get: Fetch, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Hub that accepts and never answers ends in a time-out, with the variable to raise."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_ETAG_TIMEOUT", 0.5)
    stub_hub.fail("/tree/", stall=True)
    message = str(failure(get))
    assert "did not answer in time" in message
    assert "HF_HUB_ETAG_TIMEOUT" in message


def test_offline_mode_fails_by_its_own_name(
    stub_hub: StubHub, hub_cache: Path, snapshot_store: Path
) -> None:
    """HF_HUB_OFFLINE makes a branch fail with its name, without a request; a pin still loads."""
    commit = stub_hub.add("org/repo", {"env.py": "1"}).commit
    code = (
        "import sys; from envhub_sandbox.hub.snapshot import fetch; "
        "from envhub_sandbox.hub.reference import HubRef\n"
        "try: print(fetch(HubRef.parse(sys.argv[1]), hub_cache_dir=sys.argv[2], token=False,"
        " endpoint=sys.argv[3]).commit)\n"
        "except Exception as error: print(type(error).__name__, error)"
    )

    def run(text: str, offline: str) -> str:
        done = python("-c", code, text, hub_cache, stub_hub.endpoint, HF_HUB_OFFLINE=offline)
        return done.stdout.strip()

    assert run("org/repo", "0") == commit
    asked = len(stub_hub.requests)
    said = run("org/repo", "1")
    assert said.startswith("RepositoryUnavailableError org/repo on http://127.0.0.1")
    assert "HF_HUB_OFFLINE is set" in said
    assert f"'org/repo@{commit}'" in said
    assert run(f"org/repo@{commit}", "1") == commit
    assert len(stub_hub.requests) == asked


def test_token_is_sent_and_never_shown(stub_hub: StubHub, get: Fetch) -> None:
    """The token goes to the Hub, and not into an error, even if the Hub echoes it; of one that was
    read from a file the line end is stripped."""
    get(token=f"{TOKEN}\n")
    assert set(stub_hub.authorizations) == {f"Bearer {TOKEN}"}
    stub_hub.fail(API, 403, headers={"X-Error-Message": f"token {TOKEN} lacks scope"})
    error = failure(get, token=TOKEN)
    assert f"Bearer {TOKEN}" in stub_hub.authorizations
    assert "token *** lacks scope" in str(error)
    assert TOKEN not in str(error) + repr(error)


def test_next_page_of_a_listing_is_asked_of_the_endpoint(stub_hub: StubHub) -> None:
    """A link to another host, which would get the token, only gives its cursor."""
    files = {f"f{number}.txt": str(number) for number in range(7)}
    commit = stub_hub.add("org/paged", files).commit
    stub_hub.page_size = 3
    hub = HubClient(stub_hub.endpoint, TOKEN)
    found = [file.path for file in hub.listing(Repository("model", "org/paged"), commit)]
    assert found == list(files)
    assert stub_hub.authorizations == [f"Bearer {TOKEN}"] * 3


def test_what_no_header_or_url_takes_is_refused_unseen(get: Fetch) -> None:
    """The HTTP library would print the header with the token in it: it never gets there. For an
    endpoint there is an example."""
    for token in ("", "hf_a b", "hf_é", "hf_a\nX-Evil: 1"):
        with pytest.raises(HubReferenceError) as caught:
            get(token=token)
        assert "hf_a" not in str(caught.value)
    for endpoint in ("huggingface.co", "ftp://huggingface.co", "https://"):
        with pytest.raises(HubReferenceError, match=r"https://huggingface\.co"):
            get(endpoint=endpoint)


def test_missing_stored_token_says_how_to_store_one(
    get: Fetch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "none"))
    assert "none is stored" in str(failure(get, token=True))


def test_password_in_the_endpoint_is_not_shown(
    stub_hub: StubHub, get: Fetch, caplog: pytest.LogCaptureFixture
) -> None:
    """An endpoint with a password works; no error, cause, traceback or log has the password."""
    endpoint = stub_hub.endpoint.replace("//", "//us%40er:s3cret@")
    with caplog.at_level(logging.DEBUG):
        assert get(endpoint=endpoint).path == "env.py"
        login = base64.b64encode(b"us@er:s3cret").decode()
        assert set(stub_hub.authorizations) == {f"Basic {login}"}
        for status in (404, 500):
            stub_hub.fail("/api/", status)
            text = "".join(traceback.format_exception(failure(get, endpoint=endpoint)))
            assert stub_hub.endpoint in text
            assert not {"s3cret", login} & set(re.findall(r"[\w=]+", text + caplog.text))
    assert "127.0.0.1" in caplog.text, "the control failed: nobody logs URLs"


@pytest.mark.parametrize("again", [True, False])
def test_interrupts_wait_for_no_download(
    stub_hub: StubHub, hub_cache: Path, *, again: bool
) -> None:
    files = {f"assets/{number}": str(number) for number in range(20)}
    stub_hub.add("org/repo", {"env.py": STILL, **files})
    stub_hub.fail("(GET|HEAD) /org/repo/resolve/.*/assets/7$", stall=True, times=1)
    places = {"HF_ENDPOINT": stub_hub.endpoint, "HF_HUB_CACHE": str(hub_cache)}
    waits = ("HF_HUB_ETAG_TIMEOUT", "HF_HUB_DOWNLOAD_TIMEOUT")
    with subprocess.Popen(
        [sys.executable, "-c", f"AGAIN = {again}{INTERRUPTED}"],
        stdout=subprocess.PIPE,
        env={**os.environ, **places, **dict.fromkeys(waits, "3600")},
    ) as process:
        assert eventually(lambda: any("/assets/7" in one for one in stub_hub.requests), 120)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=240)
    assert (out, process.returncode) == (b"interrupted\n" + b"loaded\n" * again, 0)
