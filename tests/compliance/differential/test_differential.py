"""A bounded number of random cases; the command beside it runs as many as one likes."""

from __future__ import annotations

from typing import Any

import pytest

from tests.compliance.differential import cases
from tests.compliance.theirs.through_sandbox import vector

CALLS = 12
EACH = 20


@pytest.mark.short("0")
@pytest.mark.parametrize("first", range(0, 3 * EACH, EACH))
def test_random_cases_do_not_differ(first: int) -> None:
    """Whatever is drawn and called, the sandbox gives what ``SyncVectorEnv`` gives."""
    for number in range(first, first + EACH):
        drawn = cases.case(number)
        found = cases.difference(drawn, CALLS)
        assert found is None, f"{drawn}: {found}"


def test_what_differs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def turned(env_fns: Any, **kwargs: Any) -> Any:
        return vector(env_fns[::-1], **kwargs)

    monkeypatch.setattr(cases, "vector", turned)
    several = [drawn for drawn in map(cases.case, range(10)) if len(drawn.env_fns) > 1]
    assert several
    assert any(cases.difference(drawn, CALLS) for drawn in several)
