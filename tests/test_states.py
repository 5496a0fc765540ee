"""What is given to a door, and what a user's function returns there: right, or one sentence by name."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, lanes, metrics, online, optim, systems, targets
from staf_torch.centers import Radius

X = torch.tensor([[0.25, 0.125], [-0.25, 0.5], [1.0, -1.0]], dtype=torch.float64)  # exact in float32
PLANT = systems.Pendulum()
CART = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
LQR = adp.LQR(PLANT, COST)
BASIS = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))
ROLLOUT = adp.RolloutPolicy.of_lqr(PLANT, COST, steps=4, horizon=0.2)
NEAR = adp.near_optimal(PLANT, COST, dt=0.05, reach="local")
WALL = adp.SafetyFilter(LQR, PLANT, lambda x, t: 1.5 - x[:, 0], dt=0.05, low=-9.0, high=9.0)
PROBLEM = adp.SampledProblem.of(PLANT, COST, dt=0.05)
PLANS = adp.RecedingHorizon(PROBLEM, steps=6, compile=False)
LAW = optim.SteepestDescent()


def square(x: Tensor) -> Tensor:
    return x.square().sum(-1)


def whole(x: Any) -> Any:
    """States as those of one time, (B, 1, n)."""
    plain = isinstance(x, Tensor) and x.layout is torch.strided and not x.is_nested and x.dim() == 2
    return x.unsqueeze(1) if plain else x


DOORS: dict[str, Callable[[Any], Any]] = {
    "LQR": LQR,
    "LQR.value": LQR.value,
    "RolloutPolicy": ROLLOUT,
    "RolloutPolicy.rollout": ROLLOUT.rollout,
    "NearOptimal": NEAR,
    "NearOptimal.value": NEAR.value,
    "SafetyFilter": lambda x: WALL.restrain(x, X[:, :1]),
    "SafetyFilter.margins": WALL.margins,
    "RecedingHorizon": PLANS.init,
    "simulate": lambda x: adp.simulate(LQR, PLANT, COST, x, dt=0.05, steps=2),
    "trajectory": lambda x: systems.simulate(PLANT, x, dt=0.05, steps=2),
    "BoxDDP.solve": lambda x: adp.BoxDDP(PROBLEM, steps=2, compile=False).solve(x),
    "chase": lambda x: st.chase(whole(x), BASIS, square, LAW),
    "chase_weights": lambda x: st.chase_weights(whole(x), BASIS, square, LAW),
    "StaF.fit_": lambda x: st.StaF(BASIS, (3,)).fit_(x, square),
    "StateFollowingCenters": BASIS.gram,
    "QuadraticCost": lambda x: COST.rate(x, X[:, :1]),
    "Pendulum": lambda x: PLANT.rate(x, X[:, :1]),
    "Linear": CART.drift,
    "kernel": lambda x: BASIS.kernel(x, X),
    "hjb_residual": lambda x: adp.hjb_residual(PLANT, COST, square, x),
}
with warnings.catch_warnings():  # torch calls both of them prototypes
    warnings.simplefilter("ignore")
    COMPRESSED, NESTED = X.to_sparse_csr(), torch.nested.nested_tensor([*X])
REFUSED: dict[str, tuple[Any, str]] = {
    "integers": ((4 * X).long(), r"floating-point tensor and is torch.int64: write `.double\(\)`; got"),
    "flags": (X > 0, r"is torch.bool: write `.double\(\)`"),
    "complex": (torch.complex(X, X), r"is torch.complex128: write `.real.double\(\)`"),
    "an array": (X.numpy(), r"must be a tensor, as by `torch.as_tensor.*an array .* of float64"),
    "a list": (X.tolist(), "must be a tensor, as by"),
    "nothing": (None, "must be a tensor, .*got None"),
    "one number": (torch.tensor(0.5, dtype=torch.float64), r"must have at least \d dimensions?; got the"),
    "sparse": (X.to_sparse(), r"must be dense; got torch.sparse_coo: write `.to_dense\(\)`"),
    "sparse rows": (COMPRESSED, r"must be dense; got torch.sparse_csr: write `.to_dense\(\)`"),
    "nested": (NESTED, "must be one dense tensor; got a nested one"),
    "other states": (torch.zeros(3, 5, dtype=torch.float64), "must have 2 entries in its last dimension"),
}


@pytest.mark.parametrize("door", list(DOORS))
def test_what_is_no_state_is_refused_by_argument_and_what_to_write(door: str) -> None:
    kinds = REFUSED if door not in ("Linear", "kernel") else [*REFUSED][:6]  # of numbers
    for kind in kinds:
        given, message = REFUSED[kind]
        with pytest.raises(ValueError, match=message) as caught:
            DOORS[door](given)
        assert str(caught.value).startswith("`"), kind
        assert "=...)`" in str(caught.value), kind


@pytest.mark.compiled
@pytest.mark.needs_compiler
def test_a_view_with_a_pending_sign_and_a_spread_row_are_the_numbers_that_they_show() -> None:
    negative = torch.complex(torch.zeros_like(X), -X).conj().imag
    assert negative.is_neg()
    assert lanes.ready(NEAR, X)
    torch.testing.assert_close(NEAR(negative), NEAR(X), rtol=1e-9, atol=0)
    assert NEAR(X[:1].expand(3, 2)).equal(NEAR(X[:1].repeat(3, 1)))


POLICIES: dict[str, Callable[[], nn.Module]] = {
    "LQR": lambda: LQR,
    "rollout": lambda: ROLLOUT,
    "near_optimal": lambda: NEAR,
    "filter": lambda: WALL,
    "bounded": lambda: adp.near_optimal(PLANT, COST, dt=0.05, low=-2.0, high=2.0, reach="local"),
}


@pytest.mark.parametrize("name", list(POLICIES))
def test_float32_states_get_the_control_of_float64_in_float32(name: str) -> None:
    policy, x = POLICIES[name](), 0.9 * X
    x = x.float().double()
    right = policy(x)
    for made in (policy, copy.deepcopy(policy).float()):
        found = made(x.float())
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), right, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("rows", [1, 2, 3, 4])
def test_a_loop_with_a_gain_a_row_is_the_loops_of_its_rows(rows: int) -> None:
    gains, x0 = torch.rand(rows, 2, dtype=torch.float64) + 1, torch.rand(rows, 2, dtype=torch.float64)

    def cost(gain: Tensor, x: Tensor) -> Tensor:
        policy = adp.Feedback(lambda x: -(gain * x).sum(-1, keepdim=True))
        return adp.simulate(policy, CART, COST, x, dt=0.02, steps=8).cost

    alone = torch.cat([cost(gains[k], x0[k : k + 1]) for k in range(rows)])
    torch.testing.assert_close(cost(gains, x0), alone, rtol=1e-12, atol=0)


class Own(systems.ControlAffineSystem):
    dim, inputs = 2, 1

    def __init__(self, mass: Tensor) -> None:
        super().__init__()
        self.mass = mass

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], -x[..., 1] / self.mass), -1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


class Paid(adp.QuadraticCost):
    def state_rate(self, x: Tensor) -> Tensor:
        return 0.0  # type: ignore[return-value]


def own(rows: int) -> Callable[[Tensor], Tensor]:
    """V with a coefficient a row."""
    numbers = torch.rand(rows, dtype=torch.float64)
    return lambda x: numbers * x.square().sum(-1)


class Flat(Radius):
    def forward(self, x: Tensor) -> Tensor:
        return 0.1 * (x.norm() if len(x) == 1 else x.abs())


class Whole(Radius):
    def forward(self, x: Tensor) -> Tensor:
        return 0.1 * x.norm()


class Turned(st.GaussianKernel):
    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return super().forward(x1, x2).mT


class Mixed(optim.SteepestDescent):
    def step(self, objective: Any, weights: Tensor, state: Any) -> Any:
        return weights + 0.1 * objective.descent(weights).mT, state


class Sideways(metrics.Metric):
    name = "sideways"

    def __call__(self, result: Any, problem: Any) -> Tensor:
        return result.estimate.mT  # type: ignore[no-any-return]


PAID = r"`Paid.state_rate` must map rows \(5, 2\) to \(5,\), .* as a tensor; got 0.0"
SIX = torch.rand(6, 4, 2, dtype=torch.float64)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: adp.simulate(LQR, Own(SIX[:3, 0, 0]), COST, X, dt=0.05, steps=2), "`Own.drift` must map"),
        (lambda: st.chase(SIX, BASIS, own(6), LAW), "`<lambda>` must map points .* row's own"),
        (lambda: adp.SampledProblem.of(CART, COST, dt=0.1, terminal=own(2)), r"\(terminal=...\)` must map"),
        (
            lambda: adp.SafetyFilter(LQR, PLANT, lambda x, t: SIX[:5, 0, 0] - x[:, 0], dt=0.05),
            r"`SafetyFilter\(constraints=...\)` number 0 .* row's own stand in",
        ),
        (lambda: adp.hjb_residual(CART, COST, own(3), X), r"\(value=...\)` must map"),
        (lambda: adp.LQR(PLANT, Paid(1.0, 1.0, 2, 1)), PAID),
        (lambda: adp.simulate(lambda x: x, CART, COST, X, dt=0.05, steps=2), r"to controls \(3, 1\)"),
        (lambda: st.chase(SIX, BASIS, lambda x: x[..., 0] > 0, LAW), "floating point; got torch.bool"),
        (lambda: st.StateFollowingCenters(st.rings(6), Flat()), r"`Flat` must map rows \(5, 2\) to \(5,\)"),
        (lambda: st.StateFollowingCenters(st.rings(6), Whole()), "`Whole` must map each state by itself"),
        (lambda: st.StaFBasis(Turned(), BASIS.centers), "`Turned.forward` must map"),
        (lambda: st.chase(SIX, BASIS, square, Mixed()), "`Mixed.step` must map"),
        (lambda: Sideways().badness(st.chase(SIX[:4], BASIS, square, LAW), None), "`Sideways` must map"),
        (lambda: torch.func.vmap(lambda s: st.chase(s, BASIS, square, LAW).estimate)(SIX[None]), "all rows"),
    ],
)
def test_what_a_users_function_returns_is_that_of_rows_whatever_their_number(
    call: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_no_rows_are_no_rows() -> None:
    assert st.StaF(BASIS, (0,)).fit_(X[:0], targets.Paper()).coefficients.shape == (0, 6)
    assert WALL(X[:0]).shape == (0, 1)
    assert WALL.margins(X[:0]).shape == (0, 1)


def step(x: Tensor, u: Tensor, row: tuple[Tensor]) -> tuple[Tensor, Tensor]:
    x = x + 0.1 * (u - row[0] * x.sin())
    return x, x


U, GAIN = torch.rand(3, 5, dtype=torch.float64), torch.rand(3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            (X[:, 0], U[:2], (GAIN,)),
            r"`Program\(now=...\)` must have 3 rows like `Program\(carry=...\)`; got",
        ),
        ((X[:, 0], U, (GAIN[:2],)), r"`Program\(row=...\)`, its row0, must have 3 rows"),
        ((X[:, 0], (U, U[:, :2]), (GAIN,)), r"its now1, must have 5 times like `Program\(now=...\)`, its"),
        ((X[:, 0].to("meta"), U, (GAIN,)), r"`Program\(now=...\)` must be on meta like"),
        ((X[:, 0], U.to_sparse(), (GAIN,)), r"`Program\(now=...\)` must be dense"),
        ((X[0, 0], U, (GAIN,)), r"`Program\(carry=...\)` must begin with rows"),
    ],
)
def test_a_program_reads_no_input_of_another_size_device_or_layout(given: Any, message: str) -> None:
    program = lanes.Program(step)
    program(X[:, 0], U, (GAIN,))  # compiled: what comes now is read by its address
    with pytest.raises(ValueError, match=message):
        program(*given)


def test_programs_and_their_prepared_calls_are_copied_and_pickled_after_a_call() -> None:
    program = lanes.Program(step)
    prepared = program.prepare(X[:, 0], U, (GAIN,))
    right = prepared(X[:, 0], U, (GAIN,))[1]
    assert copy.deepcopy(program)(X[:, 0], U, (GAIN,))[1].equal(right)
    assert copy.deepcopy(prepared)(X[:, 0], U, (GAIN,))[1].equal(right)


def test_a_regressor_reads_no_address_of_a_tensor_without_numbers() -> None:
    for kind in (st.StaFRegressor, online.MixtureRegressor):
        fitted = kind().fit(SIX[:, 0].numpy(), SIX[:, 0, 0].numpy())
        right = fitted.predict(X[0])
        assert fitted.predict(torch.complex(0 * X[0], -X[0]).conj().imag).equal(right)
        for given, message in ((X[0].to("meta"), "meta"), (NESTED, "got one that is nested")):
            with pytest.raises(ValueError, match=message):
                fitted.predict(given)
        with pytest.raises(ValueError, match=r"predict\(x=...\)` must hold all samples at once"):
            torch.func.vmap(fitted.predict)(X)
