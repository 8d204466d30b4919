"""Checks a Hub's answers before they are used, and explains its failures.

Answers must be bounded, and headers must be harmless as file names: huggingface_hub makes paths of
``ETag`` and ``X-Repo-Commit``, by which a hostile Hub could write files outside of the Hub cache.
Sessions are of the library requests (before 1.0) or httpx.

The text of a failure says what to do next. huggingface_hub 0.34 raises exceptions of requests, 1.x
of httpx and 2.x of httpx2, often wrapped in ``LocalEntryNotFoundError``. So ``explain`` walks the
chain of causes, and recognises exceptions of transports by the names of their classes.
"""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from typing import Any

from envhub_sandbox.settings.options import option_name
from envhub_worker.protocol.text import printable

MAX_BODY_BYTES = 64 << 20
"""The most bytes of a page of a listing, unpacked; the Hub's pages have some 300 kB."""
_MAX_BODY_S = 300.0
_NAMES = {
    "ETag": r'(W/)?"?[A-Za-z0-9_+=:-][A-Za-z0-9_+=:.-]{0,199}"?',
    "X-Linked-ETag": r'(W/)?"?[A-Za-z0-9_+=:-][A-Za-z0-9_+=:.-]{0,199}"?',
    "X-Repo-Commit": r"[0-9a-f]{40}",
    "X-Xet-Hash": r"[0-9a-f]{1,128}",
}


class HostileAnswerError(Exception):
    """An answer that no honest Hub gives; the text says what is wrong with it."""


def streamed(session: Any, url: str, options: Mapping[str, Any]) -> Any:
    """A context with the answer to a GET, before its body is read."""
    if callable(getattr(session, "stream", None)):  # httpx; in a session of requests it is a bool
        return session.stream("GET", url, **options)
    return session.get(url, stream=True, **options)


def bounded_body(response: Any) -> bytes:
    """The body of a streamed answer, unpacked. Raises ``HostileAnswerError``."""
    of_requests = hasattr(response, "iter_content")
    chunks = response.iter_content(1 << 16) if of_requests else response.iter_bytes()
    body, end = bytearray(), time.monotonic() + _MAX_BODY_S
    for chunk in chunks:
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise HostileAnswerError(f"an answer has over {MAX_BODY_BYTES} bytes")
        if time.monotonic() > end:
            raise HostileAnswerError(f"an answer has not ended after {_MAX_BODY_S:.0f} s")
    return bytes(body)


@contextmanager
def guarded(session: Any) -> Iterator[None]:
    """Within this context, have the session refuse answers whose headers make hostile names.

    Other threads may use the session meanwhile; their answers are checked, too.
    """
    of_httpx = hasattr(session, "event_hooks")
    hooks = (session.event_hooks if of_httpx else session.hooks).setdefault("response", [])
    hooks.append(_judge)
    try:
        yield
    finally:
        hooks.remove(_judge)


def _judge(response: Any, *_: object, **__: object) -> None:
    for name, form in _NAMES.items():
        value = response.headers.get(name)
        if value is not None and not re.fullmatch(form, value):
            raise HostileAnswerError(f"the header {name} of an answer is {value[:200]!r}")


_LONGEST_QUOTE = 200
_LOGIN = re.compile(r"(?<=//)[^/?#\s]*(?=@)|(?<=\?)\S+")
_LOG_IN = "log in with `hf auth login` (`huggingface-cli login` before 1.0) or pass a token"


