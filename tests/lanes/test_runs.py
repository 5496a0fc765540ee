"""Lists of entries as runs of equal steps."""

from __future__ import annotations

import random

import pytest

from staf_torch.lanes.runs import runs


@pytest.mark.parametrize("seed", range(40))
def test_runs_cover_every_entry_once_and_say_where_it_is(seed: int) -> None:
    draw = random.Random(seed)
    places: list[tuple[str, int]] = []
    while len(places) < 60:
        source, first, step = draw.choice("ab"), draw.randrange(3), draw.choice([0, 1, 1, 2, -1])
        places += [(source, first + k * step) for k in range(draw.choice([1, 1, 2, 3, 5, 12]))]
    places += [("a", 0), ("b", 5), *[("a", 0)] * 5]  # one between others that are alike
    end = 0
    for run in runs(places):
        assert run.begin == end
        end += run.length
        source, first = places[run.begin]
        if run.step is not None:
            wanted = [(source, first + k * run.step) for k in range(run.length)]
            assert places[run.begin : end] == wanted
            assert run.first == first
    assert end == len(places)
    assert [run.step for run in runs([("a", 3 * k) for k in range(20)])] == [3]
