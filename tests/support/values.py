"""Values of every kind that the wire carries, nested in any way."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp


def objects(*items: Any) -> np.ndarray[Any, Any]:
    array = np.empty(len(items), dtype=object)
    for index, item in enumerate(items):
        array[index] = item
    return array


scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**200), 2**200)
    | st.floats()
    | st.complex_numbers(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]))
    | st.binary()
    | st.builds(range, st.integers(), st.integers(), st.integers(1, 5))
    | hnp.from_dtype(np.dtype("f4"))
    | hnp.from_dtype(np.dtype("?"))
    | hnp.from_dtype(np.dtype("i8"))
)
keys = st.recursive(
    st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
    | st.integers()
    | st.booleans()
    | st.none(),
    lambda children: st.tuples(children, children) | st.frozensets(children, max_size=3),
    max_leaves=3,
)
plain_arrays = hnp.arrays(
    st.sampled_from(["f4", "f8", "u1", "?", "i8"]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
values = st.recursive(
    scalars | plain_arrays,
    lambda children: (
        st.lists(children, max_size=4)
        | st.lists(children, max_size=4).map(tuple)
        | st.dictionaries(keys, children, max_size=4)
        | st.sets(keys, max_size=4)
        | st.lists(children, min_size=4, max_size=4).map(lambda four: objects(*four).reshape(2, 2))
    ),
    max_leaves=20,
)