class Kind(Enum):
    """Why the Hub did not give something: what happened, and what to do.

    The fields in the texts are those of ``explain``.
    """

    NO_REPOSITORY = (
        "there is no {repo_type} repository {repo_id} that you may see ({status})",
        f"Check the spelling and the owner; if it is private, {_LOG_IN}",
    )
    NO_REVISION = (
        "the {repo_type} repository {repo_id} has no revision {revision}",
        "Check the branch, tag or commit at {url}/commits/main",
    )
    NO_ENTRY = (
        "the {repo_type} repository {repo_id} lacks a file that its own listing names",
        "Try again; if it persists, ask the repository's owner",
    )
    GATED = (
        "the {repo_type} repository {repo_id} is gated and you have no access yet{said}",
        f"Accept its terms at {{url}}, then {_LOG_IN}",
    )
    DISABLED = (
        "the {repo_type} repository {repo_id} was disabled on the Hub{said}",
        "Ask its owner, or use another repository",
    )
    UNAUTHORIZED = (
        "the Hub refused your token (401){said}",
        f"It may have expired, or be for another endpoint: {_LOG_IN}; {{no_token}} sends none",
    )
    FORBIDDEN = (
        "your token may not read the {repo_type} repository {repo_id} (403){said}",
        "Give the token read access to it at {endpoint}/settings/tokens, or ask its owner",
    )
    NO_TOKEN = (
        "token=True needs a stored token, and none is stored on this machine",
        f"To store one, {_LOG_IN}",
    )
    RATE_LIMITED = (
        "the Hub's rate limit is reached (429){said}",
        f"Wait {{wait}} and try again; you get a higher limit if you {_LOG_IN}",
    )
    SERVER_ERROR = (
        "the Hub has a problem ({status}){said}",
        "Try again later; see https://status.huggingface.co",
    )
    OFFLINE = (
        "HF_HUB_OFFLINE is set, so the Hub was not asked",
        "Unset HF_HUB_OFFLINE to go online",
    )
    TIMEOUT = (
        "the Hub did not answer in time",
        "Check the network and try again; HF_HUB_ETAG_TIMEOUT=30 waits longer",
    )
    UNREACHABLE = (
        "the Hub cannot be reached ({reason})",
        "Check the network, the endpoint (HF_ENDPOINT), the proxy (HTTPS_PROXY) and, for a "
        "certificate, SSL_CERT_FILE and REQUESTS_CA_BUNDLE",
    )
    PROXY_LOGIN = (
        "a proxy on the way to the Hub wants a login (407)",
        "Set HTTPS_PROXY to http://USER:PASSWORD@HOST:PORT",
    )
    BROKEN_DOWNLOAD = (
        "the download broke off or had the wrong length",
        "Try again; if it persists, a proxy or a mirror changes the files",
    )
    DISK_FULL = (
        "the disk is full ({reason})",
        "Free space, or put the Hub cache elsewhere (HF_HOME)",
    )
    CACHE = (
        "the Hub client cannot use its cache ({reason})",
        "Fix the permissions, or put the Hub cache elsewhere (HF_HOME)",
    )
    OTHER = (
        "the Hub client failed ({reason}){said}",
        "Check the endpoint; if it is right, try again with HF_DEBUG=1",
    )


ABSENT = frozenset({Kind.NO_REPOSITORY, Kind.NO_REVISION, Kind.NO_ENTRY})
"""The repository or file does not exist; there may be a repository of another type."""

UNREACHABLE = frozenset(
    {
        *(Kind.OFFLINE, Kind.TIMEOUT, Kind.UNREACHABLE, Kind.PROXY_LOGIN, Kind.RATE_LIMITED),
        Kind.SERVER_ERROR,
    }
)
"""The request says nothing about the repository, so a commit in the store may still be valid."""


class HubFailure(Exception):
    """A request to the Hub failed. ``what`` and ``advice`` are sentences without a full stop."""

    def __init__(self, kind: Kind, failure: str, advice: str) -> None:
        super().__init__(failure, advice)
        self.kind = kind
        self.what = failure
        self.advice = advice


_BAD_TOKEN = "Invalid credentials in Authorization header"
_TIMEOUT_CLASSES = frozenset({"Timeout", "TimeoutException", "TimeoutError"})
_TRANSPORT_CLASSES = frozenset(
    {"ConnectionError", "NetworkError", "TransportError", "ProtocolError", "ProxyError", "SSLError"}
)


