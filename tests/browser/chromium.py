"""Chromium without a screen, driven through two pipes: one process for all pages."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.support.processes import eventually

NAMES = ("chromium-headless-shell", "chromium")
"""Of Debian's packages, and of their programs; the first one is the smaller."""
_DEADLINE_S = 60.0
_OPTIONS = (
    "--headless",
    "--disable-gpu",
    "--disable-breakpad",
    "--disable-background-networking",
    "--hide-scrollbars",
    "--mute-audio",
    "--no-first-run",
    "--autoplay-policy=no-user-gesture-required",
    "--remote-debugging-pipe",
)
# The browser reads from its descriptor 3 and writes to 4.
_AS_3_AND_4 = 'exec "${@:3}" 3<&"$1" 4>&"$2"'


def program() -> str | None:
    """The browser of this machine."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser with a profile of its own; a context, after which nothing of it is left.

    Args:
        command: What is run.
    """

    def __init__(self, command: str) -> None:
        self._profile = tempfile.mkdtemp(prefix="envhub-browser-")
        confined = ("--no-sandbox",) if os.geteuid() == 0 else ()  # which Chromium asks of root
        self._log = Path(self._profile, "net.json")
        noted = (f"--user-data-dir={self._profile}", f"--log-net-log={self._log}")
        own = (*_OPTIONS, *confined, *noted)
        its_input, self._to = map(_beyond_4, os.pipe())
        self._from, its_output = map(_beyond_4, os.pipe())
        # fmt: off
        self._process = subprocess.Popen(
            ["bash", "-c", _AS_3_AND_4, "bash", str(its_input), str(its_output), command, *own],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            pass_fds=(its_input, its_output), start_new_session=True,
            env={**os.environ, "HOME": self._profile},
        )
        # fmt: on
        os.close(its_input)
        os.close(its_output)
        self._unread, self._calls = b"", 0
        self._answers: dict[int, dict[str, Any]] = {}
        self._events: list[dict[str, Any]] = []

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
        eventually(self._is_gone)  # what it had started may write there until it has ended, too

    def _is_gone(self) -> bool:
        shutil.rmtree(self._profile, ignore_errors=True)
        return not os.path.exists(self._profile)

    def call(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        """Ask for something, and wait for the answer.

        Raises:
            RuntimeError: It was refused.
        """
        self._calls += 1
        number = self._calls
        asked: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        text = json.dumps({**asked, "sessionId": session} if session else asked)
        os.write(self._to, text.encode() + b"\0")
        self.until(lambda: number in self._answers, method)
        answer = self._answers.pop(number)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        result: dict[str, Any] = answer["result"]
        return result

    def looked_up(self, host: str) -> bool:
        """Whether it has asked for the address of a host, as its log of the network says."""
        return self._log.exists() and host.encode() in self._log.read_bytes()

    def events(self, session: str) -> list[dict[str, Any]]:
        """What has happened in a page so far."""
        return [one for one in self._events if one.get("sessionId") == session]

    def forget(self, session: str) -> None:
        """Let there be no events of a page."""
        self._events = [one for one in self._events if one.get("sessionId") != session]

    def until(self, claim: Callable[[], bool], what: str) -> None:
        """Hear what the browser says until a claim holds.

        Raises:
            TimeoutError: It does not come true.
            EOFError: The browser has ended.
        """
        end = time.monotonic() + _DEADLINE_S
        while not claim():
            if time.monotonic() > end:
                raise TimeoutError(f"{what}: not within {_DEADLINE_S:g} s")
            self._hear(0.05)

    def _hear(self, seconds: float) -> None:
        if not select.select([self._from], [], [], seconds)[0]:
            return
        some = os.read(self._from, 1 << 20)
        if not some:
            raise EOFError(f"the browser has ended: {self._process.wait()}")
        *whole, self._unread = (self._unread + some).split(b"\0")
        for message in map(json.loads, whole):
            if "id" in message:
                self._answers[message["id"]] = message
            else:
                self._events.append(message)

    @contextlib.contextmanager
    def page(self, *, fresh: bool = False) -> Iterator[Page]:
        """A page of its own, closed afterwards; ``fresh``: of somebody who was nowhere yet."""
        where: dict[str, Any] = self.call("Target.createBrowserContext") if fresh else {}
        target = self.call("Target.createTarget", url="about:blank", **where)["targetId"]
        told = self.call("Target.attachToTarget", targetId=target, flatten=True)
        page = Page(self, told["sessionId"])
        try:
            yield page
        finally:
            self.forget(told["sessionId"])
            self.call("Target.closeTarget", targetId=target)
            if fresh:
                self.call("Target.disposeBrowserContext", **where)


class Page:
    """One page of a browser.

    Args:
        browser: It.
        session: The browser's name of it.
    """

    def __init__(self, browser: Browser, session: str) -> None:
        self.browser, self._session = browser, session
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask something of this page."""
        return self.browser.call(method, self._session, **parameters)

    def events(self, *methods: str) -> list[dict[str, Any]]:
        """What has happened of these kinds since it was opened."""
        every = self.browser.events(self._session)
        return [one["params"] for one in every if one["method"] in methods]

    def open(self, address: str) -> None:
        """Go there, and wait until all that it loads is there or is not, or it leads elsewhere."""
        self.browser.forget(self._session)
        loader = self.call("Page.navigate", url=address)["loaderId"]

        def is_there() -> bool:
            loaded = ("load", loader)
            seen = self.events("Page.lifecycleEvent")
            led = (one["frame"] for one in self.events("Page.frameNavigated"))
            return any((one["name"], one["loaderId"]) == loaded for one in seen) or any(
                "parentId" not in frame and frame["loaderId"] != loader for frame in led
            )

        self.browser.until(is_there, f"to load {address}")

    def ask(self, script: str) -> Any:
        """What an expression is, awaited."""
        told = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in told:
            raise RuntimeError(f"{script}: {told['exceptionDetails']}")
        return told["result"].get("value")

    def look(self, width: int, height: int, *, dark: bool) -> None:
        """Be a screen of that size, of somebody who prefers that scheme."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def shoot(self, file: Path) -> None:
        """Take a picture of what is on the screen."""
        told = self.call("Page.captureScreenshot", format="png")
        file.write_bytes(base64.b64decode(told["data"]))


def _beyond_4(descriptor: int) -> int:
    """The same file, by a number that is in the way of neither 3 nor 4."""
    number = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 10)
    os.close(descriptor)
    return number
