"""What is said about the attacks is what is tested."""

import re
from pathlib import Path

import pytest

from tests.attacks import table
from tests.attacks.expectations import MEASURED_ATTACKS, NOT_STOPPED, SHARED
from tests.attacks.harness import Row

pytestmark = pytest.mark.short
DOCS = Path(__file__).parents[2] / "docs"


def listed(page: str, profile: str) -> set[str]:
    """The attacks in the table below a profile's heading."""
    _, _, below = page.partition(f"### Under `{profile}`")
    section = re.split(r"\n#+ ", below)[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    return {row.split("|")[1].strip() for row in rows} - {"Attack", "---"}


def test_threat_model_lists_what_is_not_stopped() -> None:
    """Every exception is in the threat model under its profile, and nothing else is."""
    page = (DOCS / "threat-model.md").read_text()
    everywhere = listed(page, "strict")
    weaker = listed(page, "no-userns")
    assert everywhere | weaker == set(NOT_STOPPED)
    for attack, reasons in NOT_STOPPED.items():
        only_weaker = all(where.startswith("no-userns") for where in reasons)
        assert attack in (weaker if only_weaker else everywhere), attack


def test_threat_model_lists_what_a_jail_holds_open() -> None:
    """Every descriptor, and who else holds its open file description, as the kernel says."""
    _, _, below = (DOCS / "threat-model.md").read_text().partition("## What a jail holds open")
    rows = [line.split("|") for line in below.split("\n## ")[0].splitlines() if "|" in line][2:]
    said = {
        name.strip(): set(re.findall(r"\w+", who.replace("no other process", "")))
        for _, name, who, *_ in rows
    }
    assert said == SHARED


def test_table_agrees_with_the_expectations() -> None:
    """What the table of attacks calls not stopped is expected, or only measured; and each family of
    attacks is in it."""
    above, _, below = (DOCS / "attacks.md").read_text().partition("## Not stopped")
    sources = [path.read_text() for path in Path(__file__).parent.rglob("*.py")]
    families = {name for text in sources for name in re.findall(r'^FAMILY = "(.+)"$', text, re.M)}
    assert families == set(re.findall(r"^\| (\w.+?) \| \d+ \|", above, re.MULTILINE))
    rows = [line for line in below.splitlines() if line.startswith("| ")][1:]
    named = {row.split("|")[1].strip() for row in rows}
    assert set(NOT_STOPPED) <= named <= {*NOT_STOPPED, *MEASURED_ATTACKS}


def test_updates_keep_the_other_users_columns(tmp_path: Path) -> None:
    page = tmp_path / "attacks.md"
    for user in ("root", "user"):
        table.update(page, [Row("tcp", "Network", "strict", user, "succeeds", "stopped", "")])
    noted = Row("raw", "Network", "strict", "user", "not possible", "no proof", "only root may")
    table.update(page, [noted])
    text = page.read_text()
    assert "| tcp | outside | succeeds | succeeds | stopped | stopped |  |  |" in text
    assert "- raw, user: only root may" in text
    table.update(page, [noted])
    assert page.read_text() == text
    through = Row("udp", "Network", "strict", "user", "succeeds", "NOT STOPPED", "")
    table.update(page, [through])
    counted, _, below = table.summary(page.read_text()).partition("## Not stopped")
    assert "| Network | 3 | 1 | 1 |" in counted
    assert "| udp | outside | " in below
    assert "tcp" not in below
