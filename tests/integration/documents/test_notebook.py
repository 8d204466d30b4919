"""The notebook of the examples runs from its first cell to its last, and shows what it shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.command_line import python
from tests.support.documents.notebook import DOCUMENT

_EXECUTE = "import json; from tests.support.documents.notebook import executed; "
_EXECUTE += "print(json.dumps(executed()))"


def shown(notebook: dict[str, Any]) -> list[list[str]]:
    """For each cell of code the kinds of what it displays."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [
        [kind for one in cell["outputs"] for kind in one.get("data", {"stdout": ""})]
        for cell in cells
    ]


def rewards(notebook: dict[str, Any]) -> list[str]:
    """The lines that it prints of them."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    lines = [line for cell in cells for one in cell["outputs"] for line in one.get("text", ())]
    return [line for line in lines if line.startswith("rewards of 20 steps: [")]


def test_the_notebook_shows_what_it_shows(checkout: Path, tmp_path: Path) -> None:
    """Tables of suites and environment, and a picture; the rewards are the same ones."""
    pytest.importorskip("PIL")
    done = python(
        "-c", _EXECUTE, cwd=checkout, ENVHUB_CACHE=str(tmp_path), IPYTHONDIR=str(tmp_path)
    )
    now, then = json.loads(done.stdout.splitlines()[-1]), json.loads(DOCUMENT.read_text())
    assert shown(now) == shown(then)
    assert {"text/html", "image/png", "stdout"} <= {one for kinds in shown(now) for one in kinds}
    assert rewards(now) == rewards(then) != []
