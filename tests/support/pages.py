"""A page as a browser takes it."""

from __future__ import annotations

from html.parser import HTMLParser


class Page(HTMLParser):
    """Its tags with their attributes, and its text.

    Attributes:
        tags: In their order.
        text: What stands between them.
    """

    def __init__(self, source: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, tuple[tuple[str, str | None], ...]]] = []
        self.text = ""
        self.feed(source)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """As the parser calls it."""
        self.tags.append((tag, tuple(attrs)))

    def handle_data(self, data: str) -> None:
        """As the parser calls it."""
        self.text += data

    def handle_comment(self, data: str) -> None:
        """As the parser calls it."""
        self.tags.append(("!", ((data, None),)))

    @property
    def names(self) -> set[str]:
        """Which tags there are."""
        return {name for name, _ in self.tags}
