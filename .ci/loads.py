"""What the pages of a built site would load from elsewhere: fails if there is any.

    python .ci/loads.py FOLDER

Links that a reader follows may lead anywhere. Whatever a browser fetches by itself has to lie on
the site: of the tags, of the style sheets, and every address that stands in a script by itself.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

_LOADING = {"src", "srcset", "poster", "data", "background", "action", "formaction", "ping"}
_CSS = re.compile(r"(?:@import\s*|url\(\s*)[\"']?\s*((?:https?:)?//[^\"')\s;]*)", re.I)
_SCRIPT = re.compile(r"[\"'`]((?:https?|wss?)://[^\"'`\s]+)")
# In scripts: the names of XML's vocabularies, which nobody fetches; what Material asks for the
# figures of a repository that `repo_url` names, which mkdocs.yml does not have, and each page's own
# policy forbids; and a hint that it writes on the console.
_NEVER_LOADED = (
    "http://www.w3.org/",
    "https://api.github.com/",
    "https://${e}/api/v4/projects/",
    "https://unpkg.com/resize-observer-polyfill",
)


class _Page(HTMLParser):
    """Collects what a page loads, and whether it has a policy that forbids the rest."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.confined = False
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at the attributes that make a browser fetch something."""
        self._inside = tag
        given = {name: value or "" for name, value in attrs}
        if given.get("http-equiv", "").lower() == "content-security-policy":
            self.confined = "default-src 'self'" in given.get("content", "")
        loading = [given[name] for name in _LOADING & given.keys()]
        if tag == "link" and given.get("rel") != "canonical":
            loading.append(given.get("href", ""))
        self.found += [one for one in loading if _is_foreign(one)]
        self.found += _CSS.findall(given.get("style", ""))

    def handle_endtag(self, tag: str) -> None:
        """Whatever follows is text."""
        self._inside = ""

    def handle_data(self, data: str) -> None:
        """Styles and scripts in the page itself."""
        if self._inside == "style":
            self.found += _CSS.findall(data)
        if self._inside == "script":
            self.found += in_script(data)


def _is_foreign(address: str) -> bool:
    return any(re.match(r"(?:[a-z][a-z+.-]*:)?//", one.strip(), re.I) for one in address.split(","))


def in_script(text: str) -> list[str]:
    """The addresses in a script that it might fetch."""
    return [one for one in _SCRIPT.findall(text) if not one.startswith(_NEVER_LOADED)]


def foreign(site: Path) -> Iterator[str]:
    """A line for each thing that a page of the site would get from elsewhere."""
    for path in sorted(site.rglob("*")):
        name, text = path.relative_to(site), ""
        if path.suffix in (".html", ".css", ".js", ".svg"):
            text = path.read_text(errors="replace")
        found = in_script(text) if path.suffix == ".js" else []
        if path.suffix == ".css":
            found = _CSS.findall(text)
        if path.suffix in (".html", ".svg"):
            page = _Page()
            page.feed(text)
            found = page.found
            if path.suffix == ".html" and not page.confined:
                yield f"{name}: lets the browser load from elsewhere"
        yield from (f"{name}: loads {one}" for one in found)


if __name__ == "__main__":
    lines = list(foreign(Path(sys.argv[1])))
    print("\n".join(lines) or "no page loads anything from elsewhere")
    sys.exit(bool(lines))
