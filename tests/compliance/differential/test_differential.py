"""A bounded number of random cases; the command beside it runs as many as one likes."""

from typing import Any

import pytest

from tests.compliance.differential import KINDS, cases, rows, sharing
from tests.compliance.theirs.through_sandbox import vector

CALLS = 12
EACH = {"calls": 12, "rows": 8, "sharing": 3}


@pytest.mark.short("calls")
@pytest.mark.parametrize("kind", EACH)
def test_random_cases_do_not_differ(kind: str) -> None:
    """Whatever is drawn and called, the sandbox gives what Gymnasium gives."""
    several = KINDS[kind]
    for number in range(EACH[kind]):
        drawn = several.case(number)
        found = several.difference(drawn, CALLS)
        assert found is None, f"{drawn}: {found}"


def test_what_differs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def turned(env_fns: Any, **kwargs: Any) -> Any:
        return vector(env_fns[::-1], **kwargs)

    for kind in (cases, rows):
        monkeypatch.setattr(kind, "vector", turned)
        several = [drawn for drawn in map(kind.case, range(10)) if len(drawn.env_fns) > 1]
        assert several
        assert any(kind.difference(drawn, CALLS) for drawn in several)


def test_one_process_for_those_that_share_is_found() -> None:
    several = [drawn for drawn in map(sharing.case, range(12)) if "sandbox" not in drawn.options]
    assert any(sharing.difference(drawn, CALLS, {"num_workers": 1}) for drawn in several)
