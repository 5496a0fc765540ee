"""Plants and their trajectories."""

from __future__ import annotations

import itertools
import math
import re
import sys

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn
from variants import SYSTEMS, over

from staf_torch import systems
from staf_torch.numerics.linalg import riccati
from staf_torch.systems import simulate, trajectory


class Integrated(systems.ControlAffineSystem):
    """A plant stripped of its exact flow."""

    def __init__(self, plant: systems.ControlAffineSystem) -> None:
        super().__init__()
        self.plant, self.dim = plant, plant.dim

    def drift(self, x: Tensor) -> Tensor:
        return self.plant.drift(x)


class Plain(nn.Module):
    """A user's plant that knows nothing of the library: x' = -x^3 + u."""

    def drift(self, x: Tensor) -> Tensor:
        return -(x**3)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.ones(*x.shape, 1).to(x)


class Escape(systems.ControlAffineSystem):
    """x' = x^2, which escapes from x(0) > 0 at t = 1 / x(0)."""

    def drift(self, x: Tensor) -> Tensor:
        return x**2


@over(SYSTEMS)
def test_exact_flow_solves_the_differential_equation(name: str) -> None:
    plant = SYSTEMS[name]()
    x0, t, h = uniform(4, 2), 0.7, 1e-6
    before, at, after = plant.flow(x0, tensor([t - h, t, t + h])).unbind(-2)
    torch.testing.assert_close((after - before) / (2 * h), plant.drift(at), rtol=1e-8, atol=1e-8)
    assert torch.equal(plant.flow(x0, tensor([0.0])).squeeze(-2), x0)


@over(SYSTEMS)
def test_runge_kutta_is_of_fourth_order(name: str) -> None:
    plant = SYSTEMS[name]()
    x0 = uniform(3, 2)
    exact = simulate(plant, x0, dt=1.0, steps=1)[:, -1]
    errors = [
        float((simulate(Integrated(plant), x0, dt=1 / n, steps=n)[:, -1] - exact).norm())
        for n in (16, 32, 64)
    ]
    slopes = [math.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)]
    assert slopes == pytest.approx([4.0, 4.0], abs=0.25)


@over(SYSTEMS)
@pytest.mark.parametrize(("exact", "chunk"), [(True, 1), (False, 3), (True, 10), (False, 100)])
def test_pieces_together_are_the_whole(name: str, exact: bool, chunk: int) -> None:
    plant = SYSTEMS[name]() if exact else Integrated(SYSTEMS[name]())
    x0 = uniform(2, 2)
    whole = simulate(plant, x0, dt=0.1, steps=20)
    pieces = list(trajectory(plant, x0, dt=0.1, steps=20, chunk=chunk))
    assert whole.shape == (2, 21, 2)
    assert all(piece.shape[1] <= chunk for piece in pieces)
    torch.testing.assert_close(torch.cat(pieces, dim=1), whole, rtol=1e-15, atol=1e-15)
    assert torch.equal(whole[:, 0], x0)


@over(SYSTEMS)
def test_rows_are_as_they_would_be_alone(name: str) -> None:
    x0 = uniform(5, 2)
    for plant in (SYSTEMS[name](), Integrated(SYSTEMS[name]())):
        together = simulate(plant, x0, dt=0.05, steps=30)
        for row in range(5):
            alone = simulate(plant, x0[row : row + 1], dt=0.05, steps=30)[0]
            torch.testing.assert_close(together[row], alone, rtol=1e-14, atol=1e-15)


def test_linear_system_of_any_size_flows_as_its_matrix_exponential() -> None:
    matrix = uniform(4, 4)
    plant = systems.Linear(matrix)
    x0 = uniform(3, 4)
    states = simulate(plant, x0, dt=0.3, steps=5)
    torch.testing.assert_close(
        states[:, 5], x0 @ torch.linalg.matrix_exp(1.5 * matrix).mT, rtol=1e-12, atol=1e-13
    )
    assert plant.dim == 4


def test_a_plain_module_of_the_user_is_integrated() -> None:
    states = simulate(Plain(), tensor([[1.0], [-0.5]]), dt=0.01, steps=100)  # type: ignore[arg-type]
    t = torch.arange(101).double() * 0.01
    for row, start in enumerate((1.0, -0.5)):
        expected = start / (1 + 2 * start**2 * t).sqrt()
        torch.testing.assert_close(states[row, :, 0], expected, rtol=1e-9, atol=0)


