"""`StaF` and `StaFBasis` as torch layers: shapes, gradients, transforms, copies, precision."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from helpers import basis_of, tensor, uniform
from helpers_layers import MODES, as_function, evaluated, fixed, learnable, target_of
from torch import nn
from variants import KERNELS as FIXED
from variants import LEARNABLE_KERNELS, SMOOTH_KERNELS, by_turns, learned, over
from variants import RADII as FIXED_RADII

import staf_torch as st
from staf_torch.lanes.dependencies.contents import Contents
from staf_torch.targets import Paper

BATCHES = ((), (4,), (2, 3))


@over(FIXED)
def test_every_output_is_what_it_would_be_alone(name: str) -> None:
    batch = BATCHES[list(FIXED).index(name) % 3]
    together = fixed(name, batch, 2)
    y = together.state.unsqueeze(-2) + uniform(*batch, 4, 2, low=-0.2, high=0.2)
    assert together.coefficients.shape == (*batch, 2, 6)
    k = list(FIXED).index(name) % 2
    alone = st.StaF(together.basis, batch).fit_(together.state, lambda at: target_of(2)(at)[..., k])
    torch.testing.assert_close(together.weights[..., k, :], alone.weights)
    torch.testing.assert_close(together(y)[..., k], alone(y))
    for mode in MODES[1:]:
        torch.testing.assert_close(together.gradient(y, mode)[..., k, :], alone.gradient(y, mode))
    if name in SMOOTH_KERNELS:
        torch.testing.assert_close(together.hessian(y)[..., k, :, :], alone.hessian(y))


@pytest.mark.parametrize(("name", "outputs"), by_turns(FIXED, [None, 2]))
def test_points_and_approximations_broadcast(name: str, outputs: int | None) -> None:
    trailing = () if outputs is None else (outputs,)
    one, many = fixed(name, (), outputs), fixed(name, (4,), outputs)
    y = one.state + uniform(5, 3, 2, 2, low=-0.2, high=0.2)
    assert one(y).shape == (5, 3, 2, *trailing)
    torch.testing.assert_close(one(y)[3, 1], one(y[3, 1]))
    same = y[0, 0]
    for mode in MODES:
        found = evaluated(many, same, mode, target_of(outputs))
        torch.testing.assert_close(found, evaluated(many, same.expand(4, 2, 2), mode, target_of(outputs)))
        assert found.shape[0] == 4


@pytest.mark.parametrize(
    ("name", "radius"), [(name, r) for k, name in enumerate(FIXED) for r in [*FIXED_RADII][k % 2 :: 2]]
)
def test_value_and_gradient_are_those_of_autograd(name: str, radius: str) -> None:
    x = uniform(3, 2, low=0.3)
    staf = st.StaF(basis_of(name, radius=FIXED_RADII[radius][0]()), (3,)).fit_(x, Paper())
    y = (x.unsqueeze(-2) + uniform(3, 4, 2, low=-3.0, high=3.0)).requires_grad_()  # also far outside the ball
    values, gradient = staf.value_and_gradient(y)
    assert torch.equal(staf.gradient(y), gradient)
    torch.testing.assert_close(values, staf(y), rtol=1e-13, atol=0)
    (expected,) = torch.autograd.grad(staf(y).sum(), y)
    scale = float(expected.abs().max())
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12 * scale)


ROW_BY_ROW = {
    "gaussian": st.GaussianKernel,
    "matern32": lambda v: st.MaternKernel(1.5, v),
    "rational_quadratic": lambda v: st.RationalQuadraticKernel(v, 2 * v),
    "inverse_multiquadric": st.InverseMultiquadricKernel,
    "anchored": lambda v: st.AnchoredKernel(st.GaussianKernel(v)),
}


@over(ROW_BY_ROW)
def test_a_hyperparameter_a_row_is_what_it_would_be_alone(name: str) -> None:
    widths, radii = tensor([[0.6], [0.8], [1.1]]), tensor([[0.2], [0.3], [0.4]])
    x, y = uniform(3, 4, 2, low=0.3), uniform(3, 4, 2, 2)

    def made(width: torch.Tensor, radius: torch.Tensor, batch: tuple[int, ...]) -> st.StaF:
        centers = st.StateFollowingCenters(st.rings(6), radius)
        return st.StaF(st.StaFBasis(ROW_BY_ROW[name](width), centers), batch)

    together = made(widths, radii, (3, 4)).fit_(x, Paper()).value_and_gradient(y)
    for row in range(3):
        alone = made(widths[row, 0], radii[row, 0], (4,)).fit_(x[row], Paper()).value_and_gradient(y[row])
        for found, expected in zip(together, alone, strict=True):
            torch.testing.assert_close(found[row], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "radius"),
    [("exponential", "constant"), *((name, "shrinking") for name in LEARNABLE_KERNELS)],
)
def test_gradients_reach_everything_that_is_learned_in_every_mode(name: str, radius: str) -> None:
    outputs = 2 if name in ("exponential", "user_defined") else None
    staf, y = learnable(name, radius, outputs=outputs)
    turn = [*LEARNABLE_KERNELS].index(name) % 2  # kernels take turns with the modes
    own = MODES if name == "exponential" else MODES[1 + 2 * turn :][:1]
    for mode in own if radius == "shrinking" else MODES[::2]:
        function, at = as_function(staf, mode, target_of(outputs))
        inputs = (y[:1].requires_grad_(), *at)
        assert torch.autograd.gradcheck(function, inputs, atol=1e-5, rtol=1e-4, fast_mode=True), mode


def test_second_derivatives_are_right() -> None:
    staf, y = learnable("exponential", "shrinking")
    function, at = as_function(staf, "value", Paper())
    assert torch.autograd.gradgradcheck(
        function, (y.requires_grad_(), *at), atol=1e-4, rtol=1e-3, fast_mode=True
    )


def test_the_basis_turns_smoothly_with_its_directions() -> None:
    for count in (6, 10, 15):
        staf, y = learnable("gaussian", "constant", count=count)
        before = staf(y).detach()
        with torch.no_grad():
            staf.basis.centers.directions += 1e-9 * uniform(count, 2)
        torch.testing.assert_close(staf(y).detach(), before, rtol=1e-6, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, in jacfwd
@over(FIXED)
def test_function_transforms_agree_with_the_batch(name: str) -> None:
    staf = fixed(name)
    y = staf.state + uniform(5, 2, low=-0.2, high=0.2)
    alone = lambda at: staf(at.unsqueeze(0)).squeeze(0)  # noqa: E731
    torch.testing.assert_close(torch.func.vmap(alone)(y), staf(y))
    torch.testing.assert_close(torch.func.vmap(torch.func.jacrev(alone))(y), staf.gradient(y))
    if name in SMOOTH_KERNELS:
        hessian = torch.func.vmap(torch.func.hessian(alone))(y)
        torch.testing.assert_close(hessian, staf.hessian(y), rtol=1e-7, atol=1e-7)


def test_an_ensemble_is_called_by_vmap() -> None:
    members = [learnable("matern52", "constant")[0] for _ in range(3)]
    for k, member in enumerate(members):
        with torch.no_grad():
            member.basis.centers.directions *= 1 - 0.1 * k
        member.fit_(tensor([0.4 + 0.1 * k, 0.3]), Paper())
    y = uniform(4, 2)
    parameters, buffers = torch.func.stack_module_state(members)

    def call(p: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.func.functional_call(members[0], (p, b), (y,))

    together = torch.func.vmap(call)(parameters, buffers)
    torch.testing.assert_close(together, torch.stack([member(y) for member in members]))


def test_the_largest_reach_is_nothing_for_a_kernel_that_does_not_mind() -> None:
    x = tensor([[300.0, 0.0], [math.nan, 0.0], [3.0, 4.0]])
    assert basis_of("gaussian").largest_reach(x) == 0
    assert basis_of("exponential", radius=0.5).largest_reach(x) == pytest.approx(150)
    assert basis_of("exponential", radius=0.5).largest_reach(x[1:2]) == 0


# As modules.


@over(LEARNABLE_KERNELS)
def test_parameters_are_learned_and_tensors_are_fixed(name: str) -> None:
    staf, _ = learnable(name, "shrinking")
    learnt = {key.rsplit(".", 1)[-1] for key, _ in staf.named_parameters()}
    assert {"coefficients", "directions", "radius", "offset", "gain"} <= learnt
    assert [key for key, _ in fixed("gaussian").named_parameters()] == ["coefficients"]
    frozen = st.StaF(basis_of("gaussian"), learnable=False).fit_(tensor([0.5, 0.2]), Paper())
    assert not list(frozen.parameters())
    assert "coefficients" in frozen.state_dict()


class _Exp(nn.Module):
    def forward(self, raw: torch.Tensor) -> torch.Tensor:
        return raw.exp()

    def right_inverse(self, value: torch.Tensor) -> torch.Tensor:
        return value.log()


def _parametrised(width: float) -> st.StaF:
    kernel = st.GaussianKernel(learned(width))
    nn.utils.parametrize.register_parametrization(kernel, "width", _Exp())
    return st.StaF(st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(3), 0.3)))


def test_a_parametrised_width_is_learned_copied_and_loaded() -> None:
    staf = _parametrised(0.8)
    kernel = staf.basis.kernel
    y = staf.fit_(tensor([0.4, 0.3]), Paper()).state.unsqueeze(0) + 0.1
    staf(y).sum().backward()
    assert float(kernel.width.detach()) == pytest.approx(0.8)
    assert float(kernel.parametrizations.width.original.grad) != 0
    other = copy.deepcopy(staf)
    loaded = _parametrised(0.5)
    loaded.load_state_dict(staf.state_dict())
    assert torch.equal(other(y), staf(y))
    assert torch.equal(loaded(y), staf(y))
    with torch.no_grad():
        kernel.parametrizations.width.original.add_(0.1)
    assert torch.equal(other(y), loaded(y))
    assert not torch.equal(other(y), staf(y))
    with pytest.raises(RuntimeError, match="state_dict"):  # torch's own rule
        pickle.dumps(staf)


def test_modules_of_one_parametrisation_share_their_programs() -> None:
    assert Contents(_parametrised(0.8)).key == Contents(_parametrised(0.5)).key is not None


def test_a_copy_keeps_the_target_and_a_pickle_leaves_one_behind_that_has_no_name() -> None:
    staf = fixed("gaussian", (2,)).fit_(uniform(2, 2, low=0.3), lambda y: Paper()(y))
    y = staf.state.unsqueeze(-2) + uniform(2, 3, 2, low=-0.2, high=0.2)
    copied, pickled = copy.deepcopy(staf), pickle.loads(pickle.dumps(staf))
    assert torch.equal(copied.gradient(y, "total"), staf.gradient(y, "total"))
    with pytest.raises(ValueError, match="needs a target"):
        pickled.gradient(y, "total")
    assert torch.equal(pickled(y), staf(y))


@pytest.mark.parametrize("name", ["exponential", "matern52", "polynomial"])
def test_a_layer_takes_dtype_and_device(name: str) -> None:
    single = st.StaF(basis_of(name), (2,), dtype=torch.float32)
    assert single.coefficients.dtype == single.state.dtype == torch.float32
    single.fit_(uniform(2, 2, low=0.3).float(), Paper())
    assert single(uniform(2, 3, 2).float()).dtype == torch.float32
    shape = st.StaF(basis_of(name), (2,), 3, device="meta")
    assert shape.coefficients.is_meta
    assert shape.to("meta")(torch.zeros(2, 5, 2, device="meta")).shape == (2, 5, 3)


@pytest.mark.parametrize("name", ["exponential", "matern52", "polynomial"])
def test_evaluation_leaves_the_module_alone(name: str) -> None:
    staf = fixed(name, (2,))
    before = {key: (id(value), value.clone()) for key, value in staf.state_dict(keep_vars=True).items()}
    attributes = {key: id(value) for key, value in vars(staf.basis).items()}
    for mode in MODES:
        evaluated(staf, uniform(2, 3, 2), mode, Paper())
    for key, value in staf.state_dict(keep_vars=True).items():
        assert id(value) == before[key][0]
        assert torch.equal(value, before[key][1])
    assert {key: id(value) for key, value in vars(staf.basis).items()} == attributes


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


def test_a_target_of_another_number_of_outputs_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(6, 2\) must give \(6, 2\); got \(6,\)"):
        st.StaF(basis_of("gaussian"), (), 2).fit_(uniform(2), Paper())


def test_points_of_another_batch_are_refused_with_both_numbers() -> None:
    staf, y = fixed("gaussian", (5,)), uniform(7, 3, 2)
    for call in (staf, staf.gradient, staf.hessian, staf.at_offsets):
        with pytest.raises(ValueError, match="is for 7 states, but the coefficients are for 5 states"):
            call(y)
    with pytest.raises(ValueError, match=r"`StaFBasis\(y=...\)` is for 7 states, but x is for 5 states"):
        staf.basis(y, staf.state)
    space = staf.basis.local(staf.state)
    weights = uniform(7, staf.basis.count)
    for name, refused in (
        ("values", lambda: space.fit(weights)),
        ("z", lambda: space.evaluate(y, weights[:5])),
        ("coefficients", lambda: space.evaluate(y[:5], weights)),
        ("weights", lambda: staf.basis.excess(weights, staf.state, Paper())),
    ):
        with pytest.raises(ValueError, match=rf"\({name}=...\)` is for 7 states, but x is for 5 states"):
            refused()
