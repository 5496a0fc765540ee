"""`StaF` and `StaFBasis` as torch modules: parameters, copies, precision, devices, no hidden state."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
from helpers import basis_of, tensor, uniform
from helpers_layers import MODES, evaluated, fixed, learnable
from torch import nn
from variants import KERNELS as FIXED
from variants import LEARNABLE_KERNELS, learned, over

import staf_torch as st
from staf_torch.targets import Paper


@over(LEARNABLE_KERNELS)
def test_parameters_are_learned_and_tensors_are_fixed(name: str) -> None:
    staf, _ = learnable(name, "shrinking")
    learnt = {key.rsplit(".", 1)[-1] for key, _ in staf.named_parameters()}
    assert {"coefficients", "directions", "radius", "offset", "gain"} <= learnt
    assert [key for key, _ in fixed("gaussian").named_parameters()] == ["coefficients"]
    frozen = st.StaF(basis_of("gaussian"), learnable=False).fit_(tensor([0.5, 0.2]), Paper())
    assert not list(frozen.parameters())
    assert "coefficients" in frozen.state_dict()


def test_a_parametrised_width_is_constrained_and_learned() -> None:
    class Exp(nn.Module):
        def forward(self, raw: torch.Tensor) -> torch.Tensor:
            return raw.exp()

    kernel = st.GaussianKernel(learned(0.8))
    nn.utils.parametrize.register_parametrization(kernel, "width", Exp(), unsafe=True)
    staf = st.StaF(st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(3), 0.3)))
    y = staf.fit_(tensor([0.4, 0.3]), Paper()).state.unsqueeze(0) + 0.1
    staf(y).sum().backward()
    assert float(kernel.width.detach()) == pytest.approx(2.718281828459045**0.8)
    assert float(kernel.parametrizations.width.original.grad) != 0


@over(FIXED)
def test_copies_are_the_same_function_and_apart(name: str) -> None:
    staf = fixed(name, (2,)).fit_(uniform(2, 2, low=0.3), lambda y: Paper()(y))
    y = staf.state.unsqueeze(-2) + uniform(2, 3, 2, low=-0.2, high=0.2)
    before = staf(y).detach()
    saved = io.BytesIO()
    if name != "user_defined":
        torch.save(staf, saved)
        saved.seek(0)
        assert torch.equal(torch.load(saved, weights_only=False)(y), before)
    copied, pickled = copy.deepcopy(staf), pickle.loads(pickle.dumps(staf))
    assert torch.equal(copied.gradient(y, "total"), staf.gradient(y, "total"))
    with pytest.raises(ValueError, match="needs a target"):  # a lambda could not be pickled
        pickled.gradient(y, "total")
    staf.reset_parameters()
    assert torch.equal(staf(y), torch.zeros(2, 3).double())
    assert torch.equal(copied(y), before)
    assert torch.equal(pickled(y), before)


@over(FIXED)
def test_precision_is_changed_and_changed_back(name: str) -> None:
    staf = fixed(name, (2,))
    y = staf.state.unsqueeze(-2) + uniform(2, 3, 2, low=-0.2, high=0.2)
    expected = staf(y).detach()
    staf.float()
    assert staf(y.float()).dtype == staf.gradient(y.float()).dtype == torch.float32
    torch.testing.assert_close(staf(y.float()).double(), expected, rtol=1e-2, atol=1e-2)
    staf.to(torch.float64)
    centers = staf.fit_(staf.state.clone(), Paper()).basis.centers(staf.state)
    torch.testing.assert_close(staf(centers), Paper()(centers), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["exponential", "matern52", "polynomial"])
def test_a_layer_takes_dtype_and_device(name: str) -> None:
    single = st.StaF(basis_of(name), (2,), dtype=torch.float32)
    assert single.coefficients.dtype == single.state.dtype == torch.float32
    single.fit_(uniform(2, 2, low=0.3).float(), Paper())
    assert single(uniform(2, 3, 2).float()).dtype == torch.float32
    shape = st.StaF(basis_of(name), (2,), 3, device="meta")
    assert shape.coefficients.is_meta
    assert shape.to("meta")(torch.zeros(2, 5, 2, device="meta")).shape == (2, 5, 3)


def test_evaluation_leaves_the_module_alone() -> None:
    for name in FIXED:
        staf = fixed(name, (2,))
        y = uniform(2, 3, 2)
        tensors = {**dict(staf.named_parameters()), **dict(staf.named_buffers())}
        before = {key: (id(value), value._version) for key, value in tensors.items()}
        attributes = {key: id(value) for key, value in vars(staf.basis).items()}
        for mode in MODES:
            evaluated(staf, y, mode, Paper())
        tensors = {**dict(staf.named_parameters()), **dict(staf.named_buffers())}
        assert {key: (id(value), value._version) for key, value in tensors.items()} == before
        assert {key: id(value) for key, value in vars(staf.basis).items()} == attributes
        staf.load_state_dict(staf.state_dict())


def test_distributed_data_parallel_trains_a_layer() -> None:
    import torch.distributed as dist

    dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
    try:
        staf, y = learnable("gaussian", "shrinking")
        plain = copy.deepcopy(staf)
        nn.parallel.DistributedDataParallel(staf)(y).square().sum().backward()
        plain(y).square().sum().backward()
        for (key, found), expected in zip(staf.named_parameters(), plain.parameters(), strict=True):
            torch.testing.assert_close(found.grad, expected.grad, msg=key)
    finally:
        dist.destroy_process_group()


def test_repr_says_what_is_configured() -> None:
    text = repr(st.StaF(basis_of("gaussian"), (2,), 3, learnable=False))
    for part in ("batch_shape=(2,), out_features=3, learnable=False", "count=6, dim=2", "width=0.8"):
        assert part in text


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: st.StaF(3), r"`StaF\(basis=...\)` must be a StaFBasis; got 3."),
        (lambda: st.StaF(basis_of("gaussian"), out_features=0), r"out_features=...\)` must be at least 1"),
        (lambda: st.StaF(basis_of("gaussian"), learnable=1), r"learnable=...\)` must be true or false"),
        (
            lambda: st.StaF(basis_of("gaussian"), (), 2).fit_(uniform(2), Paper()),
            r"values of shape \(..., 2\): \(6, 2\) must give \(6, 2\); got \(6,\)",
        ),
        (lambda: st.GaussianKernel(learned(-1.0)), r"`GaussianKernel\(width=...\)` must be positive"),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        make()
