"""What a repository's card declares: the ``envhub:`` mapping in the YAML in front of README.md.

::

    ---
    envhub:
      assets:
        - org/weights@0123456789abcdef0123456789abcdef01234567
        - datasets/org/scenes@89abcdef0123456789abcdef0123456789abcdef
    ---

The card is a stranger's: it is read up to ``_MAX_BYTES`` as a tree of nodes, of which nothing is
constructed, and anchors and merges are not followed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from envhub_sandbox.settings.options import MAX_ASSETS

CARD = "README.md"
_MAX_BYTES = 64 * 1024
_MAX_CHARS = 500
_FRONT = re.compile(r"\A\ufeff?---[ \t]*\r?\n(.*?)^---[ \t]*\r?$", re.DOTALL | re.MULTILINE)


class CardError(ValueError):
    """The card declares something that cannot be read; its text says what."""


def declared_assets(root: Path) -> list[str]:
    """The repositories that a card declares as assets, as it writes them; not yet judged.

    Raises:
        CardError: ``envhub`` or its ``assets`` is something else, or they are too many.
    """
    try:
        with (root / CARD).open("rb") as file:
            text = file.read(_MAX_BYTES).decode("utf-8", "replace")
    except OSError:
        return []
    front = _FRONT.match(text)
    if front is None or "envhub" not in front[1]:
        return []
    ours = _value(_tree(front[1]), "envhub")
    if ours is None:
        return []
    assets = _value(ours, "assets")
    rows = getattr(assets, "value", None)
    if assets is None or assets.id != "sequence" or not isinstance(rows, list):
        raise CardError("'envhub' in its YAML takes 'assets', a list of repositories")
    if len(rows) > MAX_ASSETS:
        raise CardError(f"it declares {len(rows)} assets, and at most {MAX_ASSETS} are taken")
    if any(row.id != "scalar" for row in rows):
        raise CardError("each of its assets is a text, as in 'org/data@COMMIT'")
    if any(len(row.value) > _MAX_CHARS for row in rows):
        raise CardError(f"one of its assets has more than {_MAX_CHARS} characters")
    return [str(row.value) for row in rows]


def _tree(text: str) -> Any:
    import yaml  # type: ignore[import-untyped]  # comes with huggingface_hub

    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, ArithmeticError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 2}" if mark else ""  # the first line is the ---
        raise CardError(f"its YAML cannot be read: {type(error).__name__}{where}") from None


def _value(node: Any, key: str) -> Any:
    """What a mapping has under a key; None where it is no mapping or has no such key."""
    if getattr(node, "id", "") != "mapping":
        return None
    return next((value for name, value in node.value if name.value == key), None)
