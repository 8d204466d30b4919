"""Whoever looks for the text of an error in docs/troubleshooting.md finds it, and what cures it."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox import Policy, Timeouts, make_env
from envhub_sandbox.errors import EnvHubError
from tests.support.documents import troubleshooting

pytestmark = pytest.mark.same_for("users", "versions")

_PAGE = troubleshooting.DOCUMENT.read_text()


def as_shown(page: str) -> str:
    """The words of a page as a browser shows them."""
    return html.unescape(re.sub(r"\\([|*_<>\[\]`\\])", r"\1", page))


def test_the_page_is_written_from_the_messages() -> None:
    """``python -m tests.support.documents.troubleshooting`` writes it again."""
    assert troubleshooting.document() == _PAGE


def test_every_message_that_names_a_cure_is_found_by_its_words() -> None:
    """All that is the same each time, as a person searches for it."""
    page = as_shown(_PAGE).replace(" | ", " ")
    messages = troubleshooting.messages()
    assert len({one.place for one in messages}) > 50
    missing = [part for one in messages for part in words(one) if part not in page]
    assert missing == []


def words(message: troubleshooting.Message) -> list[str]:
    """The fixed parts of a message, with single spaces."""
    return [" ".join(part.split()) for part in message.fixed]


_SOURCE = '''
"""Use nothing of a docstring."""
_OTHERWISE = "Use another"


def f(name, n):
    """Call this of a docstring."""
    Option("--it", help="Use it like this.")
    log(f"{name} has gone")
    raise ValueError(f"{name} is {n!r}; it takes a number")
    raise ValueError(f"{name} is full: " + g() + f". {_OTHERWISE}, or wait")
    raise Missing("layer", "the kernel is old", "Install a newer one.")
    raise ValueError("nothing to be done about it")
'''


def test_messages_are_told_from_other_texts() -> None:
    """Those of f-strings, sums, constants and neighbours; neither help nor mere statements."""
    found = {(one.says, one.cure) for one in troubleshooting.of_source(_SOURCE, "x.py")}
    assert found == {
        ("… is …; ", "it takes a number"),
        ("… is full: …. ", "Use another, or wait"),
        ("the kernel is old", "Install a newer one."),
    }


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: make_env("./there-is-no-such-folder"),
        lambda: Policy(gpu="yes"),  # type: ignore[arg-type]
        lambda: Timeouts(step_s=-1),
        lambda: make_env("./examples/cartpole", sandbox="vm"),
        lambda: make_env("./examples/cartpole", n_envs="four"),  # type: ignore[arg-type]
    ],
)
def test_what_is_really_raised_is_found(
    wrong: Callable[[], object], checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One row has all of its fixed words in the error's text, in their order."""
    monkeypatch.chdir(checkout)
    with pytest.raises((EnvHubError, TypeError, ValueError)) as caught:
        wrong()
    said = " ".join(str(caught.value).split())
    rows = [row for row in _PAGE.splitlines() if row.startswith("| ")]
    assert any(re.search(pattern(row), said) for row in rows), said


def pattern(row: str) -> str:
    """What a row says, with anything for its ellipses."""
    says = (
        as_shown(row)
        .strip("|")
        .replace(" | ", " ")
        .removesuffix(f" {troubleshooting.NO_MORE} ")
        .strip()
    )
    return ".*".join(re.escape(part.strip()) for part in says.split("…"))