def explain(
    error: BaseException,
    secrets: tuple[str, ...] = (),
    *,
    repo_type: str,
    repo_id: str,
    revision: str | None,
    endpoint: str,
) -> HubFailure:
    """Turn an exception of the Hub client into a failure with advice."""
    known_kinds = ((kind, link) for link in chain(error) if (kind := _kind_of(link)) is not None)
    kind, source = next(known_kinds, (Kind.OTHER, error))
    response = getattr(source, "response", None)
    message = _header(response, "X-Error-Message")
    words = "".join(c if c.isprintable() else " " for c in message)[:_LONGEST_QUOTE]
    seconds = _header(response, "Retry-After")
    # the exception's class, and the text of the innermost system error in its chain
    texts = [str(link) for link in chain(source) if isinstance(link, OSError) and str(link)]
    text = _LOGIN.sub("***", printable([str(source), *texts][-1])[:_LONGEST_QUOTE])
    text = " ".join(text.split())
    fields = {
        "repo_type": repo_type,
        "repo_id": repo_id,
        "endpoint": endpoint,
        "url": f"{endpoint}/{'' if repo_type == 'model' else f'{repo_type}s/'}{repo_id}",
        "revision": repr(revision) if revision else "'main' (is it empty?)",
        "status": getattr(response, "status_code", "not found"),
        "said": f'; it said: "{words}"' if words else "",
        "wait": f"{int(seconds)} s" if seconds.isdecimal() else "a few minutes",
        "reason": f"{type(source).__name__}: {text}" if text else type(source).__name__,
        "no_token": option_name("token", False),
    }
    failure, advice = (text.format(**fields) for text in kind.value)
    return HubFailure(kind, redact(failure, secrets), redact(advice, secrets))


def redact(text: str, secrets: tuple[str, ...]) -> str:
    """Replace secrets in a text, which a careless server may have echoed."""
    for secret in secrets:
        text = text.replace(secret, "***")
    return text


def conceal(error: BaseException, secrets: tuple[str, ...]) -> None:
    """Replace secrets in the texts of an exception and its causes, which tracebacks show."""
    for link in chain(error):
        link.args = tuple(
            redact(value, secrets) if isinstance(value, str) else value for value in link.args
        )


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception and its chain of causes."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def _kind_of(error: BaseException) -> Kind | None:
    names = {cls.__name__ for cls in type(error).__mro__}
    if "LocalEntryNotFoundError" in names or "IncompleteSnapshotError" in names:
        return None  # a wrapper: its cause has the reason
    for name, kind in _KIND_OF_CLASS:
        if name in names:
            return kind
    response = getattr(error, "response", None)
    status = getattr(response, "status_code", None)
    if status == 401 and _header(response, "X-Error-Message") != _BAD_TOKEN:
        return Kind.NO_REPOSITORY  # the Hub's answer, without a token, for anything that it hides
    if isinstance(status, int):
        return _KIND_OF_STATUS.get(status, Kind.SERVER_ERROR if status >= 500 else Kind.OTHER)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return Kind.DISK_FULL
    if isinstance(error, OSError) and error.filename and error.errno != errno.ENOENT:
        return Kind.CACHE
    if "Consistency check failed" in str(error) or "IncompleteRead" in str(error):
        return Kind.BROKEN_DOWNLOAD
    if names & _TIMEOUT_CLASSES:
        return Kind.TIMEOUT
    return Kind.UNREACHABLE if names & _TRANSPORT_CLASSES else None


# Subclasses come before their base classes: a gated error is also a not-found error.
_KIND_OF_CLASS = (
    ("GatedRepoError", Kind.GATED),
    ("DisabledRepoError", Kind.DISABLED),
    ("RepositoryNotFoundError", Kind.NO_REPOSITORY),
    ("RevisionNotFoundError", Kind.NO_REVISION),
    ("EntryNotFoundError", Kind.NO_ENTRY),
    ("OfflineModeIsEnabled", Kind.OFFLINE),
    ("LocalTokenNotFoundError", Kind.NO_TOKEN),
)
_KIND_OF_STATUS = {
    401: Kind.UNAUTHORIZED,
    403: Kind.FORBIDDEN,
    404: Kind.NO_REPOSITORY,
    407: Kind.PROXY_LOGIN,
    408: Kind.TIMEOUT,
    429: Kind.RATE_LIMITED,
}


def _header(response: object, name: str) -> str:
    headers = getattr(response, "headers", None)
    return str(headers.get(name) or "") if headers is not None else ""
