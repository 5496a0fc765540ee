"""The times of direct shooting."""

from __future__ import annotations

import pytest
import torch

from staf_torch.adp.shooting.mesh import graded, halved


@pytest.mark.parametrize("intervals", [2, 4, 21])
def test_intervals_of_a_mesh_grow_by_one_factor_to_six_times_the_first(intervals: int) -> None:
    time = graded(3.0, intervals)
    lengths = time.diff()
    assert len(time) == intervals + 1
    assert float(time[0]) == 0
    assert float(time[-1]) == pytest.approx(3.0, rel=1e-14)
    assert float(lengths[-1] / lengths[0]) == pytest.approx(6.0)
    growth = lengths[1:] / lengths[:-1]
    torch.testing.assert_close(growth, growth[:1].expand_as(growth))


def test_half_a_mesh_has_the_same_times_and_the_middles() -> None:
    time = graded(3.0, 4)
    torch.testing.assert_close(halved(time)[::2], time, rtol=0, atol=0)
    torch.testing.assert_close(halved(time)[1::2], 0.5 * (time[1:] + time[:-1]))
