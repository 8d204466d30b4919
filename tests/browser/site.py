"""The documents as a site: every page is opened, as people with other screens see it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from tests.browser import shots
from tests.browser.chromium import Browser, Page
from tests.browser.listener import serving

_DIAGRAMS = 'class="mermaid"'
_DRAWN = """[...document.querySelectorAll("div.mermaid")].filter(
  one => one.offsetHeight > 20 && one.offsetWidth > 20).length"""
_SCHEMES = ("default", "slate")
"""The site's names of light and dark; one for each size of a screen."""
_SCHEME = "document.body.dataset.mdColorScheme"
_BEYOND = "document.documentElement.scrollWidth - window.innerWidth"


def look(browser: Browser, folder: Path, pictures: Path | None) -> list[str]:
    """What is wrong with the pages of a built site.

    Args:
        browser: Which opens them.
        folder: The site's.
        pictures: Where pictures are left, if they are wanted.
    """
    wrong: list[str] = []
    files = sorted(folder.rglob("*.html"))
    with serving(folder) as root:
        for (size, (width, height)), scheme in zip(shots.SIZES.items(), _SCHEMES, strict=True):
            with browser.page(fresh=True) as page:  # a site remembers which scheme was chosen
                page.look(width, height, dark=scheme == "slate")
                for file in files:
                    name = file.relative_to(folder).as_posix()
                    page.open(f"{root}/{name}")
                    found = _amiss(page, file.read_text().count(_DIAGRAMS), scheme)
                    wrong += [f"site, {name}, {size}: {one}" for one in found]
    print(f"site: {len(files)} pages, each wide and light, narrow and dark", flush=True)
    if pictures is not None:
        with serving(folder) as root:
            for name in ("index.html", "quickstart/index.html", "architecture/index.html"):
                shots.of_page(browser, f"site-{name.partition('/')[0]}", f"{root}/{name}", pictures)
    return wrong if files else [f"site: no pages in {folder}"]


def _amiss(page: Page, diagrams: int, scheme: str) -> Iterator[str]:
    with contextlib.suppress(TimeoutError):
        page.browser.until(lambda: page.ask(_DRAWN) == diagrams, "diagrams")
    drawn = page.ask(_DRAWN)
    if drawn != diagrams:
        yield f"{drawn} of {diagrams} diagrams are drawn"
    if (shown := page.ask(_SCHEME)) != scheme:
        yield f"its scheme is {shown}, and not {scheme}"
    if (beyond := page.ask(_BEYOND)) > 0:
        yield f"{beyond} pixels wider than the screen"
    for one in page.events("Runtime.exceptionThrown"):
        yield f"raises {one['exceptionDetails'].get('text')}"
    for one in page.events("Log.entryAdded"):
        if one["entry"]["level"] == "error":
            yield f"logs {one['entry']['text']} {one['entry'].get('url', '')}"
    for one in page.events("Network.responseReceived"):
        if one["response"]["status"] >= 400:
            yield f"is answered {one['response']['status']} by {one['response']['url']}"
