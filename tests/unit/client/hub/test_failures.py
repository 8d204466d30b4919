"""What exceptions of the Hub client mean: in words, with what to do, and without a secret."""

from __future__ import annotations

import errno
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.hub.failures import HubFailure, Kind, conceal, explain


class GatedRepoError(Exception):
    """By the names of huggingface_hub's."""


class LocalEntryNotFoundError(Exception):
    """A wrapper, whose cause counts."""


class ConnectTimeout(TimeoutError):
    """Of a transport."""


def answered(status: int, **headers: str) -> Exception:
    """An error with a response of the Hub's."""
    error: Any = OSError("see the response")
    error.response = SimpleNamespace(
        status_code=status, headers={name.replace("_", "-"): text for name, text in headers.items()}
    )
    return error  # type: ignore[no-any-return]


def explained(error: BaseException, *secrets: str) -> HubFailure:
    """For a model."""
    return explain(
        error,
        secrets,
        repo_type="model",
        repo_id="org/repo",
        revision=None,
        endpoint="https://h",
    )


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (GatedRepoError(), Kind.GATED),
        (answered(404), Kind.NO_REPOSITORY),
        (answered(401), Kind.NO_REPOSITORY),  # what the Hub says without a token
        (
            answered(401, X_Error_Message="Invalid credentials in Authorization header"),
            Kind.UNAUTHORIZED,
        ),
        *((answered(status), Kind.SERVER_ERROR) for status in (500, 503)),
        *((answered(403), Kind.FORBIDDEN), (answered(429), Kind.RATE_LIMITED)),
        *((OSError(errno.ENOSPC, "full"), Kind.DISK_FULL), (ConnectTimeout(), Kind.TIMEOUT)),
        *((ConnectionError(), Kind.UNREACHABLE), (ZeroDivisionError(), Kind.OTHER)),
    ],
)
def test_each_failure_is_known_by_its_cause(error: Exception, kind: Kind) -> None:
    """By itself, and behind a wrapper that says nothing."""
    wrapper = LocalEntryNotFoundError("not there")
    wrapper.__cause__ = error
    for one in (error, wrapper):
        found = explained(one)
        assert found.kind is kind
        assert "{" not in found.what + found.advice


def test_what_a_hub_says_is_quoted_in_one_line_without_secrets() -> None:
    """It may echo a token; what it asks to wait is told."""
    said = answered(429, X_Error_Message="slow \x1b[2J down hf_secret" + "x" * 900, Retry_After="7")
    found = explained(said, "hf_secret")
    assert found.what.isprintable()
    assert len(found.what) < 400
    assert "hf_secret" not in found.what
    assert "Wait 7 s" in found.advice
    error = ValueError("token hf_secret", 3)
    error.__cause__ = OSError("hf_secret")
    conceal(error, ("hf_secret",))
    assert (error.args, error.__cause__.args) == (("token ***", 3), ("***",))
