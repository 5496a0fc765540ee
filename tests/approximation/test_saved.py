"""A saved model loads as the same function, or says why not."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import basis_of, tensor, uniform
from torch import nn
from variants import KERNELS, by_turns, over

import staf_torch as st
from staf_torch.approximation.coefficient_format import decode
from staf_torch.targets import Paper

X = [0.5, 0.4]


def fitted(kernel: str | st.Kernel = "gaussian", count: int = 6, radius: Any = 0.5) -> st.StaF:
    if isinstance(kernel, str):
        basis = basis_of(kernel, count, radius)
    else:
        basis = st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(count), radius))
    return st.StaF(basis).fit_(tensor(X), Paper())


@pytest.mark.parametrize(("name", "strict"), by_turns(KERNELS, [True, False]))
def test_a_file_of_weights_restores_the_function(name: str, strict: bool) -> None:
    staf, file = fitted(name), io.BytesIO()
    torch.save(staf.state_dict(), file)
    file.seek(0)
    fresh = st.StaF(basis_of(name, radius=0.5))
    result = fresh.load_state_dict(torch.load(file, weights_only=True), strict=strict)
    assert not result.missing_keys
    assert not result.unexpected_keys
    y = tensor(X) + uniform(5, 2, low=-0.3, high=0.3)
    assert torch.equal(fresh(y), staf(y))
    assert torch.equal(fresh.value_and_gradient(y)[1], staf.value_and_gradient(y)[1])


OTHERS: dict[str, tuple[Callable[[], st.StaF], Callable[[], st.StaF], str]] = {
    "another kernel": (
        lambda: fitted("exponential"),
        lambda: fitted("anchored_exponential"),
        r"kernel must be the same: saved with ExponentialKernel\(\), loaded into AnchoredKernel\(kernel=Exp",
    ),
    "another degree": (
        lambda: fitted(st.PolynomialKernel(2)),
        lambda: fitted(st.PolynomialKernel(3)),
        r"degree=2, full=True\), loaded into PolynomialKernel\(degree=3",
    ),
    "a homogeneous kernel": (
        lambda: fitted(st.PolynomialKernel(5, 0.0)),
        lambda: fitted(st.PolynomialKernel(5)),
        "full=False",
    ),
    "another kind of radius": (
        lambda: fitted(radius=0.3),
        lambda: fitted(radius=st.StateRadius(0.3, 0.1)),
        r"radius must be the same: saved with ConstantRadius\(\), loaded into StateRadius\(\)",
    ),
    "another number of centers": (lambda: fitted(), lambda: fitted(count=10), "number of centers"),
}


@over(OTHERS, "case")
def test_coefficients_of_another_basis_are_refused_before_anything_is_copied(case: str) -> None:
    save, load, message = OTHERS[case]
    saved, own = save(), load()
    before = {key: value.clone() for key, value in own.state_dict().items()}
    within = [nn.ModuleDict({"v": each}) for each in (saved, own)]
    for source, into in ((saved, own), within):
        for strict in (True, False):
            with pytest.raises(ValueError, match=message):
                into.load_state_dict(source.state_dict(), strict=strict)
    assert all(torch.equal(value, before[key]) for key, value in own.state_dict().items())


def test_another_width_radius_or_layout_is_loaded_with_the_coefficients() -> None:
    centers = st.StateFollowingCenters(st.ball(6, 2) * 0.7, 0.3)
    saved = st.StaF(st.StaFBasis(st.GaussianKernel(0.6), centers)).fit_(tensor(X), Paper())
    own = fitted("gaussian")
    own.load_state_dict(saved.state_dict())
    y = tensor(X) + uniform(5, 2, low=-0.3, high=0.3)
    assert torch.equal(own(y), saved(y))
    again = own.fit_(tensor(X), Paper())
    torch.testing.assert_close(again(y), saved(y), rtol=1e-12, atol=1e-12)


def test_coefficients_without_a_record_are_refused() -> None:
    bare = {key: value for key, value in fitted().state_dict().items() if "convention" not in key}
    for strict in (True, False):
        with pytest.raises(ValueError, match="earlier version of staf_torch wrote them"):
            fitted().load_state_dict(bare, strict=strict)


def test_a_file_of_a_later_version_says_why_it_is_refused() -> None:
    state = fitted().state_dict()
    later = bytes(state["basis.convention"].tolist()).replace(b'"format": 2', b'"format": 3')
    state["basis.convention"] = torch.tensor(list(later), dtype=torch.uint8)
    with pytest.raises(ValueError, match="format of the local basis must be the same: saved with 3, loaded"):
        fitted().load_state_dict(state)
    state["basis.convention"] = torch.zeros(4, dtype=torch.uint8)
    with pytest.raises(ValueError, match="is not readable"):
        fitted().load_state_dict(state)


def test_coefficients_alone_can_be_set() -> None:
    staf, own = fitted(), fitted().fit_(tensor([0.1, 0.1]), Paper())
    own.load_state_dict({"coefficients": staf.coefficients, "state": staf.state}, strict=False)
    assert torch.equal(own(tensor([X])), staf(tensor([X])))


def test_averaged_and_assigned_state_dicts_load() -> None:
    one, other = fitted(), fitted().fit_(tensor(X), lambda y: 3 * Paper()(y))
    mean = {key: 0.5 * value + 0.5 * other.state_dict()[key] for key, value in one.state_dict().items()}
    fresh = fitted()
    fresh.load_state_dict(mean)
    torch.testing.assert_close(fresh(tensor([X])), 2 * one(tensor([X])))
    assert fresh.basis.convention.dtype == torch.uint8
    with torch.device("meta"):
        bare = copy.deepcopy(one).to("meta")
    bare.load_state_dict(one.state_dict(), assign=True)
    assert torch.equal(bare(tensor([X])), one(tensor([X])))


def test_a_record_tells_all_that_coefficients_depend_on_beside_tensors() -> None:
    found = decode("f", fitted(st.AnchoredKernel(st.MaternKernel(1.5))).basis.convention)
    assert found == {
        "format": 2,
        "kernel": "AnchoredKernel(kernel=MaternKernel(smoothness=1.5))",
        "basis": "newton",
        "radius": "ConstantRadius()",
        "centers": [6, 2],
    }
    graded = decode("f", fitted().basis.convention)
    assert graded["basis"] == "graded"
    assert graded["degrees"]["reach"] == pytest.approx(1.0)
    assert [len(block) for block in graded["degrees"]["monomials"]] == [1, 2, 3]
