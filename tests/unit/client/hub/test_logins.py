"""A login stands in no pickle, repr or error, whatever URL or object it came in."""

import copy
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import HubReferenceError, PolicyError
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox
from envhub_sandbox.hub.client import HubClient, checked_endpoint
from envhub_sandbox.hub.logins import authorization, login_of, without_login
from envhub_sandbox.session.repository import Recipe

SECRET = "s3cret"
HUB = f"https://me@there:{SECRET}@hub.example/x"
KEY = "5e" * 32


@pytest.mark.parametrize(
    ("url", "plain", "login"),
    [
        ("https://hub.example/x", "https://hub.example/x", None),
        ("https://a:b@hub.example", "https://hub.example", ("a", "b")),
        ("https://a@hub.example", "https://hub.example", ("a", "")),
        ("https://a@b:c@d@hub.example/x", "https://hub.example/x", ("a@b", "c@d")),
        ("https://a:p%2Fw%40@hub.example", "https://hub.example", ("a", "p/w@")),
        ("https://hub.example/x@y", "https://hub.example/x@y", None),
        ("env.py", "env.py", None),
    ],
)
def test_logins_are_taken_out(url: str, plain: str, login: tuple[str, str] | None) -> None:
    assert without_login(url) == plain
    assert login_of(url) == login


def test_a_login_is_sent_as_http_says() -> None:
    """RFC 7617's own example."""
    assert authorization(("Aladdin", "open sesame")) == "Basic QWxhZGRpbjpvcGVuIHNlc2FtZQ=="


def make(cfg: Any, **options: Any) -> Any:
    """In place of ``make_env``."""
    return options


def recipe() -> Recipe:
    return Recipe(
        make_env=make,
        reference="org/repo@0123",
        config={"key": SECRET},
        options={"endpoint": HUB, "n_envs": 2},
    )


def test_recipes_hold_no_login() -> None:
    """Neither in their fields, nor pickled; and none of the caller's arguments is printed."""
    made = recipe()
    assert made.options == {"endpoint": "https://hub.example/x", "n_envs": 2}
    assert SECRET not in repr(made)
    bare = Recipe(make_env=make, reference="x", config=None, options={"endpoint": HUB})
    assert SECRET.encode() not in pickle.dumps(bare)
    assert SECRET.encode() in pickle.dumps(HUB), "the control failed"


def test_whoever_unpickles_uses_a_login_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where ``HF_ENDPOINT`` is that endpoint with a login, this is what is asked."""
    monkeypatch.delitem(sys.modules, "huggingface_hub.constants", raising=False)
    assert recipe().make()["endpoint"] == "https://hub.example/x"
    monkeypatch.setenv("HF_ENDPOINT", f"https://you:{SECRET}@hub.example/x/")
    assert recipe().make()["endpoint"] is None


@pytest.mark.parametrize("url", [f"ftp://a:{SECRET}@hub", f"https://a:{SECRET}/b@hub", HUB])
def test_no_endpoint_is_shown_with_its_login(url: str) -> None:
    try:
        shown = repr(HubClient(checked_endpoint(url))) + HubClient(url).public_endpoint
    except HubReferenceError as error:
        shown = str(error)
    assert SECRET not in shown


def test_remote_sandboxes_pickle_without_their_key(tmp_path: Path) -> None:
    """A file travels by its name; a copy in this process keeps the key."""
    sandbox = RemoteSandbox("tcp://10.0.0.1:5555", client_key=KEY)
    assert KEY.encode() not in pickle.dumps(sandbox)
    assert pickle.loads(pickle.dumps(sandbox)).client_key is None
    for copied in (copy.copy(sandbox), copy.deepcopy(sandbox)):
        assert copied == sandbox
        assert copied is not sandbox
    for file in (tmp_path / "client.key", str(tmp_path / "client.key")):
        named = RemoteSandbox("tcp://10.0.0.1:5555", client_key=file)
        assert pickle.loads(pickle.dumps(named)) == named


def test_a_login_for_a_remote_server_is_refused_unseen() -> None:
    with pytest.raises(PolicyError, match=r"'tcp://10\.0\.0\.1:5555'") as caught:
        RemoteSandbox(f"tcp://me:{SECRET}@10.0.0.1:5555")
    assert SECRET not in str(caught.value)
