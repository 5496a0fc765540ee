"""What laws say of themselves, recorded; and the parts that they share, in numbers that are made up."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import random_positive_definite, tensor, uniform
from recorded import Record
from torch import Tensor
from variants import LAWS

from staf_torch import optim
from staf_torch.optim.base import line_search
from staf_torch.optim.objective import NativeError, ScaledError, extremes

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


def objective() -> NativeError:
    gram = random_positive_definite(1, 4, size=3)
    return NativeError(gram, uniform(4, 3, seed=2))


@pytest.mark.parametrize("scaled", [True, False, None])
def test_an_error_in_factors_is_that_of_the_whole_matrix(scaled: bool | None) -> None:
    core = random_positive_definite(2, 1, size=3)[0]
    scale = 0.5 + uniform(4, 3, seed=3) if scaled else None
    gram = core.expand(4, 3, 3) if scale is None else scale.unsqueeze(-1) * core * scale.unsqueeze(-2)
    whole = NativeError(gram, uniform(4, 3, seed=4))
    parts = ScaledError(core, scale, whole.values, gram)
    v = uniform(4, 3, seed=5)
    for name in ("curvature", "descent", "solve"):
        torch.testing.assert_close(getattr(parts, name)(v), getattr(whole, name)(v))
    torch.testing.assert_close(whole.solve(whole.curvature(v)), v)
    torch.testing.assert_close(parts.minimiser(), torch.linalg.solve(gram, whole.values))
    low, high = parts.spectrum()
    values = torch.linalg.eigvalsh(gram)
    torch.testing.assert_close(low, values[:, 0])
    torch.testing.assert_close(high, values[:, -1])


def test_eigenvalues_of_a_matrix_that_is_not_finite_spoil_no_other() -> None:
    gram = torch.diag_embed(tensor([[1.0, 4.0, 2.0], [1.0, 4.0, 2.0], [3.0, 5.0, 9.0]]))
    gram[1, 0, 2] = torch.inf
    found = extremes(gram)
    assert found[[0, 2]].tolist() == [[1.0, 4.0], [3.0, 9.0]]
    assert bool(found[1].isnan().all())


def test_a_line_search_ends_where_the_slope_does() -> None:
    error, a, p = objective(), uniform(4, 3, seed=12), uniform(4, 3, seed=13)
    g = error.descent(a)
    length = line_search(error, g, p)
    assert length.shape == (4, 1)
    left = error.descent(a + length * p)
    torch.testing.assert_close((left * p).sum(-1), torch.zeros(4).double(), rtol=0, atol=1e-12)
    assert line_search(error, g, 0 * p).tolist() == [[0.0]] * 4
    flat = NativeError(-error.gram, error.values)
    assert line_search(flat, g, p).tolist() == [[0.0]] * 4


class Plain(optim.UpdateLaw):
    """A law that adds one, and two to its state."""

    def step(self, objective: Any, weights: Tensor, state: Any) -> Any:
        return weights + 1, tuple(part + 2 for part in state)


def test_a_law_has_defaults_for_all_but_its_step() -> None:
    law, weights = Plain(), torch.zeros(2, 3).double()
    assert law.init(weights) == ()
    state = (weights, torch.zeros(2).double(), torch.ones(2, 3, 3).double())
    assert law.begin(objective(), weights, state) is state
    moved, after = law.iterate(objective(), weights, state[:2], 5)
    assert float(moved.min()) == float(moved.max()) == 5
    assert [float(part.min()) for part in after] == [10.0, 10.0]
    factor = tensor([[2.0], [3.0]])
    ones = [torch.ones(*size).double() for size in ((2, 3), (2,), (2, 3, 3))]
    scaled = law.rescale(tuple(ones), factor)
    assert scaled[0].tolist() == [[2.0] * 3, [3.0] * 3]
    assert scaled[1].tolist() == [1.0, 1.0]
    assert scaled[2][:, 0].tolist() == [[2.0] * 3, [3.0] * 3]
    assert law.contraction(KAPPA) is None
    assert law.products(6, 4) == 5
    assert law.title == "plain"
    assert type(Plain.from_settings(inner_steps=3)) is Plain
    with pytest.raises(ValueError, match=r"`Plain` has no step size to set; got 0\.5\."):
        law.with_step_size(0.5)
    assert optim.NormalisedLMS().title == "normalised LMS"
