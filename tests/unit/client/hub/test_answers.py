"""What the Hub's answers and failures mean, and TOML of strangers, by themselves."""

import errno
import itertools
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.extras.sources import toml
from envhub_sandbox.hub import answers
from envhub_sandbox.hub.answers import HostileAnswerError, Kind, bounded_body, guarded


def failed(error: BaseException, *secrets: str) -> answers.HubFailure:
    about = {"repo_type": "space", "repo_id": "owner/name", "endpoint": "https://hub.example"}
    return answers.explain(error, secrets, revision=None, **about)


def answered(status: int, **headers: str) -> BaseException:
    error = type("HTTPStatusError", (Exception,), {})("status")
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    error.response = SimpleNamespace(status_code=status, headers=named)
    return error


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(errno.ENOSPC, "full"), Kind.DISK_FULL),
        (TimeoutError(), Kind.TIMEOUT),
        (RuntimeError("anything"), Kind.OTHER),
    ],
)
def test_what_no_hub_answers_has_a_kind_too(error: BaseException, kind: Kind) -> None:
    wrapper = type("LocalEntryNotFoundError", (Exception,), {})("wrapped")
    wrapper.__cause__ = error
    assert [failed(error).kind, failed(wrapper).kind] == [kind, kind]


def test_a_secret_that_is_echoed_is_in_no_text() -> None:
    error = answered(403, X_Error_Message="hf_secret may not")
    assert "hf_secret" not in failed(error, "hf_secret").what
    inner = ValueError("hf_secret", 3)
    assert len(failed(answered(403, X_Error_Message="x" * 10_000)).what) < 1_000
    outer = RuntimeError("with hf_secret")
    outer.__cause__, inner.__context__ = inner, outer  # a cycle ends, too
    answers.conceal(outer, ("hf_secret",))
    assert (outer.args, inner.args) == (("with ***",), ("***", 3))
    assert list(answers.chain(outer)) == [outer, inner]


def test_toml_is_read_within_bounds() -> None:
    assert toml.loads("a.b = 1", 100) == {"a": {"b": 1}}
    for text, most in (("a = 1", 4), (".".join("a" * 3_000) + " = 1", 10_000), ("a = [", 100)):
        with pytest.raises(ValueError, match=r".") as error:
            toml.loads(text, most)
        assert len(str(error.value)) <= 200


def test_dots_in_texts_of_a_generated_document_do_not_count() -> None:
    """It has thousands of addresses; a text of several lines could hide others, and is refused."""
    dotted: dict[str, Any] = toml.loads(f'a = "{"." * 3_000}"', 10_000, generated=True)
    assert len(dotted["a"]) == 3_000
    with pytest.raises(ValueError, match="dots"):
        toml.loads(f'a = "{"." * 3_000}"', 10_000)
    with pytest.raises(ValueError, match="several lines"):
        toml.loads('a = """\nb"""', 100, generated=True)


def test_quotes_without_an_end_cost_no_search_each() -> None:
    """With a search from each quote on, this lock of a stranger's takes a quarter of an hour."""
    program = f"""
from {toml.__name__} import loads
try:
    loads('a = "' + '\\\\"' * 100_000, 1 << 20, generated=True)
except ValueError as error:
    print(error)
"""
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert "Unterminated" in done.stdout


# --- Answers of a Hub are bounded, and their headers make no hostile names


def sessions() -> list[tuple[Any, list[Any]]]:
    of_httpx = SimpleNamespace(event_hooks={"response": []})
    of_requests = SimpleNamespace(hooks={"response": []})
    return [(of_httpx, of_httpx.event_hooks), (of_requests, of_requests.hooks)]


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("ETag", '"0123abc"', '"../../etc/x"'),
        ("ETag", "0123abc", '".."'),
        ("X-Linked-ETag", 'W/"0123abc"', "a/b"),
        ("X-Repo-Commit", "0" * 40, "../" * 10),
        ("X-Xet-Hash", "0a", "."),
    ],
)
def test_headers_that_would_lead_elsewhere_are_refused(name: str, good: str, bad: str) -> None:
    """While a session is guarded, and no longer; honest ones pass."""
    for session, hooks in sessions():
        with guarded(session):
            [judge] = hooks["response"]
            judge(SimpleNamespace(headers={name: good}))
            with pytest.raises(HostileAnswerError, match=name):
                judge(SimpleNamespace(headers={name: bad}))
        assert hooks["response"] == []


def test_a_body_that_comes_slowly_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    assert bounded_body(SimpleNamespace(iter_content=lambda size: [b"12345", b"6"])) == b"123456"
    clock = SimpleNamespace(monotonic=iter(range(0, 9_000, 100)).__next__)
    monkeypatch.setattr(answers, "time", clock)
    with pytest.raises(HostileAnswerError, match="has not ended"):
        bounded_body(SimpleNamespace(iter_bytes=lambda: itertools.repeat(b"", 9)))
