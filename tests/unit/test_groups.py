"""Things that hang together by pairs are numbered as scipy numbers them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from amrepair.field.groups import connected


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60), pairs=st.integers(0, 90))
def test_what_pairs_link_has_one_number(seed: int, count: int, pairs: int) -> None:
    one, other = np.random.default_rng(seed).integers(0, count, (2, pairs))
    graph = coo_array((np.ones(pairs), (one, other)), shape=(count, count))
    truth = connected_components(graph, directed=False)[1]
    assert (connected(one, other, count) == truth).all()
