"""A hook of MkDocs: pages that stand outside of docs/, and links between them and those in it."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ("SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "benchmarks/README.md")
PLACES = {"README.md": "index.md", **{name: name for name in BESIDE}}
_LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)\s#]+)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, as they are."""
    for name, place in PLACES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead each link to where its target is on the site."""
    place = page.file.src_uri
    sources = {there: here for here, there in PLACES.items()}
    folder = os.path.dirname(sources.get(place, f"docs/{place}"))

    def led(found: re.Match[str]) -> str:
        meant = os.path.normpath(os.path.join(folder, found[1]))
        there = PLACES.get(meant, meant.removeprefix("docs/"))
        return f"]({os.path.relpath(there, os.path.dirname(place) or '.')}"

    return _LINK.sub(led, markdown)
