"""The parts of ``docs/`` that are written from the code: each stands between two comments."""

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[3] / "docs"


def filled(document: Path, **parts: str) -> str:
    """The document with these texts between ``<!-- NAME -->`` and ``<!-- /NAME -->``."""
    text = document.read_text()
    for name, lines in parts.items():
        place = re.compile(rf"(?<=^<!-- {name} -->\n).*(?=^<!-- /{name} -->$)", re.M | re.S)
        if len(place.findall(text)) != 1:
            raise ValueError(f"{document.name} needs one place for {name}")
        text = place.sub(lambda _: f"\n{lines.strip()}\n\n", text)  # noqa: B023
    return text
