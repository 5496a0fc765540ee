"""Native code under AddressSanitizer and UBSan; ten thousand calls: `python tests/sanitized.py`."""

from __future__ import annotations

import pytest
import sanitized
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.compilation import cache


@pytest.mark.skipif(sanitized.missing() is not None, reason=sanitized.missing() or "")
def test_no_shape_or_layout_makes_native_code_read_outside() -> None:
    builds = cache.cache() / "sanitized"  # kept, by a hash of their sources
    said = sanitized.run(20, 1, builds, kinds=["programs"], level="-O0")  # banks take ten seconds to build
    assert said.startswith("20 calls of")


@pytest.mark.needs_compiler
def test_rows_and_times_may_be_more_than_two_to_the_31_numbers_apart() -> None:
    try:
        far = torch.empty(2**31 + 2**20, dtype=torch.float32)  # 9 GB, of which a few pages are touched
    except RuntimeError as error:
        pytest.skip(str(error))
    by_rows = torch.as_strided(far, (3, 2), (2**30, 5)).copy_(torch.rand(3, 2))
    by_times = torch.as_strided(far, (2, 3), (7, 2**30), 100).copy_(torch.rand(2, 3))

    def step(x: Tensor, now: Tensor, row: tuple[()]) -> tuple[Tensor, Tensor]:
        x = 0.9 * x + now.unsqueeze(-1)
        return x, x.sum(-1)

    for x, u in ((by_rows, torch.rand(3, 4)), (torch.rand(2, 2), by_times)):
        program = lanes.Program(step)
        assert program.compiles(x, u)
        torch.testing.assert_close(program(x, u), program.definition(x, u))