def test_a_trajectory_that_escapes_leaves_the_others_alone() -> None:
    x0 = tensor([[0.1], [50.0], [0.2]])
    states = simulate(Escape(), x0, dt=0.05, steps=60)
    assert not torch.isfinite(states[1, -1]).any()
    assert torch.isfinite(states[[0, 2]]).all()
    torch.testing.assert_close(
        states[[0, 2]], simulate(Escape(), x0[[0, 2]], dt=0.05, steps=60), rtol=0, atol=0
    )
    first = int((~torch.isfinite(states[1, :, 0])).nonzero()[0])
    assert not torch.isfinite(states[1, first:]).any()


def test_trajectories_can_be_differentiated() -> None:
    plant = Integrated(systems.Oscillator())
    x0 = uniform(2, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda at: simulate(plant, at, dt=0.2, steps=4), (x0,))


class Wrong(Escape):
    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros(1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: systems.Linear([[1.0, 0.0]]), "`Linear(matrix=...)` must have 1 entries"),
        (lambda: systems.Linear("A"), "`Linear(matrix=...)` must be (n, n); got 'A'."),
        (lambda: systems.Linear([[math.nan]]), "`Linear(matrix=...)` must be finite; got [nan]."),
        (
            lambda: simulate(systems.Oscillator(), uniform(1, 3), dt=0.1, steps=1),
            "must have 2 entries in its",
        ),
        (lambda: simulate(Wrong(), uniform(1, 2), dt=0.1, steps=1), "(1, 2) must give the same; got (1,)."),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


def test_a_riccati_equation_needs_no_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.linalg", None)
    one = torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(riccati(one, one, one, one), (1 + 2**0.5) * one, rtol=1e-15, atol=0)


def test_a_missing_mujoco_is_named_with_the_extra_that_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'staf_torch\[mujoco\]'"):
        systems.MujocoPlant("<mujoco/>")


def of_a_quadrotor(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    speed = x[:, 3:].square()
    energy = 0.65 * (speed[:, 0] + speed[:, 1]) + 0.1 * speed[:, 2] + 1.3 * 9.0 * x[:, 1]
    along = -x[:, 2].sin() * x[:, 3] + x[:, 2].cos() * x[:, 4]  # its speed along its own axis
    return energy, (1.3 * 9.0 + u[:, 0]) * along + u[:, 1] * x[:, 5]


def of_a_pendulum(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    energy = 0.5 * 1.3 * 0.7**2 * x[:, 1].square() + 1.3 * 9.0 * 0.7 * x[:, 0].cos()
    return energy, u[:, 0] * x[:, 1] - 0.4 * x[:, 1].square()  # less friction


def of_a_cart(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    _, angle, speed, turning = x.unbind(-1)
    across = 0.3 * 0.4 * turning * angle.cos()
    rod = 0.5 * (4 / 3) * 0.3 * 0.4**2 * turning.square()  # about its end
    energy = 0.5 * (1.7 + 0.3) * speed.square() + speed * across + rod + 0.3 * 9.0 * 0.4 * angle.cos()
    return energy, u[:, 0] * speed


ENERGIES = {
    "quadrotor": (systems.PlanarQuadrotor(mass=1.3, inertia=0.2, gravity=9.0), of_a_quadrotor),
    "pendulum": (systems.Pendulum(1.3, 0.7, 0.4, 9.0), of_a_pendulum),
    "cart": (systems.CartPole(1.7, 0.3, 0.4, 9.0), of_a_cart),
}


@over(ENERGIES)
def test_inputs_pay_for_the_energy_of_a_plant(name: str) -> None:
    plant, of = ENERGIES[name]
    x, u = 3 * uniform(20, plant.dim, seed=1).requires_grad_(), uniform(20, plant.inputs, seed=2)
    energy, power = of(x, u)
    (slope,) = torch.autograd.grad(energy.sum(), x, retain_graph=True)
    torch.testing.assert_close((slope * plant.rate(x, u)).sum(-1), power)
