"""Text out of a jail does nothing to a terminal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.text import counted, duration_text, parse_size, printable, size_text


@pytest.mark.parametrize("text", ["", "plain", "two\nlines\tand a tab", "äöü 日本 🙂"])
def test_words_stay_words(text: str) -> None:
    assert printable(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        *(
            ("\x1b[2J", "\\x1b[2J"),
            ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
            ("nul\0", "nul\\x00"),
        ),
        *(("over\rwritten", "over\\rwritten"), ("back\x08space", "back\\x08space")),
        *(("\x9b31m", "\\x9b31m"), ("right \u202e to left", "right \\u202e to left")),
        *(("zero\u200bwidth", "zero\\u200bwidth"), ("line\u2028end", "line\\u2028end")),
        ("half \ud800 surrogate", "half \\ud800 surrogate"),
    ],
)
def test_control_characters_are_shown_instead_of_obeyed(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text(st.characters(exclude_categories=())))
def test_nothing_unprintable_is_left(text: str) -> None:
    assert all(char in "\n\t" or char.isprintable() for char in printable(text))


@given(st.text(max_size=200), st.integers(2, 100))
def test_length_is_bounded(text: str, limit: int) -> None:
    shown = printable("x" * len(text), limit)
    if len(text) <= limit:
        assert shown == "x" * len(text)
    else:
        assert shown.count("x") == limit // 2 * 2
        assert f"[... {len(text) - limit // 2 * 2} characters left out ...]" in shown


def test_beginning_and_end_are_kept() -> None:
    shown = printable("first" + "." * 1000 + "last", 20)
    assert shown.startswith("first")
    assert shown.endswith("last")


@pytest.mark.parametrize(
    ("count", "said"),
    [
        *((0, "0 bytes"), (1, "1 byte"), (1023, "1,023 bytes"), (1024, "1 KiB"), (1536, "1.5 KiB")),
        *((1000 << 10, "1000 KiB"), (24.1 * 2**20, "24.1 MiB"), (8 << 30, "8 GiB")),
        (3 << 40, "3 TiB"),
    ],
)
def test_sizes_are_said_in_the_unit_that_people_read(count: float, said: str) -> None:
    assert size_text(count) == said


@pytest.mark.parametrize(
    ("text", "unit", "size"),
    [
        *(("1048576", "", 2**20), ("16G", "", 16 << 30), ("16gib", "", 16 << 30)),
        *(("1.5 MB", "", 3 << 19), ("3 bytes", "m", 3), ("3", "m", 3 << 20)),
        *(("3B", "g", 3), ("3K", "g", 3 << 10)),
    ],
)
def test_sizes_are_read(text: str, unit: str, size: int) -> None:
    assert parse_size(text, unit) == size


@pytest.mark.parametrize("text", ["", "G", "16X", "-1", "1e9", "1,5G", "٣"])
def test_what_is_no_size_is_told(text: str) -> None:
    with pytest.raises(ValueError, match=r"512M, 1\.5GiB or 4G"):
        parse_size(text)
    with pytest.raises(ValueError, match="16 bytes: name a unit, 16M, 16G or 16B"):
        parse_size("16")


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        *((2e-6, "2 µs"), (0.0123, "12.3 ms"), (1.5, "1.5 s"), (59.97, "60 s")),
        *((320, "5 min 20 s"), (9_000, "2 h 30 min"), (7.2e5, "200 h"), (float("inf"), "inf h")),
    ],
)
def test_times_are_said_in_the_unit_that_people_read(seconds: float, said: str) -> None:
    assert duration_text(seconds) == said


def test_one_is_no_plural() -> None:
    findings = [counted(number, "finding") for number in (0, 1, 2_000)]
    assert findings == ["0 findings", "1 finding", "2,000 findings"]
    checks = [counted(number, "check holds", "checks hold") for number in (1, 2)]
    assert checks == ["1 check holds", "2 checks hold"]
