"""What the documents say is what the code does."""

import dataclasses
import importlib
import re
import string
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import TABLE, Event, State
from envhub_worker.protocol.limits import DEFAULT_LIMITS, MAX_NUM_ENVS
from envhub_worker.protocol.manifest.manifest import MAX_ENVS
from envhub_worker.protocol.manifest.names import MAX_NAME
from tests.support.command_line import python
from tests.support.documents import checks, settings
from tests.unit.docs.test_imports import folder

CHECKOUT = Path(__file__).resolve().parents[3]
DOCUMENTS = sorted([*CHECKOUT.glob("*.md"), *(CHECKOUT / "docs").rglob("*.md")])
README = (CHECKOUT / "README.md").read_text()
PROTOCOL = (CHECKOUT / "docs" / "protocol.md").read_text()


def named(path: Path) -> str:
    return str(path.relative_to(CHECKOUT))


def section(text: str, title: str) -> str:
    [rank] = re.findall(rf"^(#+) {re.escape(title)}$", text, re.MULTILINE)
    part = text.partition(f"\n{rank} {title}\n")[2]
    return re.split(rf"^#{{2,{len(rank)}}} ", part, maxsplit=1, flags=re.MULTILINE)[0]


def rows(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    heads = {index - 1 for index, row in enumerate(cells) if set("".join(row)) <= set("-: ")}
    return [row for index, row in enumerate(cells) if index not in heads and index - 1 not in heads]


def code_words(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))


def sources() -> str:
    packages = [folder("envhub_sandbox"), folder("envhub_worker")]
    return "\n".join(path.read_text() for root in packages for path in root.rglob("*.py"))


@pytest.mark.parametrize("title", ["Client and server", "Client and runner"])
def test_protocol_lists_every_message_with_its_fields(title: str) -> None:
    listed = {
        int(kind): (*code_words(name), code_words(fields))
        for kind, name, fields, _ in rows(section(PROTOCOL, title))
    }
    runners = title == "Client and runner"
    assert listed == {
        kind: (cls.__name__, list(cls.FIELDS))
        for kind, cls in m.KINDS.items()
        if (kind >= m.FIRST_RUNNER_KIND) == runners
    }


def test_protocol_draws_the_lifecycle_from_its_table() -> None:
    states, moves = [], []
    for row in rows(section(PROTOCOL, "The life of an environment")):
        (states if len(row) == 2 else moves).append(row)
    assert states == [[f"`{state.name}`", state.value] for state in State]
    drawn = {
        (state, Event[event.strip("`")]): State[target.strip("`")]
        for event, *targets in moves
        for state, target in zip(State, targets, strict=True)
        if target
    }
    assert drawn == TABLE
    assert [row[0].strip("`") for row in moves] == [event.name for event in Event]
    assert all(f"`{event.name}`: {event.value}." in flat(PROTOCOL) for event in Event)


def flat(text: str) -> str:
    return " ".join(text.split())


def test_protocol_states_its_version_and_limits() -> None:
    assert f"Version {m.VERSION}." in PROTOCOL
    for number in (MAX_ENVS, MAX_NUM_ENVS, MAX_NAME):
        assert re.search(rf"\b{number}\b", section(PROTOCOL, "Manifest"))


def test_values_lists_the_limits_with_their_defaults() -> None:
    text = (CHECKOUT / "docs" / "values.md").read_text()
    units = {"KiB": 1024, "MiB": 1024**2}
    listed = {}
    for name, default, _ in rows(section(text, "Limits")):
        number, _, unit = default.replace(",", "").partition(" ")
        listed[name.strip("`")] = int(number) * units.get(unit, 1)
    assert listed == dataclasses.asdict(DEFAULT_LIMITS)


