"""Whether anything of a stranger's runs or loads on a page, and what would without our care.

Each page stands here three times: as it is; with nothing escaped, behind its own policy; and with
neither. The last is the control: there each text does what it is for, and until all of them have,
the others stay open.
"""

from __future__ import annotations

import base64
import contextlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from unittest import mock

from envhub_sandbox.check import markup
from tests.browser.chromium import Browser, Page
from tests.browser.hostile import unescaped, without_policy
from tests.browser.listener import Listener
from tests.browser.texts import ALONE, BEYOND_POLICIES, HOST, ODD, TOGETHER, written

# What a parser made of a page: its elements, and the names of what they have.
_SHAPE = """(pages => pages.map(html =>
  [...new DOMParser().parseFromString(html, "text/html").querySelectorAll("*")]
    .map(one => [one.localName, ...one.getAttributeNames()].join(" ")).join("\\n")))"""
_WORDS = """(pages => pages.map(html =>
  new DOMParser().parseFromString(html, "text/html").documentElement.textContent))"""
# As somebody does who tries everything. Where several lead elsewhere, the last one does: it is the
# first of the page, of which nothing has been cut off; and not one of ours, to another page.
_CLICK = """[...document.querySelectorAll(
  'a:not([href^="reports/"]), button, summary, text')].reverse().forEach(one =>
  one.dispatchEvent(new MouseEvent("click", {bubbles: true, cancelable: true})))"""
_WIDTHS = """[...document.querySelectorAll("img, video")].map(
  one => one.naturalWidth ?? one.videoWidth)"""
_ODD = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ufffd]")
_STILL = re.compile('src="data:image/png;base64,([^"]+)"')
_QUIET = "walk"


@dataclass(frozen=True)
class Kind:
    """A page that is written of a stranger's words.

    Attributes:
        name: Of it.
        pages: Those of hostile repositories, with the addresses of ``at("safe")``.
        twin: One of them with nothing escaped.
        of: Makes one in which every word is this one.
    """

    name: str
    pages: list[str]
    twin: str
    of: Callable[[str], str]

    def at(self, which: str) -> str:
        """By what the addresses of its texts are known."""
        return f"{self.name}-{which}"

    def moved(self, content: str, which: str) -> str:
        """A page that asks for addresses of its own."""
        return content.replace(self.at("safe"), self.at(which))


