"""``python -m tests.browser``: in Chromium, nothing of a hostile repository's runs or loads.

Repositories that wrote markup wherever they may write are judged, the pages of ``check --html``
and ``check --all`` are opened in headless Chromium, and a server on loopback is told of whatever
runs or loads there: nothing. Each page with nothing escaped is the control.

    python -m tests.browser                     the pages of check
    python -m tests.browser --site FOLDER       and every page of a site that was built there
    python -m tests.browser --shots FOLDER      and leaves pictures there: light, dark, wide, narrow

Needs ``chromium-headless-shell`` or ``chromium`` (``apt-get install``), which is why it is no test
of ``./test``; CI has a step for it.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from pathlib import Path

import numpy as np

from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.many import index
from envhub_sandbox.check.page import page
from tests.browser import shots, site
from tests.browser.attempts import Attempts, Kind
from tests.browser.chromium import NAMES, Browser, program
from tests.browser.hostile import SHAPE, declares, judged, unescaped, walks
from tests.browser.listener import Listener
from tests.browser.texts import ALONE, IDLE, TOGETHER, written
from tests.support.output.pages import report_of, results_of
from tests.support.samples import EXAMPLES


def main() -> int:
    """Open the pages, and say what they did; 0 if that is what they should have done."""
    parser = argparse.ArgumentParser(prog="python -m tests.browser")
    parser.add_argument("--shots", type=Path, metavar="FOLDER", help="leave pictures there")
    parser.add_argument("--site", type=Path, metavar="FOLDER", help="open its pages, too")
    asked = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # nothing is left of it
    command = program()
    if command is None:
        print(f"needs one of {', '.join(NAMES)}: apt-get install it", file=sys.stderr)
        return 2
    with Browser(command) as browser:
        product = browser.call("Browser.getVersion")["product"]
        idle = IDLE if product.startswith("HeadlessChrome") else frozenset()
        print(f"{product}; does not know: {', '.join(sorted(idle)) or 'nothing'}", flush=True)
        wrong = _pages(browser, idle, asked.shots)
        if asked.site is not None:
            wrong += site.look(browser, asked.site, asked.shots)
    print("\n".join(f"WRONG: {one}" for one in wrong) or "all as it has to be")
    return 1 if wrong else 0


def _pages(browser: Browser, idle: frozenset[str], pictures: Path | None) -> list[str]:
    listener = Listener()
    attempts = Attempts(browser, listener, idle)
    try:
        with tempfile.TemporaryDirectory(prefix="envhub-pages-") as folder:
            report = _reports(Path(folder), listener.root)
            every = _indexes(listener.root)
            attempts.on(report)
            attempts.on(every)
            [text] = written(listener.root, report.at("safe"), {"script": TOGETHER["script"]})
            size = int(np.prod(SHAPE))
            attempts.on_pictures(report.pages[0], (text * size).encode()[:size])
            honest = page(judged(EXAMPLES / "cartpole", steps=30, pictures=True), [])
            attempts.on_honest(honest)
            if pictures is not None:
                told = {"honest": honest, "hostile": report.pages[0], "index": every.pages[0]}
                shots.of_pages(browser, told, pictures)
    finally:
        listener.close()
    return attempts.wrong


def _reports(folder: Path, root: str) -> Kind:
    texts = written(root, "report-safe", {**TOGETHER, **ALONE})
    made = [walks(folder / "walks", texts), declares(folder / "declares", texts)]
    failures = [one.failures(Severity.WARNING) for one in made]
    pages = [page(*one) for one in zip(made, failures, strict=True)]
    with unescaped():
        twin = page(made[0], failures[0])

    def of(text: str) -> str:
        report = report_of(text)
        return page(report, report.findings)

    return Kind("report", pages, twin, of)


def _indexes(root: str) -> Kind:
    texts = written(root, "index-safe", {**TOGETHER, **ALONE})
    results = [one for text in texts for one in results_of(text)]
    with unescaped():
        twin = index.page([one for text in texts for one in results_of(text)])
    return Kind("index", [index.page(results)], twin, lambda text: index.page(results_of(text)))


if __name__ == "__main__":
    sys.exit(main())
