"""What has to lie outside of what is judged."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from envhub_sandbox.cli.shared.exits import UsageError


def refuse_the_judged(places: Mapping[str, Path | None], reference: str, where: str = "") -> None:
    """No repository says how it is judged, and none holds what is found in it.

    Args:
        places: By the options that name them.
        reference: What is judged.
        where: Where that stands, for the error.

    Raises:
        UsageError: One lies in it.
    """
    from envhub_sandbox.check.settings import is_judged

    for option, path in places.items():
        if path is not None and is_judged(path, reference):
            raise UsageError(
                f"{option} {path} lies in what is judged, {reference}{where}, and no repository "
                "has a say in that: take a place outside"
            )
