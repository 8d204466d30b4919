"""Limits and names: what a listing may ask of this machine's disk."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envhub_sandbox.errors import PolicyError, SnapshotError
from envhub_sandbox.hub import listing
from envhub_sandbox.hub.reference import HubRef
from envhub_worker.protocol.runtime import read_hub_copies

DIGEST = "sha256:" + "0" * 64


def record(path: str, size: int = 1) -> listing.FileRecord:
    return listing.FileRecord(path, size, DIGEST)


@pytest.mark.parametrize("value", [0, -1, True, 1.5, "9", None])
def test_limit_must_be_a_positive_int(value: object) -> None:
    with pytest.raises(PolicyError, match="max_files"):
        listing.SnapshotLimits(max_files=value)
    with pytest.raises(TypeError, match="max_size"):
        listing.SnapshotLimits(max_size=1)


def test_listing_exactly_at_the_limits_passes_sorted() -> None:
    limits = listing.SnapshotLimits(max_bytes=5, max_files=2, max_file_bytes=3)
    files = [record("b", 3), record("a", 2)]
    assert [file.path for file in listing.listing_within_limits(files, limits, "t")] == ["a", "b"]


@pytest.mark.parametrize(
    "path",
    [
        *("", "/a", "..", "../a", "a/../b", "a/./b", "a//b", "a/", "a\\b", "a\x00b", "a\nb"),
        *("a\x1b[2J", "a\u202eb", "x" * 256),
        "/".join("x" * 5 for _ in range(200)),
        "/".join("x" for _ in range(65)),
        *("/".join(["x" * 200] * 6), "\u00e9" * 128),
    ],
)
def test_hostile_name_is_refused(path: str) -> None:
    with pytest.raises(SnapshotError, match="refused"):
        listing.check_listing_names([record("env.py"), record(path)], "t")


@pytest.mark.parametrize("paths", [["a", "a"], ["a", "a/b"], ["a/b/c", "a/b"]])
def test_names_that_clash_are_refused(paths: list[str]) -> None:
    with pytest.raises(SnapshotError, match=r"listed twice|both a file and a folder"):
        listing.check_listing_names(map(record, paths), "t")


def test_ordinary_names_pass() -> None:
    names = [".gitattributes", "A.py", "a.py", "my env/ж.txt", "..a"]
    listing.check_listing_names(map(record, names), "t")


@settings(max_examples=30)
@given(st.lists(st.text(min_size=1, max_size=12), max_size=4))
def test_accepted_names_stay_below_the_root(names: list[str]) -> None:
    root = Path("/store/tree")
    try:
        listing.check_listing_names(map(record, names), "t")
    except SnapshotError:
        return
    for name in names:
        assert root in (root / name).parents
        assert ".." not in (root / name).parts


@pytest.mark.parametrize(
    ("revision", "found"),
    [
        ("v1.0", ("main", "v1.0")),
        ("fix#3=a@b,c%d", ("fix#3=a@b,c%d", "main")),
        ("refs/pr/3", ("main", "refs/pr/3")),
        ("main", ("main",)),
        ("a" * 40, ("main",)),
        ("\u00e9", ("main",)),
        ("a/b/c/d/e/f", ("main",)),
        ("x" * 200, ("main",)),
    ],
)
def test_every_revision_of_a_reference_can_be_opened(revision: str, found: tuple[str, ...]) -> None:
    asked = HubRef.parse(f"org/repo@{revision}").revision
    snapshot = listing.Snapshot("org/repo", "model", "a" * 40, "env.py", Path("/x"), (), asked)
    [copy] = read_hub_copies(snapshot.hub_copies)
    assert copy.revisions == found
