"""Whatever a stranger says is text on a page, and the page's policy forbids all else."""

from xml.etree import ElementTree

import pytest

from envhub_sandbox.extras.judge import markup
from envhub_sandbox.extras.judge.markup import bar_plot, histogram_plot, line_plot, number
from tests.support.output.pages import Page

_HOSTILE = "<script>alert(1)</script>\"'&\x1b[2J\u202e"


@pytest.mark.parametrize("limit", [10, 1_000])
def test_text_has_no_meaning_for_html(limit: int) -> None:
    made = markup.text(_HOSTILE, limit)
    [(tag, attributes)] = Page(f'<p title="{made}">{made}</p>').tags
    assert (tag, [name for name, _ in attributes]) == ("p", ["title"])
    assert not {"\x1b", "\u202e", "<", '"', "'"} & set(made)


def test_parts_of_a_page() -> None:
    made = "".join([*markup.facts([(_HOSTILE, 3)]), *markup.folded(_HOSTILE, ["<b>in</b>"])])
    assert Page(made).names == {"dl", "dt", "dd", "details", "summary", "b"}
    table = "\n".join(markup.table(["A", _HOSTILE], [("<i>1</i>", "2")]))
    assert table.count("data-head=") == 2
    assert Page(table).names == {"div", "table", "tr", "th", "td", "i"}
    assert markup.data("image/png", b"\0") == "data:image/png;base64,AA=="


def test_a_table_ends_where_a_browser_would_not() -> None:
    made = list(markup.table(["A"], [("x",)] * 2_003))
    assert made[-1] == "<p>3 more are left out.</p>"
    assert sum(row.startswith("<tr><td") for row in made) == 2_000


# --- Plots: whatever the numbers are, what is drawn can be drawn, and lies in its frame


_NUMBERS: dict[str, list[float]] = {
    "one": [3.0],
    "zeros": [0.0, 0.0, 0.0],
    "level": [5.0] * 4,
    "signs": [-1.0, 2.0, -3.0],
    "tiny": [5e-324, 1e-300],
    "huge": [1.7e308, -1.7e308, 1e308],
    "not all": [1.0, float("nan"), float("inf"), -float("inf"), 2.0],
    "many": [float(value % 17) for value in range(10_000)],
}
_DRAWN = {
    "bars": lambda values: bar_plot("x", values),
    "histogram": lambda values: histogram_plot("x", values),
    "course": lambda values: line_plot("x", values, [(len(values) - 1, "a"), (1, "b")]),
}


@pytest.mark.parametrize("kind", _DRAWN)
@pytest.mark.parametrize("numbers", _NUMBERS)
def test_what_is_drawn_lies_in_the_plot(kind: str, numbers: str) -> None:
    drawn = _DRAWN[kind](_NUMBERS[numbers])
    if kind == "course" and numbers in ("one", "not all"):
        assert drawn == "", "of one point there is no line, nor through what is no number"
        return
    svg = ElementTree.fromstring(drawn)
    _, _, width, height = map(float, svg.attrib["viewBox"].split())
    assert len(svg), "there is something to see"
    if kind != "course":  # which has as many points as we have counted
        assert len(drawn) < 20_000, "however many numbers there are"
    for one in svg.iter():
        for across, down in _places(one):
            assert -0.1 <= across <= width + 0.1, one.attrib
            assert -0.1 <= down <= height + 0.1, one.attrib


def _places(one: ElementTree.Element) -> list[tuple[float, float]]:
    told = {name: value for name, value in one.attrib.items() if name in _LENGTHS}
    lengths = {name: float(value) for name, value in told.items()}
    found = [
        (float(across), float(down))
        for across, _, down in (pair.partition(",") for pair in one.get("points", "").split())
    ]
    for end in ("", "1", "2"):
        if f"x{end}" in lengths:
            found.append((lengths[f"x{end}"], lengths[f"y{end}"]))
    if one.tag == "rect":
        assert lengths["width"] > 0
        assert lengths["height"] >= 0
        far = (lengths["x"] + lengths["width"], lengths["y"] + lengths["height"])
        found.append(far)
    return found


_LENGTHS = frozenset({"x", "y", "x1", "y1", "x2", "y2", "width", "height"})


@pytest.mark.parametrize("kind", _DRAWN)
def test_nothing_is_drawn_of_nothing(kind: str) -> None:
    assert (_DRAWN[kind]([]), _DRAWN[kind]([float("nan")])) == ("", "")


@pytest.mark.parametrize("count", [2, 3, 7])
def test_few_values_have_wide_bars_with_their_labels_below(count: int) -> None:
    drawn = ElementTree.fromstring(bar_plot("x", [1.0] * count))
    bars = [one for one in drawn if one.tag == "rect"]
    feet = {one.text: float(one.attrib["x"]) for one in drawn if one.attrib.get("y") == "146.0"}
    for name, bar in (("1", bars[0]), (str(count), bars[-1])):
        left, width = float(bar.attrib["x"]), float(bar.attrib["width"])
        assert left <= feet[name] <= left + width
    drawn = ElementTree.fromstring(histogram_plot("x", [0.001 * (at + 1) for at in range(count)]))
    assert all(float(one.attrib["width"]) > 100 for one in drawn if one.tag == "rect")


def test_bars_stand_for_their_numbers() -> None:
    high, low, below = filter(len, ElementTree.fromstring(bar_plot("x", [4, 2, -2])))
    assert float(high.attrib["height"]) == pytest.approx(2 * float(low.attrib["height"]), abs=0.2)
    assert float(below.attrib["height"]) == pytest.approx(float(low.attrib["height"]), abs=0.2)
    ground = float(low.attrib["y"]) + float(low.attrib["height"])
    assert float(below.attrib["y"]) == pytest.approx(ground, abs=0.2)
    assert [one[0].text for one in (high, low, below)] == ["1: 4", "2: 2", "3: -2"]


def test_every_step_is_counted_once() -> None:
    drawn = ElementTree.fromstring(histogram_plot("x", [0.001 * value for value in range(1, 400)]))
    titles = [str(one[0].text) for one in drawn if len(one)]
    assert sum(int(title.rpartition(" ")[2]) for title in titles) == 399


def test_a_number_is_short() -> None:
    texts = [number(value) for value in (0.12345, 12345.0, 1e9, float("nan"))]
    assert texts == ["0.123", "12,345", "1e+09", "none"]
