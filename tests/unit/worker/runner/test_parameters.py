"""What a stranger's function takes is known without calling it."""

from __future__ import annotations

from envhub_worker.runner.parameters import names, parameters_of, takes


def test_a_keyword_is_taken_by_name_or_by_all() -> None:
    """One that can be given in order alone is none."""

    def function(seed: int, /, size: int, *rest: int, flag: bool = False) -> None: ...

    def anything(**options: object) -> None: ...

    known, open_ended = parameters_of(function), parameters_of(anything)
    assert known is not None
    assert open_ended is not None
    assert [one for one in ("seed", "size", "flag", "other") if takes(known, one)] == [
        *("size", "flag")
    ]
    assert takes(open_ended, "other")
    assert not names(open_ended, "other")


def test_what_has_no_signature_has_no_parameters() -> None:
    """What is no function at all."""
    assert parameters_of(3) is None  # type: ignore[arg-type]
