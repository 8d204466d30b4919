"""``examples/quickstart.ipynb``: its cells are executed here, and shown with what they display.
``python -m tests.support.documents.notebook`` executes them and writes what they display into it.
"""

import base64
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from tests.support.documents.blocks import CHECKOUT

DOCUMENT = CHECKOUT / "examples" / "quickstart.ipynb"


def executed() -> dict[str, Any]:
    """The notebook with the outputs of an execution in this process, which IPython then owns."""
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output
    from traitlets.config import Config

    notebook: dict[str, Any] = json.loads(DOCUMENT.read_text())
    shell = InteractiveShell.instance(config=Config({"HistoryManager": {"enabled": False}}))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, 1):
        with capture_output() as captured:
            shell.run_cell("".join(cell["source"]), silent=False).raise_error()
        cell["execution_count"] = number
        cell["outputs"] = [*_streams(captured.stdout), *map(_displayed, captured.outputs)]
    return notebook


def _streams(text: str) -> list[dict[str, Any]]:
    lines = _named(text).splitlines(keepends=True)
    return [{"name": "stdout", "output_type": "stream", "text": lines}] if lines else []


def _displayed(output: Any) -> dict[str, Any]:
    data = {
        kind: base64.b64encode(value).decode() if isinstance(value, bytes) else _named(value)
        for kind, value in output.data.items()
        if kind != "image/jpeg"  # the same as the PNG
    }
    return {"data": data, "metadata": {}, "output_type": "display_data"}


def _named(text: str) -> str:
    return text.replace(f"{CHECKOUT}/", "")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["IPYTHONDIR"] = folder
        notebook = executed()
    DOCUMENT.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")
    print(f"{DOCUMENT}: {Path(DOCUMENT).stat().st_size >> 10} KiB")


if __name__ == "__main__":
    main()
