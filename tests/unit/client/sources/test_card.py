"""What a card declares is read as data, within bounds, and only in one form."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.sources.card import CardError, declared_assets

COMMIT = "a" * 40


def declared(folder: Path, text: str) -> list[str]:
    """What a card of this text declares."""
    (folder / "README.md").write_text(text)
    return declared_assets(folder)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# a title\n",
        "---\nlicense: mit\n---\n",
        f"# not in front\n---\nenvhub:\n  assets: [org/data@{COMMIT}]\n---\n",
        f"---\nother:\n  envhub:\n    assets: [org/data@{COMMIT}]\n---\n",
        f"---\nenvhub:\n  assets: [org/data@{COMMIT}]\n",
    ],
)
def test_most_cards_declare_nothing(tmp_path: Path, text: str) -> None:
    """No card, none in front, none of ours, and one that does not end."""
    assert declared(tmp_path, text) == []


def test_assets_are_a_list_of_texts(tmp_path: Path) -> None:
    """In both of YAML's forms, with either end of line; order is kept."""
    rows = f"---\r\nenvhub:\r\n  assets:\r\n  - org/b@{COMMIT}\r\n  - datasets/org/a@x\r\n---\r\n"
    assert declared(tmp_path, rows) == [f"org/b@{COMMIT}", "datasets/org/a@x"]
    assert declared(tmp_path, '---\nenvhub: {assets: ["org/b", 5]}\n---\n') == ["org/b", "5"]


@pytest.mark.parametrize(
    ("yaml", "why"),
    [
        ("envhub: 5", "takes 'assets'"),
        ("envhub:\n  assets: org/data", "takes 'assets'"),
        ("envhub:\n  assets: [[org/data]]", "each of its assets is a text"),
        ("envhub:\n  assets: [org/" + "x" * 60_000 + "]", "has more than 500 characters"),
        ("envhub: [", "cannot be read"),
        ('envhub: {assets: ["\\UFFFFFFFF"]}', "cannot be read: (Overflow|Value)Error"),
        ("license: mit\nenvhub:\n\tassets: []", "cannot be read: ScannerError in line 4"),
        ("envhub:\n  assets: " + "[" * 5000, "cannot be read"),
        ("envhub:\n  assets:\n" + "  - org/data\n" * 10_000, "cannot be read|declares|at most"),
        ("envhub:\n  assets:\n" + "  - org/data\n" * 100, "it declares 100 assets, and at most 16"),
    ],
)
def test_another_form_is_refused(tmp_path: Path, yaml: str, why: str) -> None:
    """The text says what is wrong; deep nesting and thousands of rows cost next to nothing."""
    if len(yaml) > 64 << 10:
        assert declared(tmp_path, f"---\n{yaml}\n---\n") == []  # its end lies behind what is read
        return
    with pytest.raises(CardError, match=why):
        declared(tmp_path, f"---\n{yaml}\n---\n")


def test_merges_are_not_followed(tmp_path: Path) -> None:
    """Constructing thirty merges that double would take a billion pairs; nothing is constructed."""
    doubled = "".join(f"a{n + 1}: &a{n + 1}\n  <<: [*a{n}, *a{n}]\n" for n in range(30))
    with pytest.raises(CardError, match="takes 'assets'"):
        declared(tmp_path, f"---\na0: &a0 {{k: 1}}\n{doubled}envhub: *a30\nx: 1\n---\n")


def test_the_documented_card_is_read(tmp_path: Path) -> None:
    """The block in docs/authors.md, as an author copies it."""
    page = (Path(__file__).parents[4] / "docs" / "authors.md").read_text()
    block = next(one for one in page.split("```") if one.strip().startswith("---"))
    model, dataset = declared(tmp_path, block.lstrip())
    assert HubRef.parse(model).is_pinned
    assert HubRef.parse(dataset).repo_type == "dataset"
