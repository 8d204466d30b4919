"""Files with settings of a judgement: a caller's policy, and what an author may ask for."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox.check import settings
from envhub_sandbox.check.settings import Asks
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.policy import policy_from
from tests.support.repositories import write_repository


def test_a_policy_is_a_file(tmp_path: Path) -> None:
    """Options change what it says, limit by limit, and nothing else of it."""
    file = tmp_path / "policy.toml"
    file.write_text('network = "loopback"\n[limits]\nprocesses = 9\nopen_files = 64\n')
    made = policy_from(settings.merged(settings.policy(file), {"limits": {"processes": 12}}), None)
    assert (made.network, made.limits.processes, made.limits.open_files) == ("loopback", 12, 64)
    assert made == policy_from(
        {"network": "loopback", "limits": {"processes": 12, "open_files": 64}}, None
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("network =", "no TOML"),
        ("#" * 20_000, "larger than"),
        ("x = " + "[" * 5_000, "no TOML"),
        ("limits = 3", r"\[limits\]"),
        ('netwrok = "none"', "knows no netwrok"),
    ],
)
def test_what_is_no_policy_is_refused(text: str, says: str, tmp_path: Path) -> None:
    """With the reason; a misspelt field that did nothing would be a hole."""
    file = tmp_path / "policy.toml"
    file.write_text(text)
    with pytest.raises(PolicyError, match=says):
        policy_from(settings.merged(settings.policy(file), {}), None)


def test_a_policy_that_is_not_there_is_told(tmp_path: Path) -> None:
    """And not taken for one that says nothing."""
    with pytest.raises(PolicyError, match="cannot be read"):
        settings.policy(tmp_path / "nowhere.toml")


def asked(folder: Path, text: str) -> Asks:
    """What an author's file comes to, where the judge plays 200 steps and 8 resets."""
    repository = write_repository(folder, "", envhub__toml=text)
    return settings.of_the_author(local(repository), 200, 8)


def test_an_author_asks_for_more(tmp_path: Path) -> None:
    """Of a play; with less, or none, the judge takes what it would have taken."""
    assert asked(tmp_path / "a", "[check]\nsteps = 900\nresets = 20") == Asks(900, 20)
    assert asked(tmp_path / "b", "[check]\nsteps = 1\nresets = 0") == Asks(200, 8)
    assert asked(tmp_path / "c", "[other]\nsteps = 900") == Asks(200, 8)
    assert settings.of_the_author(local(write_repository(tmp_path / "d", "")), 200, 8) == Asks(
        200, 8
    )


@pytest.mark.parametrize(
    "text",
    [
        '[check]\nallow = ["seeding"]',
        '[check]\nfail_on = "error"',
        '[check]\n[check.policy]\nnetwork = "host"',
        "[check]\nsteps = 1000000000",
        "[check]\nsteps = true",
        "[check]\nresets = -1",
        '[check]\nsteps = "\\u001b[2J"',
        "check = 3",
        "[check",
        "x = " + "[" * 5_000,
        "#" * 100_000,
        '[check]\n"\\u009b" = 1',
    ],
)
def test_an_author_loosens_nothing(text: str, tmp_path: Path) -> None:
    """What is not his to say is refused, told in one printable line, and changes nothing."""
    found = asked(tmp_path / "r", text)
    assert (found.steps, found.resets) == (200, 8)
    [why] = found.refused
    assert why.isprintable()
    assert len(why) <= 310
