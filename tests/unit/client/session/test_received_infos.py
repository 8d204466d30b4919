"""Infos of workers that are ready at different times: none changes what another has said."""

import itertools
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from envhub_sandbox.extras.several_workers.received_infos import gather_infos
from envhub_worker.protocol.spaces import batches
from tests.compliance.test_join_infos import INFO
from tests.support.compare import assert_same

_ROOM = 1 << 20


def cut(infos: list[dict[str, Any]], data: st.DataObject) -> list[list[dict[str, Any]]]:
    cuts = data.draw(st.sets(st.integers(1, max(1, len(infos) - 1))))
    edges = [0, *sorted(one for one in cuts if one < len(infos)), len(infos)]
    return [infos[start:stop] for start, stop in itertools.pairwise(edges)]


def joined(infos: list[dict[str, Any]]) -> dict[Any, Any]:
    return batches.join_pairs(list(enumerate(infos)), len(infos))


@given(st.lists(INFO, min_size=1, max_size=6), st.data())
def test_what_fits_is_joined_as_ever(infos: list[dict[str, Any]], data: st.DataObject) -> None:
    parts = cut(infos, data)
    sizes = [len(part) for part in parts]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            each = [joined(part) for part in parts]
            wanted = joined(infos)
        except Exception:
            return
    if all(_fits(part, wanted) for part in each):
        assert_same(wanted, gather_infos(each, sizes, _ROOM), "infos")


def _fits(part: dict[Any, Any], whole: dict[Any, Any]) -> bool:
    """Whether a worker's columns are parts of the columns of all."""
    pairs = [(value, whole[key]) for key, value in part.items()]
    return all(
        isinstance(b, dict) and _fits(a, b)
        if isinstance(a, dict)
        else isinstance(b, np.ndarray) and (a.dtype, a.shape[1:]) == (b.dtype, b.shape[1:])
        for a, b in pairs
    )


ANY = st.one_of(
    st.integers(-9, 9),
    st.floats(allow_nan=False, width=32),
    st.booleans(),
    st.text(max_size=3),
    st.none(),
    st.integers(0, 3).map(lambda n: np.full(n, n, np.int16)),
    # in one order: a column has one for all
    st.fixed_dictionaries({}, optional={"a": st.integers(0, 9), "b": st.text(max_size=1)}).map(
        lambda one: dict(sorted(one.items()))
    ),
)
UNLIKE = st.fixed_dictionaries({}, optional={"one": ANY, "other": ANY})


@given(st.lists(UNLIKE, min_size=1, max_size=6))
@example([{"other": {"b": ""}}, {"other": {"a": 0, "b": ""}}, {"other": 0}])
def test_each_has_its_own_whatever_the_others_say(infos: list[dict[str, Any]]) -> None:
    each, sizes = [joined([info]) for info in infos], [1] * len(infos)
    gathered = gather_infos(each, sizes, _ROOM)
    for index, info in enumerate(infos):
        for key in ("one", "other"):
            assert_same(info.get(key), member(gathered, key, index), key)


def member(infos: dict[Any, Any], key: str, index: int) -> Any:
    """What a sub-environment gave; None if nothing."""
    if key not in infos or not infos[f"_{key}"][index]:
        return None
    value = infos[key]
    if isinstance(value, dict):
        names = sorted(name for name in value if not name.startswith("_"))
        return {name: member(value, name, index) for name in names if value[f"_{name}"][index]}
    return plain(value[index])


def plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: plain(value[key]) for key in sorted(value)}
    return value.item() if isinstance(value, np.generic) else value


def test_a_few_bytes_make_no_large_column() -> None:
    """A worker's large array is its own; as a column of all it would be a hundred times that."""
    large = joined([{"large": np.zeros(1 << 17, np.uint8)}])
    few = joined([{"large": np.ones(1 << 17, np.uint8)}])
    gathered = gather_infos([large, *[few] * 99], [1] * 100, _ROOM)
    assert gathered["large"].dtype == object
    assert [int(one[0]) for one in gathered["large"]] == [0, *[1] * 99]
    assert gather_infos([large, few], [1, 1], _ROOM)["large"].shape == (2, 1 << 17)


@pytest.mark.parametrize(
    "mask", [np.zeros((1, 3)), np.array(["x"]), np.array([None]), np.zeros((1, 0), bool)]
)
def test_lies_about_masks_do_no_harm(mask: Any) -> None:
    lie = {"x": np.array([1]), "_x": mask}
    honest = joined([{"x": 0.5}])
    for each in ([lie, honest], [honest, lie]):
        gathered = gather_infos(each, [1, 1], _ROOM)
        at = each.index(honest) if each[0] is honest else 1
        assert gathered["x"][at] == 0.5
        assert bool(gathered["_x"][at])
