"""What pages for people are made of: text that is no markup, tables, one file that runs nothing.

Whatever a stranger may have said goes through ``text``, which leaves no character that HTML gives a
meaning to. The page's own policy forbids scripts, and everything that would come from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Collection, Iterable, Iterator

from envhub_worker.protocol.text import printable

_LONGEST = 1_000
_MOST_ROWS = 2_000
_STYLE = """
:root { color-scheme: light dark; --ground: #f6f5f2; --sheet: #fff; --ink: #1c2024; --dim: #62676e;
  --rule: #1c202420; --bar: #3b6fd4; --area: #3b6fd426; --mark: #b4552d;
  --error: #b3261e; --warning: #8a5a00; --note: #5b6168; --passed: #1b6e3c }
@media (prefers-color-scheme: dark) { :root { --ground: #14161a; --sheet: #1d2026; --ink: #e6e6e3;
  --dim: #9aa0a8; --rule: #e6e6e326; --bar: #7da7f5; --area: #7da7f530; --mark: #f0a37c;
  --error: #ff8a80; --warning: #f2c14e; --note: #a8aeb6; --passed: #7fd49b } }
* { box-sizing: border-box }
body { background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
  margin: 0 auto; max-width: 72rem; padding: 1.5rem clamp(.75rem, 3vw, 2rem) 3rem }
h1, h2, h3, p, td, th, dd, li, summary { overflow-wrap: anywhere }
h1 { font-size: 1.35rem; line-height: 1.3; margin: .4rem 0 }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .7rem }
h3 { font-size: .95rem; margin: 0 0 .4rem }
p { margin: .4rem 0 }
code, .mono { font-family: ui-monospace, monospace; font-size: .88em }
.sheet { background: var(--sheet); border: 1px solid var(--rule); border-radius: .6rem;
  margin: .8rem 0; padding: .9rem 1.1rem }
.badge { border: 1px solid; border-radius: 9rem; display: inline-block; font-size: .8rem;
  font-weight: 600; padding: .05rem .7rem; white-space: nowrap }
.error { color: var(--error) } .warning { color: var(--warning) }
.note { color: var(--note) } .passed { color: var(--passed) }
.dim, .cure { color: var(--dim) } .cure { display: block }
.wide { overflow-x: auto }
table { border-collapse: collapse; width: 100% }
th, td { border-bottom: 1px solid var(--rule); padding: .35rem .9rem .35rem 0; text-align: left;
  vertical-align: top }
th { color: var(--dim); font-size: .85rem; font-weight: 600; white-space: nowrap }
.whole { white-space: nowrap }
tr:last-child td { border-bottom: 0 }
.findings { list-style: none; margin: 0; padding: 0 }
.findings li { border-left: .25rem solid; margin: .7rem 0; padding: .1rem 0 .1rem .8rem }
.findings p { color: var(--ink); white-space: pre-line }
dl { display: grid; gap: .1rem 1.2rem; grid-template-columns: max-content 1fr; margin: .5rem 0 }
dt { color: var(--dim) } dd { margin: 0 }
summary { cursor: pointer; margin: .8rem 0 }
figure { margin: 0 } figcaption { color: var(--dim); font-size: .85rem }
figcaption strong { color: var(--ink) }
.plots { display: grid; gap: 1.2rem 1.6rem; grid-template-columns: repeat(auto-fill,
  minmax(min(100%, 22rem), 1fr)); margin: 1rem 0 .4rem }
.pictures { display: grid; gap: .8rem 1.2rem; grid-template-columns: repeat(auto-fit,
  minmax(min(100%, 17rem), 1fr)); margin: 1rem 0 }
.pictures video, .pictures img { background: var(--ground); border-radius: .4rem; display: block;
  height: auto; max-height: 20rem; max-width: 100%; object-fit: contain; width: 100% }
.stills { align-content: start; display: grid; gap: .6rem; grid-template-columns: 1fr 1fr }
.stills img { max-height: 9.6rem }
svg { display: block; height: auto; width: 100% }
svg text { fill: var(--dim); font: 12px system-ui, sans-serif }
.bar { fill: var(--bar) } .area { fill: var(--area) }
.line { fill: none; stroke: var(--bar); stroke-width: 1.6 }
.grid { stroke: var(--rule) } .mark { stroke: var(--mark); stroke-dasharray: 3 3 }
@media (max-width: 34rem) { dl { grid-template-columns: 1fr } dd { margin-bottom: .5rem }
  table, tbody, tr, td { display: block } tr { border-bottom: 1px solid var(--rule);
  padding: .6rem 0 } td { border: 0; padding: .1rem 0 } td:empty, tr:has(th) { display: none }
  td::before { color: var(--dim); content: attr(data-head) " "; font-size: .85rem } }
"""
_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
_POLICY = (
    f"default-src 'none'; style-src 'sha256-{_HASH}'; img-src data:; media-src data:; "
    "base-uri 'none'; form-action 'none'"
)
"""Of what a page may do, were there markup of a stranger's: not even look different."""


def markup_page(title: str, body: Iterable[str]) -> str:
    """A whole page in one file, of a body that is HTML of ours; the title may be a stranger's."""
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="referrer" content="no-referrer">',
            f"<title>{text(title)}</title>",
            f"<style>{_STYLE}</style>\n</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def text(value: object, limit: int = _LONGEST) -> str:
    """Text, and nothing but text: in a page as in an attribute of it."""
    return html.escape(printable(str(value), limit), quote=True)


def data(kind: str, content: bytes) -> str:
    """Bytes of ours as an address within the page: no others are shown."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def facts(rows: Iterable[tuple[object, object]], limit: int = _LONGEST) -> Iterator[str]:
    """Names, and what is said of each; both may be a stranger's."""
    yield "<dl>"
    for name, value in rows:
        yield f"<dt>{text(name, limit)}</dt><dd>{text(value, limit)}</dd>"
    yield "</dl>"


def folded(summary: str, inside: Iterable[str]) -> Iterator[str]:
    """HTML that is there when one asks for it."""
    yield f"<details><summary>{text(summary)}</summary>"
    yield from inside
    yield "</details>"


def table(heads: Iterable[str], rows: Collection[tuple[str, ...]]) -> Iterator[str]:
    """A table of cells that are HTML already, as many rows as a browser bears.

    On a phone each row is a paragraph, with the head of its column before each cell.
    """
    names = [text(head) for head in heads]
    top = "".join(f"<th>{name}</th>" for name in names)
    yield f'<div class="wide"><table>\n<tr>{top}</tr>'
    for row in list(rows)[:_MOST_ROWS]:
        cells = zip(names, row, strict=True)
        yield "<tr>" + "".join(f'<td data-head="{name}">{cell}</td>' for name, cell in cells)
    yield "</table></div>"
    if len(rows) > _MOST_ROWS:
        yield f"<p>{len(rows) - _MOST_ROWS} more are left out.</p>"
