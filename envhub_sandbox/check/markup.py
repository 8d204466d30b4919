"""What pages for people are made of: text that is no markup, tables, one file that runs nothing.

Whatever a stranger may have said goes through ``text``, which leaves no character that HTML gives a
meaning to. The page's own policy forbids scripts, and everything that would come from elsewhere.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Iterator

from envhub_worker.protocol.text import printable

_LONGEST = 1_000
_MOST_ROWS = 2_000
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
_STYLE = """
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem }
h1 { font-size: 1.4rem; overflow-wrap: anywhere }
h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse; width: 100% }
th, td { border-bottom: 1px solid #8884; overflow-wrap: anywhere; padding: .3rem .6rem .3rem 0;
  text-align: left; vertical-align: top }
.error { color: #c22 } .warning { color: #a60 } .note { color: #777 } .passed { color: #182 }
.cure { color: #777; display: block }
""".strip()


def document(title: str, body: Iterable[str]) -> str:
    """A whole page of what is HTML already, in one file that needs no other.

    Args:
        title: May be a stranger's.
        body: HTML of ours.
    """
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="referrer" content="no-referrer">',
            f"<title>{text(title)}</title>",
            f"<style>\n{_STYLE}\n</style>\n</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def text(value: object) -> str:
    """Text, and nothing but text: in a page as in an attribute of it."""
    return html.escape(printable(str(value), _LONGEST), quote=True)


def table(heads: Iterable[str], rows: Collection[tuple[str, ...]]) -> Iterator[str]:
    """A table of cells that are HTML already, as many rows as a browser bears."""
    yield "<table>\n<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"
    for row in list(rows)[:_MOST_ROWS]:
        yield "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>"
    yield "</table>"
    if len(rows) > _MOST_ROWS:
        yield f"<p>{len(rows) - _MOST_ROWS} more are left out.</p>"
