"""``python -m tests.browser.report``: ``docs/assets/report.webp``, the page of ``check --html``.

The bundled cartpole is checked, its page opened in Chromium, and the top of it kept as a picture.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tests.browser.chromium import Browser, program
from tests.support.documents.written import DOCS
from tests.support.samples import EXAMPLES

DOCUMENT = DOCS / "assets" / "report.webp"
MAX_BYTES = 150_000
_SIZE = (1000, 1150)


def main() -> None:
    """Check it, and take the picture."""
    from PIL import Image

    command = program()
    assert command is not None, "needs Chromium"
    with tempfile.TemporaryDirectory() as name, Browser(command) as browser:
        file, shot = Path(name, "report.html"), Path(name, "report.png")
        checked = [
            sys.executable,
            "-I",
            "-m",
            "envhub_sandbox",
            "check",
            str(EXAMPLES / "cartpole"),
        ]
        subprocess.run([*checked, "--html", str(file)], check=True, stdout=subprocess.DEVNULL)
        file.write_text(file.read_text().replace(str(EXAMPLES.parent), "~/envhub-sandbox"))
        with browser.page() as page:
            page.look(*_SIZE, dark=False)
            page.open(file.as_uri())
            page.shoot(shot)
        with Image.open(shot) as image:
            image.crop((0, 0, *_SIZE)).save(DOCUMENT, quality=80)
    assert DOCUMENT.stat().st_size < MAX_BYTES, DOCUMENT.stat().st_size
    print(f"{DOCUMENT}: {DOCUMENT.stat().st_size >> 10} KiB")


if __name__ == "__main__":
    main()