def fenced(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("document", ["README.md", "docs/integrations.md"])
def test_the_python_of_a_document_runs(document: str) -> None:
    blocks = fenced((CHECKOUT / document).read_text(), "python")
    python("-c", "\n".join(blocks), cwd=CHECKOUT)


def test_troubleshooting_quotes_errors_that_exist() -> None:
    """A search for what is on the screen finds it."""
    page = (CHECKOUT / "docs" / "troubleshooting.md").read_text()
    table = rows(section(page, "The most frequent errors"))
    quoted = {text for symptom, _ in table for text in code_words(symptom)}
    said = re.sub(r'(?<!\\)"\s*\n?\s*f?"', "", sources())  # texts that go on over a line's end
    assert len(quoted) > 5
    of_others = {"no module named venv", "ensurepip is not available"}
    assert [text for text in sorted(quoted - of_others) if text not in said] == []


def test_the_pages_before_internals_are_few_enough_to_read() -> None:
    """At most 36,000 words by hand: what is written from the source is looked up, and not read."""
    contents = (CHECKOUT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    pages = re.findall(r"[\w/-]+\.md$", contents.partition("- Internals:")[0], re.MULTILINE)
    beside = {"index.md": "README.md", "SECURITY.md": "SECURITY.md"}
    texts = [(CHECKOUT / beside.get(page, f"docs/{page}")).read_text() for page in pages]
    by_hand = re.sub(r"<!-- (\w+) -->.*?<!-- /\1 -->", "", "\n".join(texts), flags=re.DOTALL)
    assert 20_000 < len(by_hand.split()) <= 36_000


def links(text: str) -> Iterator[str]:
    for target in re.findall(r'(?:\]\(|srcset=")([^)"\s]+)[)"]', text):
        if not target.startswith(("http://", "https://", "mailto:")):
            yield target


def anchors(text: str) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    kept = string.ascii_lowercase + string.digits + "-_ "
    return {
        "".join(char for char in title.lower() if char in kept).replace(" ", "-")
        for title in titles
    }


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_a_document_names_what_there_is(document: Path) -> None:
    """Files are there, and so are the titles that an anchor means, and paths in backquotes. Nothing
    names a person's machine or tools, and nothing is a note to oneself."""
    text = document.read_text()
    for target in links(text):
        path, _, anchor = target.partition("#")
        found = (document.parent / path).resolve() if path else document
        assert found.exists(), target
        assert not anchor or anchor in anchors(found.read_text()), target
    tops = ("tests/", "docs/", "worker/", "envhub_sandbox/", "examples/", ".ci/", "benchmarks/")
    for word in code_words(text):
        path = word.partition(" ")[0].rstrip("/")
        if path.startswith(tops) and not re.search(r"[*{<(]", path):
            top, _, rest = path.removeprefix("worker/").partition("/")
            root = folder(top) if top in ("envhub_worker", "envhub_sandbox") else CHECKOUT / top
            assert (root / rest).exists(), word
    assert _FORBIDDEN.findall(text) == []


def test_the_map_has_every_package() -> None:
    """Every folder of the two packages, and every module that stands beside them. The source is as
    finished as the documents are."""
    words = set(code_words((CHECKOUT / "docs" / "architecture.md").read_text()))
    missing = set()
    for package, place in (("envhub_sandbox", ""), ("envhub_worker", "worker/")):
        root = folder(package)
        parts = [init.parent for init in root.rglob("__init__.py") if init.parent != root]
        modules = [file for file in root.glob("*.py") if not file.name.startswith("__")]
        named = {f"{place}{package}/{part.relative_to(root)}" for part in [*parts, *modules]}
        missing |= named - words
    assert missing == set()
    assert _FORBIDDEN.findall(sources()) == []


# said nowhere in the project: they name people's machines and tools, not the project
_FORBIDDEN = re.compile(r"(?<![\w./-])/(work|root)/\w|TODO|FIXME|XXX(?!X)")


def error_tree() -> list[tuple[int, str]]:
    """The tree in the docstring of ``errors``: depth and name."""
    errors: Any = importlib.import_module("envhub_sandbox.errors")
    block = errors.__doc__.partition("::\n\n")[2].partition("\n\nA remote")[0]
    found = []
    for line in block.splitlines():
        depth = (len(line) - len(line.lstrip())) // 2
        found += [(depth, name) for name in re.findall(r"(\w+Error)(?: \(\w+\))?", line)[:1]]
    return found


def test_error_tree_is_the_tree() -> None:
    """The docstring of ``errors`` shows each class below its base."""
    errors: Any = importlib.import_module("envhub_sandbox.errors")
    parents: dict[int, type] = {}
    tree = error_tree()
    for depth, name in tree:
        cls = parents[depth] = getattr(errors, name)
        if depth - 1 in parents:
            assert issubclass(cls, parents[depth - 1]), name
    shown = {name for _, name in tree}
    assert {name for name in errors.__all__ if name.endswith("Error")} <= shown


@pytest.mark.parametrize("page", [checks, settings])
def test_what_is_written_from_the_source_is_up_to_date(page: Any) -> None:
    """``python -m tests.support.documents.NAME`` writes it."""
    assert page.DOCUMENT.read_text() == page.document()
