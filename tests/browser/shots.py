"""Pictures of pages, as people with other screens see them: to be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tests.browser.chromium import Browser

SIZES = {"wide": (1300, 1600), "narrow": (390, 2400)}


def of_pages(browser: Browser, contents: Mapping[str, str], folder: Path) -> None:
    """Take four of each page, and say where they are.

    Args:
        browser: Which shows them.
        contents: By name.
        folder: It is made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        file = (folder / f"{name}.html").absolute()
        file.write_text(content, encoding="utf-8", errors="replace")
        of_page(browser, name, file.as_uri(), folder)


def of_page(browser: Browser, name: str, address: str, folder: Path) -> None:
    """Take four of one page, with no margin of its own left out."""
    for size, (width, height) in SIZES.items():
        for look, dark in (("light", False), ("dark", True)):
            with browser.page(fresh=True) as page:  # a site remembers which scheme was chosen
                page.look(width, height, dark=dark)
                page.open(address)
                target = folder / f"{name}-{size}-{look}.png"
                page.shoot(target)
                print(target, flush=True)
