"""How far a state may move before its local functions say nothing of the new place."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor

import staf_torch as st
from staf_torch.online.local_functions import LocalFunctions

OFFSETS = 0.5 * torch.cat((st.cross_polytope(2), torch.zeros(1, 2, dtype=torch.float64)))


@pytest.mark.parametrize(
    ("kernel", "most"), [(st.ExponentialKernel(), 2.0), (st.InverseMultiquadricKernel(1.0), 5e7)]
)
def test_beyond_its_reach_a_kernel_says_nothing(kernel: st.Kernel, most: float) -> None:
    """Four radii where the scale of a kernel grows with the state, and 1e8 for any."""
    functions = LocalFunctions.of(kernel, OFFSETS)
    steps = tensor([[0.0, most], [most * (1 - 1e-9), 0.0], [0.0, -most * (1 + 1e-9)], [3 * most, 0.0]])
    transfer, factor = functions.transfer(torch.zeros_like(steps.mT), steps.mT)
    largest = transfer.abs().amax((0, 1))
    assert (largest > 0).tolist() == [True, True, False, False]
    if factor is not None:
        gains = (steps.square().sum(-1) / 2).exp()  # of e^{x'x / 2}, the amplitude at a state
        wanted = torch.where(largest > 0, gains, 1.0)
        torch.testing.assert_close(factor, wanted)


@pytest.mark.parametrize("step", [1.0, 36.0, 40.0, 1e4, 1e7])
@pytest.mark.parametrize("radius", [18.0, 20.0])
def test_a_move_between_centers_that_are_far_apart_overflows_nothing(step: float, radius: float) -> None:
    functions = LocalFunctions.of(st.GaussianKernel(1.0), radius * st.cross_polytope(2))
    transfer, factor = functions.transfer(torch.zeros(2, 1).double(), tensor([[step], [0.0]]))
    assert factor is None
    found = transfer[..., 0]
    assert float(torch.linalg.matrix_norm(found, 2)) <= 1 + 1e-9
    if radius == 18:  # the functions are the kernels themselves, in another order
        between = functions.kernel(functions.offsets + tensor([step, 0.0]), functions.offsets)
        wanted = between.flatten().sort().values
        torch.testing.assert_close(found.flatten().sort().values, wanted, rtol=0, atol=1e-9)


def test_functions_of_single_precision_stay_so_and_a_center_alone_will_do() -> None:
    alone = OFFSETS[:1]
    for kernel in (st.GaussianKernel(0.8), st.MaternKernel(), st.ExponentialKernel(), st.PolynomialKernel(2)):
        functions = LocalFunctions.of(kernel, alone)
        x, z = torch.zeros(2, 3), 0.1 * torch.ones(2, 3)
        local = functions.local(x, z)
        prior = torch.as_tensor(functions.prior(x, z))
        assert local.psi.dtype == torch.float32
        assert local.psi.shape == (1, 3)
        assert bool((local.psi[0].square() <= prior * (1 + 1e-5)).all())
        transfer, _ = functions.transfer(x, z)
        assert (transfer.dtype, transfer.shape) == (torch.float32, (1, 1, 3))
        assert float(transfer.abs().max()) <= 1 + 1e-6


class Dense(st.ExponentialKernel):
    """Which says nothing of its exponent."""

    def exponent_rate(self) -> None:  # type: ignore[override]
        return None


class AnyState(st.ExponentialKernel):
    """Which says that its core may depend on the state."""

    state_free = False


class AnyStateGaussian(st.GaussianKernel):
    """The same without a gain."""

    state_free = False


KERNELS = {
    "exponential": st.ExponentialKernel(),
    "exponential, dense": Dense(),
    "exponential of any state": AnyState(),
    "gaussian": st.GaussianKernel(0.7),
    "gaussian of any state": AnyStateGaussian(0.7),
    "matern": st.MaternKernel(),
    "inverse multiquadric": st.InverseMultiquadricKernel(0.8),
    "rational quadratic": st.RationalQuadraticKernel(),
    "polynomial": st.PolynomialKernel(2),
}


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_function_of_the_old_span_and_its_move_agree_at_the_new_centers(kernel: str) -> None:
    """e^f e^{s(x + h, d)} psi'(d) T = e^{s(x, h + d)} psi(h + d), five streams of three centers."""
    functions = LocalFunctions.of(KERNELS[kernel], 0.5 * st.rings(3))
    draw = torch.Generator().manual_seed(2)
    x, h = (scale * torch.randn(2, 5, generator=draw, dtype=torch.float64) for scale in (0.8, 0.4))
    transfer, factor = functions.transfer(x, h)
    assert (factor is None) == (KERNELS[kernel].log_gain(x.mT) is None)

    def at_centers(state: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        """e^s psi at the centers of every stream, shifted: (M, M, S)."""
        rows = []
        for d in functions.offsets:
            z = shift + d[:, None]
            s = functions.log_factor(state, z)
            rows.append(functions.functions(state, z) * (1.0 if s is None else s.exp()))
        return torch.stack(rows)

    moved = torch.einsum("ijs,jks->iks", at_centers(x + h, torch.zeros_like(h)), transfer)
    moved = moved if factor is None else moved * factor
    torch.testing.assert_close(moved, at_centers(x, h), rtol=1e-8, atol=1e-9)
    norms = torch.linalg.matrix_norm(transfer.permute(2, 0, 1), 2)
    assert bool((norms <= 1 + 1e-9).all())
    if factor is not None:  # the root of the kernel's e^{|x + h|^2 - |x|^2}
        torch.testing.assert_close(factor, ((x + h).square().sum(0) - x.square().sum(0)).div(2).exp())


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_a_process_is_made_of_is_the_kernel_between_points(kernel: str) -> None:
    """At the centers psi psi' is the kernel itself, its gain left out; elsewhere k(z, z) is what is left."""
    functions, own = LocalFunctions.of(KERNELS[kernel], 0.5 * st.rings(3)), KERNELS[kernel]
    x = torch.tensor([[0.3, -0.2], [0.5, 0.9]]).double()
    points = torch.cat((functions.offsets, tensor([[0.6, -0.4]])))
    rows, priors = [], []
    for d in points:
        z = d[:, None].expand(2, 2)
        local = functions.local(x, z)
        by = torch.ones(2).double() if local.log_factor is None else local.log_factor.exp()
        rows.append(by * local.psi)
        priors.append(by**2 * functions.prior(x, z))
    for stream in range(2):
        state = x[:, stream]
        gain = own.log_gain(state)
        whole = own(state + points, state + points) * (1.0 if gain is None else (-gain).exp())
        psi = torch.stack([row[:, stream] for row in rows])
        torch.testing.assert_close((psi @ psi.mT)[:3], whole[:3], rtol=1e-8, atol=1e-9)
        found = torch.stack([torch.as_tensor(each).expand(2)[stream] for each in priors])
        torch.testing.assert_close(found, whole.diagonal())