@dataclass
class Attempts:
    """All of them, in one browser.

    Attributes:
        browser: That opens the pages.
        listener: That is told of it.
        idle: Texts that this browser does nothing with, whatever they stand in.
        wrong: What is not as it has to be.
    """

    browser: Browser
    listener: Listener
    idle: frozenset[str] = frozenset()
    wrong: list[str] = field(default_factory=list)

    def on(self, kind: Kind) -> None:
        """Open the pages of a kind, its twin, and what must not be alone."""
        self._shapes(kind)
        self._characters(kind)
        with contextlib.ExitStack() as opened:
            safe = [self._opened(opened, kind, "safe", one) for one in kind.pages]
            self._opened(opened, kind, "guarded", kind.moved(kind.twin, "guarded"))
            self._opened(opened, kind, "bare", without_policy(kind.moved(kind.twin, "bare")))
            self._awaited(kind, set(TOGETHER))
            for name, text in ALONE.items():
                self._alone(kind, name, text)
            for one in safe:
                one.ask(_CLICK)
            self._settled(kind)
        self._judged(kind)

    def _opened(self, opened: contextlib.ExitStack, kind: Kind, which: str, content: str) -> Page:
        page = opened.enter_context(self.browser.page())
        page.open(self.listener.serve(f"{kind.at(which)}-{len(content)}", _bytes(content)))
        return page

    def _alone(self, kind: Kind, name: str, text: str) -> None:
        [said] = written(self.listener.root, kind.at("safe"), {name: text})
        with unescaped():
            content = kind.of(said)
        with contextlib.ExitStack() as opened:
            for which, one in (("guarded", content), ("bare", without_policy(content))):
                page = self._opened(opened, kind, which, kind.moved(one, which))
                with contextlib.suppress(RuntimeError):  # it has led away already
                    page.ask(_CLICK)
            self._awaited(kind, {name})

    def _awaited(self, kind: Kind, names: set[str]) -> None:
        wanted = names - self.idle
        with contextlib.suppress(TimeoutError):  # it is told when all is judged
            self.browser.until(lambda: wanted <= self._asked(kind, "bare"), kind.name)

    def _settled(self, kind: Kind) -> None:
        """What a click has started has begun before what is started now has come."""
        address = f"{self.listener.root}/{kind.at('after')}/image"
        with self.browser.page() as page:
            page.open(self.listener.serve("after", b"<img src='" + address.encode() + b"'>"))
            self.browser.until(
                lambda: "image" in self.listener.asked_by(kind.at("after")), "an image"
            )

    def _judged(self, kind: Kind) -> None:
        did = {which: self._asked(kind, which) for which in ("safe", "guarded", "bare")}
        for which, asked in did.items():
            print(f"{kind.name}, {which}: {', '.join(sorted(asked)) or 'nothing'}", flush=True)
        self._expect(not did["safe"], f"{kind.name}: did {did['safe']}")
        past = did["guarded"] - BEYOND_POLICIES
        self._expect(not past, f"{kind.name}: its policy alone lets {past}")
        missing = {*TOGETHER, *ALONE} - did["bare"] - self.idle
        self._expect(not missing, f"{kind.name}: the control has not done {missing}")

    def _asked(self, kind: Kind, which: str) -> set[str]:
        at = kind.at(which)
        resolved = {"resolved"} if self.browser.looked_up(HOST.replace("AT", at)) else set()
        return self.listener.asked_by(at) | resolved

    def _shapes(self, kind: Kind) -> None:
        """To Chromium's parser a page has the elements of ours, whatever a stranger's words are."""
        texts = written(self.listener.root, kind.at("safe"), {**TOGETHER, **ALONE})
        contents = [kind.of(text) for text in (_QUIET, ODD, *texts)]
        with unescaped():
            contents += map(kind.of, texts)
        one, *others = self._parsed(_SHAPE, contents)
        same = [other == one for other in others]
        count = len(texts) + 1
        self._expect(all(same[:count]), f"{kind.name}: a text is markup: {same[:count]}")
        self._expect(not any(same[count:]), f"{kind.name}: the control is none: {same[count:]}")

    def _characters(self, kind: Kind) -> None:
        """No word has characters that do something else than to be read."""
        contents = [*kind.pages, kind.of(ODD)]
        with mock.patch.object(markup, "printable", lambda text, limit: text):
            contents.append(kind.of(ODD))
        *found, control = (sorted({*_ODD.findall(one)}) for one in self._parsed(_WORDS, contents))
        self._expect(not any(found), f"{kind.name}: shows {found}")
        self._expect(len(control) > 3, f"{kind.name}: the control shows but {control}")

    def _parsed(self, how: str, contents: list[str]) -> list[str]:
        with self.browser.page() as page:
            told: list[str] = page.ask(f"{how}({json.dumps(contents)})")
        return told

    def on_pictures(self, content: str, raw: bytes) -> None:
        """A page's pictures are no markup, were they taken for it; their pixels are.

        Args:
            content: A page of pictures whose pixels are the text ``script``.
            raw: These pixels.
        """
        stills = [base64.b64decode(one) for one in _STILL.findall(content)]
        named = raw.replace(b"report-safe", b"pixels-bare")
        with self.browser.page() as safe, self.browser.page() as bare:
            for number, still in enumerate(stills):
                safe.open(self.listener.serve(f"still-{number}", still))
            bare.open(self.listener.serve("pixels", named))
            with contextlib.suppress(TimeoutError):
                self.browser.until(lambda: self._of_pixels() == {"script"}, "pixels")
        done = self.listener.asked_by("report-safe")
        print(f"{len(stills)} pictures, taken for pages: {', '.join(done) or 'nothing'}")
        self._expect(bool(stills) and not done, f"pictures, taken for pages: {done}")
        self._expect(bool(self._of_pixels()), "the control of the pictures has done nothing")

    def on_honest(self, content: str) -> None:
        """Pictures and films of a page are shown: the policy is not too strict."""
        with self.browser.page() as page:
            page.open(self.listener.serve("honest", _bytes(content)))
            with contextlib.suppress(TimeoutError):
                self.browser.until(lambda: all(page.ask(_WIDTHS)), "pictures")
            widths = page.ask(_WIDTHS)
        print(f"widths of the pictures of the honest page: {widths}", flush=True)
        self._expect(len(widths) > 3 and all(widths), f"pictures are not shown: {widths}")

    def _of_pixels(self) -> set[str]:
        return self.listener.asked_by("pixels-bare")

    def _expect(self, holds: bool, words: str) -> None:
        if not holds:
            self.wrong.append(words)


def _bytes(content: str) -> bytes:
    return content.encode("utf-8", "replace")
