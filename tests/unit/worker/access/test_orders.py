"""What clients ask a server for: paths, listings and orders are taken within bounds."""

import sys
from dataclasses import replace
from typing import Any

import pytest

from envhub_worker.extras.access import packages
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.extras.access.store import uploads
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError


@pytest.mark.parametrize(
    ("path", "why"),
    [
        *(("/etc/passwd", "absolute"), ("a/../b", "'..' step"), ("a//b", "empty"), ("", "empty")),
        *(("./a", "'.' or"), ("a\\b", "backslash"), ("a\nb", "control character")),
        *(("a\udcff", "not UTF-8"), ("a/" * 200 + "b", "too deep"), ("a" * 300, "too long")),
        *(("env.py", ""), ("sub/ünïcode name.py", "")),
    ],
)
def test_paths_of_clients_stay_below_their_snapshot(path: str, why: str) -> None:
    said = uploads.wrong_with_path(path)
    assert why in said
    assert bool(said) == bool(why)


def listed(*paths: str, size: Any = 3) -> tuple[Any, ...]:
    return tuple((path, size, b"\0" * 32) for path in paths)


@pytest.mark.parametrize(
    "files",
    [
        *((), listed("a", "a"), listed("a", "a/b"), listed("../a")),
        *(listed("a", size=size) for size in (-1, "3", 1 << 60)),
        *((("a", 3, b"short"),), (3,)),
    ],
)
def test_listings_that_break_a_rule_are_refused(files: tuple[Any, ...]) -> None:
    with pytest.raises(RefusedError):
        uploads.checked_listing(files, Quotas())


def test_a_snapshot_has_the_name_of_its_sorted_listing() -> None:
    one = uploads.checked_listing(listed("b", "a/c"), Quotas())
    assert [file.path for file in one] == ["a/c", "b"]
    other = uploads.checked_listing(listed("a/c", "b"), Quotas())
    assert uploads.digest_of(one) == uploads.digest_of(other)
    more = uploads.checked_listing(listed("a/c", "b", size=4), Quotas())
    assert uploads.digest_of(more) != uploads.digest_of(one)
    with pytest.raises(RefusedError, match="--max-upload-files"):
        uploads.checked_listing(listed("a", "b"), replace(Quotas(), upload_files=1))


def order(**fields: Any) -> m.NeedPackages:
    nothing = dict.fromkeys(("requirements", "guesses", "constraints", "override", "without"), ())
    texts = dict.fromkeys(("supports", "python", "exclude_newer"), "")
    return m.NeedPackages(**{**nothing, **texts, "always": False, "gpu": False, **fields})


def test_an_order_is_taken_as_plain_values() -> None:
    made = packages.checked(order(requirements=(("numpy", "env.py"),), python="3.11"))
    assert (made["requirements"], made["python"]) == ([["numpy", "env.py"]], "3.11")


@pytest.mark.parametrize(
    "fields",
    [
        {"requirements": (("numpy",),)},
        {"requirements": (("numpy", 3),)},
        {"requirements": (("x" * 3_000, "env.py"),)},
        {"requirements": (("numpy", "env.py"),) * 1_001},
        {"without": (3,)},
        {"python": "3" * 3_000},
    ],
)
def test_orders_without_bounds_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(RefusedError, match="an order has at most"):
        packages.checked(order(**fields))


def test_the_program_is_of_this_interpreter() -> None:
    command = packages.command()
    assert command[0] == sys.executable
    assert {"-I", packages.PROGRAM} <= set(command)
    assert packages.why_impossible() == ""
