"""TOML of a stranger's costs no more time than its length permits."""

from __future__ import annotations

import pytest

from envhub_sandbox.sources.toml import loads

_KEY = ".".join("a" * 3000)


@pytest.mark.parametrize(
    ("text", "generated", "said"),
    [
        ("x = 1 # " + "x" * 100_000, False, "characters"),
        (f"{_KEY} = 1", False, "dots"),
        (f"x = '{_KEY}'", False, "dots"),
        (f"'\"'.{_KEY}.'\"' = 1", True, "dots"),
        ('x = """\n"""', True, "several lines"),
        ("x = " + "[" * 9000, False, r"\w"),
        ("x =", False, r"\w"),
    ],
)
def test_what_costs_too_much_is_refused(text: str, generated: bool, said: str) -> None:
    """Before it is parsed, and as a ``ValueError`` of few words."""
    with pytest.raises(ValueError, match=said) as caught:
        loads(text, 100_000, generated=generated)
    assert type(caught.value) is ValueError
    assert len(str(caught.value)) <= 200


def test_dots_in_texts_of_a_generated_document_are_free() -> None:
    """URLs and times have them."""
    text = "\n".join(f"x{number} = 'https://a.b.c.d.e/f.g'" for number in range(1000))
    assert len(loads(text, 10**6, generated=True)) == 1000
