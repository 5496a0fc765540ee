"""A controller of a user's own carries what it likes: numbers, flags, counts, in any container, compiled."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems

PLANT = systems.TwoState()
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


class Hysteresis(adp.Controller):
    """A relay with a dead zone beside a feedback; it counts its switches."""

    def init(self, x0: Tensor) -> Any:
        mode = torch.zeros_like(x0[:, 0])
        return {"mode": mode, "switches": mode.long(), "past": (x0, mode > 0)}

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        mode = torch.where(x[:, 0] > 0.2, 1.0, torch.where(x[:, 0] < -0.2, -1.0, carried["mode"]))
        changed = mode != carried["mode"]
        u = -(0.3 * mode + x.sum(-1) + 0.1 * (x - carried["past"][0]).sum(-1))
        kept = {"mode": mode, "switches": carried["switches"] + changed.long(), "past": (x, changed)}
        return u.unsqueeze(-1), kept


@pytest.mark.needs_compiler
@pytest.mark.compiled
def test_a_state_of_ones_own_is_carried_row_by_row(caplog: pytest.LogCaptureFixture) -> None:
    x0 = torch.randn(18, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    x0[4] = torch.nan
    runs = [
        adp.simulate(Hysteresis(), PLANT, COST, x0, dt=0.02, steps=100, compile=compile)
        for compile in (True, False)
    ]
    assert not caplog.text
    torch.testing.assert_close(runs[0].state, runs[1].state, rtol=1e-10, atol=1e-10, equal_nan=True)
    assert runs[0].diverged.tolist() == [row == 4 for row in range(18)]
    assert runs[0].critic_weights.shape == (18, 101, 0)
    alone = adp.simulate(Hysteresis(), PLANT, COST, x0[2:11], dt=0.02, steps=100, compile=True)
    assert torch.equal(alone.state[0], runs[0].state[2])
    assert torch.equal(alone.state[3:], runs[0].state[5:11])


class Broken(Hysteresis):
    def __init__(self, initial: Any, after: Any) -> None:
        super().__init__()
        self.initial, self.after = initial, after

    def init(self, x0: Tensor) -> Any:
        return self.initial

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        return -x[:, :1], self.after


@pytest.mark.parametrize(
    ("initial", "after", "message"),
    [
        (torch.tensor(0.0), None, r"`Broken.init` must return tensors \(B, ...\), .* B = 3; got .* \(\)"),
        (torch.zeros(3), torch.zeros(3, 1), r"`Broken.step` must carry on .* \[\(3,\)\]; got \[\(3, 1\)\]"),
        (torch.zeros(3), (torch.zeros(3),), r"`Broken.step` must carry on what it got"),
    ],
)  # fmt: skip
def test_what_is_carried_keeps_its_form(initial: Any, after: Any, message: str) -> None:
    x0 = torch.ones(3, 2, dtype=torch.float64)
    with pytest.raises(ValueError, match=message):
        adp.simulate(Broken(initial, after), PLANT, COST, x0, dt=0.1, steps=2)


@pytest.mark.parametrize("shape", [(3,), (3, 2), (1,)])
def test_a_control_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    class Odd(adp.Controller):
        def init(self, x0: Tensor) -> Any:
            return ()

        def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
            return torch.zeros(shape, dtype=x.dtype), carried

    with pytest.raises(ValueError, match=r"\(3, 1\)"):
        adp.simulate(Odd(), PLANT, COST, torch.ones(3, 2, dtype=torch.float64), dt=0.1, steps=2)


def test_a_feedback_carries_nothing_for_any_number_of_rows() -> None:
    for rows in (1, 5):
        for part in adp.Feedback(lambda x: -x).init(torch.zeros(rows, 2)):
            assert part is None or (len(part) == rows and part.numel() == 0)


def test_a_function_of_the_state_is_a_controller_and_anything_else_is_not() -> None:
    plant, cost = systems.TwoState(), adp.QuadraticCost([1.0, 2.0], [3.0], dim=2, inputs=1)
    policy = lambda x: -3.0 * x[..., 1:]  # noqa: E731
    x0 = torch.tensor([[0.5, 0.5], [-0.2, 0.1]]).double()
    one, other = (adp.simulate(each, plant, cost, x0, steps=20) for each in (policy, adp.Feedback(policy)))
    assert torch.equal(one.state, other.state)
    with pytest.raises(
        ValueError, match=r"`simulate\(controller=...\)` must be a Controller or a function of x"
    ):
        adp.simulate(3.0, plant, cost, x0, steps=20)  # type: ignore[arg-type]


@pytest.mark.parametrize("state", [[1.0, 2.0], torch.tensor([1.0, 2.0])])
def test_weights_may_be_given_by_their_diagonal(state: object) -> None:
    cost = adp.QuadraticCost(state, [3.0], dim=2, inputs=1)  # type: ignore[arg-type]
    assert cost.q.tolist() == [[1.0, 0.0], [0.0, 2.0]]
    assert cost.r.tolist() == [[3.0]]
    with pytest.raises(ValueError, match=r"`QuadraticCost\(state=...\)`"):
        adp.QuadraticCost([1.0, 2.0, 3.0], [3.0], dim=2, inputs=1)


@pytest.mark.needs_compiler
@pytest.mark.compiled
def test_a_controller_of_much_work_is_compiled_sooner() -> None:
    calls = []

    class Busy(adp.Controller):
        def init(self, x0: Tensor) -> Tensor:
            return torch.zeros_like(x0[:, 0])

        def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
            calls.append(len(x))
            return -x[:, 1:], carried

    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    counts = []
    for work in (1.0, 1e4):
        busy = Busy()
        busy.work = work
        calls.clear()
        adp.simulate(busy, plant, cost, torch.ones(2, 2).double(), dt=0.01, steps=200)
        counts.append(len(calls))
    assert counts[0] >= 200
    assert counts[1] < 30
