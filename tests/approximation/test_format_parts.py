"""What a state_dict says of its coefficients, part by part; condition numbers by plain linear algebra."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import pytest
import torch
from helpers import basis_of, uniform

import staf_torch as st
from staf_torch.approximation import coefficient_format, conditioning
from staf_torch.centers import probe_points
from staf_torch.targets import Paper


def of(kernel: st.Kernel, count: int = 6, radius: Any = 0.1) -> st.StaFBasis:
    return st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(count), radius))


def test_a_record_tells_all_that_coefficients_depend_on_beside_tensors() -> None:
    found = coefficient_format.decode("f", of(st.AnchoredKernel(st.MaternKernel(1.5))).convention)
    assert found == {
        "format": 2,
        "kernel": "AnchoredKernel(kernel=MaternKernel(smoothness=1.5))",
        "basis": "newton",
        "radius": "ConstantRadius()",
        "centers": [6, 2],
    }
    graded = coefficient_format.decode("f", of(st.GaussianKernel()).convention)
    assert graded["basis"] == "graded"
    assert graded["degrees"]["reach"] == 1.0
    assert [len(block) for block in graded["degrees"]["monomials"]] == [1, 2, 3]


OTHERS: dict[str, st.StaFBasis] = {
    "kernel": of(st.MaternKernel(2.5)),
    "number of centers and states": of(st.MaternKernel(1.5), 3),
    "radius": of(st.MaternKernel(1.5), 6, st.StateRadius(0.1, 0.1)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_coefficients_of_another_function_are_refused_with_what_differs(name: str) -> None:
    own = of(st.MaternKernel(1.5))
    own.check_convention("F", own.convention)
    with pytest.raises(ValueError, match=rf"coefficients mean another .*, as the {name} must be the same"):
        own.check_convention("F", OTHERS[name].convention)


@pytest.mark.parametrize(("key", "value"), [("format", 1), ("basis", "graded"), ("centers", None)])
def test_a_record_of_another_format_or_basis_is_refused(key: str, value: Any) -> None:
    own = of(st.MaternKernel(1.5))
    saved = own._record() | {key: value}
    with pytest.raises(ValueError, match=rf"saved with {value}, loaded into"):
        own.check_convention("F", coefficient_format.encode(saved))


def test_a_record_survives_averaging_and_nothing_else_is_one() -> None:
    record = {"b": [1, 2], "a": "é"}
    stored = coefficient_format.encode(record)
    assert stored.dtype == torch.uint8
    assert bytes(stored.tolist()) == json.dumps(record, sort_keys=True).encode()
    assert coefficient_format.decode("f", stored.double() + 0.4) == record
    listed = coefficient_format.encode([1])  # type: ignore[arg-type]
    for wrong in (torch.tensor([1, 2, 255]).to(torch.uint8), listed, stored[:-1]):
        with pytest.raises(ValueError, match="`f`: the entry `convention` must be what a StaFBasis wrote"):
            coefficient_format.decode("f", wrong)


def test_a_module_is_described_by_its_plain_settings_and_its_children() -> None:
    class Own(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.b, self.a, self.flag, self.name, self.hidden = 2, 1.5, True, "x", [1]
            self._private = 3
            self.inner = torch.nn.Identity()

    assert coefficient_format.described(Own()) == "Own(a=1.5, b=2, flag=True, name='x', inner=Identity())"


@pytest.mark.parametrize("name", ["gaussian", "matern32", "exponential"])
def test_condition_numbers_are_those_of_the_matrices(name: str) -> None:
    basis, x = basis_of(name, 6, 0.8), uniform(4, 2, low=0.3)
    found = conditioning.conditioning(basis, x)
    structure = basis.gram_structure(x)
    whole, core = torch.linalg.cond(structure.scaled()).expand(4), structure.core
    torch.testing.assert_close(found.condition, whole, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.core_condition, torch.linalg.cond(core), rtol=1e-6, atol=0)
    assert found.condition.shape == (4,)
    for shape in ((), (2, 3)):
        many = conditioning.conditioning(basis, uniform(*shape, 2, low=0.3))
        assert many.condition.shape == shape
    assert bool((found.rank == 6).all())
    assert bool((found.effective_rank == 6).all())


def test_cardinal_functions_are_one_at_their_own_center_and_sum_up_samples() -> None:
    basis, x = basis_of("gaussian", 6, st.StateRadius(0.8, 0.1)), uniform(4, 2, low=0.3)
    at_centers = conditioning.cardinal_functions(basis, x, basis.centers.offsets(x))
    torch.testing.assert_close(at_centers, torch.eye(6).double().expand(4, 6, 6), rtol=0, atol=1e-9)
    z = basis.centers.radius(x)[:, None, None] * probe_points(500, 2)
    functions = conditioning.cardinal_functions(basis, x, z)
    constant = functions.abs().sum(-1).amax(-1)
    torch.testing.assert_close(conditioning.lebesgue_constant(basis, x), constant)
    fewer = conditioning.lebesgue_constant(basis, x, 5)
    assert bool((fewer <= constant + 1e-12).all())
    estimate = torch.einsum("bpm,bm->bp", functions, Paper()(basis.centers(x)))
    worst = (Paper()(x.unsqueeze(1) + z) - estimate).abs().amax(-1)
    torch.testing.assert_close(conditioning.sup_error(basis, x, Paper()), worst, rtol=1e-6, atol=1e-10)
    assert float(conditioning.lebesgue_constant(basis, x[0])) == pytest.approx(float(constant[0]))


@pytest.mark.parametrize("batch", [(3,), (2, 3)])
def test_points_that_could_be_of_one_entry_each_or_of_all_are_refused(batch: tuple[int, ...]) -> None:
    staf = st.StaF(of(st.GaussianKernel()), batch).fit_(uniform(*batch, 2, seed=1), Paper())
    y = uniform(*batch, 2, seed=2)
    for call in (staf, staf.gradient):
        with pytest.raises(ValueError, match="must say which points are meant: one of each batch entry"):
            call(y)
    ones = [1] * len(batch)
    said = "y.unsqueeze(0)" if len(batch) == 1 else "y.reshape(1, 1, -1, 2)"
    with pytest.raises(ValueError, match=re.escape(said)):
        staf(y)
    all_of_them = staf(y.reshape(*ones, -1, 2))  # as it says
    assert all_of_them.shape == (*batch, math.prod(batch))
    torch.testing.assert_close(all_of_them[(0,) * len(batch)][0], staf(y.unsqueeze(-2))[(0,) * len(batch)][0])
    for points in (y.unsqueeze(-2), uniform(4, 2, seed=4), uniform(*batch, 4, 2, seed=3)):
        assert staf(points).shape[-1] == points.shape[-2]
