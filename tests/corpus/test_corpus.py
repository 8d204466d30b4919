"""``envhub check`` finds the one fault of each repository, and nothing in the honest ones.
What stands with an entry is in the table of ``docs/checks.md``; here each fifth honest one is
judged, and of the faults that one check finds the first. ``ENVHUB_TEST_LONG=1`` judges all."""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.extras.judge.checks import CHECKS
from tests.corpus.entries import Entry
from tests.corpus.faults import FAULTS
from tests.corpus.honest import HONEST

_ENTRIES = {**HONEST, **FAULTS}
_ELSEWHERE = {
    "card": "test_findings.py",
    "deadline": "test_deadline.py",
    "endless-unknown": "test_findings.py",
    "lerobot": "test_findings.py",
    "licence": "test_findings.py",
    "limits-reached": "test_findings.py",
    "pinned": "test_judge.py",
    "source-ignored": "test_survey_checkouts.py",
    "source-link": "test_survey.py",
    "source-uncommitted": "test_survey_checkouts.py",
}
"""Checks that need more than a folder, and what tests them."""
_MOST, _EACH = (len(FAULTS), 1) if "ENVHUB_TEST_LONG" in os.environ else (1, 5)


def faults() -> Iterator[str]:
    """Names of faults, some of each check; what is not found is among them."""
    judged = Counter[str]()
    for name, entry in FAULTS.items():
        judged[entry.told] += 1
        if judged[entry.told] <= _MOST or entry.found is not None:
            yield name


@pytest.mark.filterwarnings("ignore::envhub_sandbox.errors.RemoteEnvWarning")
@pytest.mark.parametrize("name", [*list(HONEST)[::_EACH], *faults()])
def test_it_is_judged_as_it_stands(name: str, tmp_path: Path) -> None:
    entry = _ENTRIES[name]
    found = entry.judged(tmp_path)
    assert set(found) == entry.expected, found


def test_the_corpus_is_large() -> None:
    assert len(HONEST) >= 30
    assert len(FAULTS) >= 60
    assert not set(HONEST) & set(FAULTS)
    found = {entry.told for entry in FAULTS.values() if entry.told in entry.expected}
    assert found.isdisjoint(_ELSEWHERE)
    assert found | set(_ELSEWHERE) == set(CHECKS)
    tests = {path.name for path in Path(__file__).parents[1].rglob("test_*.py")}
    assert set(_ELSEWHERE.values()) <= tests


def test_entries_differ() -> None:
    def text(entry: Entry) -> tuple[str, ...]:
        return entry.source(), *map(repr, sorted(entry.files.items()))

    texts = [text(entry) for entry in _ENTRIES.values()]
    assert len(set(texts)) == len(texts)
