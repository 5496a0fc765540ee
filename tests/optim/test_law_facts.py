"""What laws say of themselves, recorded; and the parts that they share, in numbers that are made up."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import random_positive_definite, tensor, uniform
from recorded import Record
from variants import LAWS

from staf_torch.optim.objective import NativeError

KAPPA = tensor([1.0, 2.5, 100.0, 1e8])


def test_what_laws_say_of_themselves_is_the_recorded(record: Record) -> None:
    found: dict[str, Any] = {}
    for name, law in LAWS.items():
        promised = law.contraction(KAPPA)
        work = [law.products(count, steps) for count in (3, 10) for steps in (1, 4, 10)]
        sizes = [list(part.shape) for part in law.init(torch.zeros(2, 3).double())]
        found[name] = {
            "title": law.title,
            "needs": " ".join(sorted(law.needs)),
            "step size": repr(law.step_size),
            "work": torch.tensor(work),
            "promised": "nothing" if promised is None else promised,
            "state": repr(sizes),
        }
    record(found, rtol=1e-9)


@pytest.mark.parametrize("scaled", [True, False, None])
def test_an_error_in_factors_is_that_of_the_whole_matrix(scaled: bool | None) -> None:
    core = random_positive_definite(2, 1, size=3)[0]
    scale = 0.5 + uniform(4, 3, seed=3) if scaled else None
    gram = core.expand(4, 3, 3) if scale is None else scale.unsqueeze(-1) * core * scale.unsqueeze(-2)
    whole = NativeError(gram, uniform(4, 3, seed=4))
    parts = NativeError(gram, whole.values, core=core, scale=scale)
    v = uniform(4, 3, seed=5)
    for name in ("curvature", "descent", "solve"):
        torch.testing.assert_close(getattr(parts, name)(v), getattr(whole, name)(v))
    torch.testing.assert_close(whole.solve(whole.curvature(v)), v)
    torch.testing.assert_close(parts.minimiser(), torch.linalg.solve(gram, whole.values))
    low, high = parts.spectrum()
    values = torch.linalg.eigvalsh(gram)
    torch.testing.assert_close(low, values[:, 0])
    torch.testing.assert_close(high, values[:, -1])
