"""Numbers of a row's own: a batch of B plants, costs, kernels, laws, filters is the loop of B single ones."""

from __future__ import annotations

import copy
import math
import pickle
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers_rows import CASES, ROWS
from torch import Tensor, nn
from variants import by_turns

import staf_torch as st
from staf_torch import adp, deploy, lanes, optim, systems
from staf_torch.lanes.tree import flatten

FEW = 3


def spread(low: Any, high: Any, rows: int = FEW) -> Tensor:
    """Numbers (B, ...) from ``low`` to ``high``."""
    first, last = (torch.tensor(end, dtype=torch.float64) for end in (low, high))
    share = torch.linspace(0.0, 1.0, rows, dtype=torch.float64).reshape(-1, *[1] * first.dim())
    return first + share * (last - first)


class Spring(systems.ControlAffineSystem):
    """A user's plant, whose number is a buffer."""

    dim, inputs = 2, 1

    def __init__(self, stiffness: Tensor) -> None:
        super().__init__()
        self.register_buffer("stiffness", torch.as_tensor(stiffness, dtype=torch.float64))

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], -self.get_buffer("stiffness") * x[..., 0] - 0.1 * x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


@pytest.fixture(params=["always", "never"])
def either(request: pytest.FixtureRequest) -> Any:
    with lanes.compiling(request.param):
        yield request.param


@pytest.mark.parametrize(("name", "rows"), by_turns(CASES, (2, ROWS, 1, 2)))
def test_everything_with_numbers_of_rows_is_the_loop_of_single_ones(name: str, rows: int) -> None:
    case, real = CASES[name], torch.float32 if rows == ROWS else torch.float64
    names, draw = [*case.numbers], random.Random(name)
    own = draw.sample(names, draw.randint(1, len(names)))  # the others are one number for all rows
    numbers = {key: spread(*case.numbers[key], rows) for key in names}
    told = {key: st.rows(value) if key in own else value[0].tolist() for key, value in numbers.items()}
    with lanes.compiling("never"):
        many = flatten(case.run(**told)(slice(0, rows), real))[0]
        for row in {0, rows - 1}:
            single = {key: value[row if key in own else 0].tolist() for key, value in numbers.items()}
            alone = flatten(case.run(**single)(slice(row, row + 1), real))[0]
            scale = 1e7 if real == torch.float32 else 1
            for found, wanted in zip(many, alone, strict=True):
                close = case.tolerance * (scale if case.tolerance else 1)
                torch.testing.assert_close(found[row], wanted[0], rtol=close, atol=close, equal_nan=True)


@pytest.mark.parametrize("name", ["pendulum", "quadratic_cost", "state_radius", "information"])
def test_numbers_of_rows_are_columns_of_compiled_code_in_which_a_row_has_the_bits_that_it_has_alone(
    name: str,
) -> None:
    case = CASES[name]
    numbers = {key: spread(*ends, ROWS) for key, ends in case.numbers.items()}
    with lanes.compiling("always"):
        run = case.run(**{key: st.rows(value) for key, value in numbers.items()})
        many = flatten(run(slice(0, ROWS), torch.float64))[0]
        single = case.run(**{key: st.rows(value[4:5]) for key, value in numbers.items()})
        alone = flatten(single(slice(4, 5), torch.float64))[0]
    for found, wanted in zip(many, alone, strict=True):
        torch.testing.assert_close(found[4], wanted[0], rtol=0, atol=0, equal_nan=True)


def test_a_users_plant_and_cost_run_in_a_closed_loop_under_a_policy_for_all_and_one_each(either: str) -> None:
    stiff, q, x0 = spread(0.5, 4.0), spread(1.0, 3.0), torch.tensor([[1.0, 0.0]]).double().expand(FEW, 2)
    plant, cost = Spring(st.rows(stiff)), adp.QuadraticCost(st.rows(q), 1.0, 2, 1, low=-2.0, high=2.0)
    nominal = adp.LQR(Spring(torch.tensor(1.0)), adp.QuadraticCost(1.0, 1.0, 2, 1))
    own = adp.LQR(plant, cost)
    one = [
        (Spring(k), adp.QuadraticCost(float(w), 1.0, 2, 1, low=-2.0, high=2.0))
        for k, w in zip(stiff, q, strict=True)
    ]
    for policies in ([nominal] * FEW, [adp.LQR(*each) for each in one]):
        shared = policies[0] is nominal
        run = adp.simulate(nominal if shared else own, plant, cost, x0, dt=0.02, steps=20)
        for row, (policy, each) in enumerate(zip(policies, one, strict=True)):
            alone = adp.simulate(policy, *each, x0[row : row + 1], dt=0.02, steps=20)
            torch.testing.assert_close(run.state[row], alone.state[0], rtol=1e-14, atol=1e-14)
            torch.testing.assert_close(run.cost[row], alone.cost[0], rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(own(x0), torch.cat([adp.LQR(*each)(x0[:1]) for each in one]))


def test_scenes_with_discs_of_their_own_stand_behind_one_filter() -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    cost, walls = adp.QuadraticCost(1.0, 1.0, 2, 1), spread(-0.3, 0.1)
    lqr, x0 = adp.LQR(plant, cost), torch.tensor([[1.0, -1.0]]).double().expand(FEW, 2)

    def safe(wall: Tensor) -> adp.SafetyFilter:
        return adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] - wall, dt=0.05, low=-3.0, high=3.0)

    with lanes.compiling("always"):
        run = adp.simulate(safe(st.rows(walls)), plant, cost, x0, steps=30)
        alone = adp.simulate(safe(walls[2]), plant, cost, x0[:1], steps=30)
    assert torch.equal(run.state[2], alone.state[0])


def test_a_program_of_a_users_own_takes_columns_and_other_numbers_need_no_compiler() -> None:
    def program(gain: Tensor, matrix: Tensor) -> lanes.Program:
        def step(x: Tensor, u: Tensor, row: object) -> tuple[Tensor, Tensor]:
            x = x + 0.01 * (gain * x.sin() + (x @ matrix.mT) + u.unsqueeze(-1))
            return x, x.square().sum(-1)

        return lanes.Program(step)

    for rows, dtype in ((1, torch.float64), (2, torch.float64), (7, torch.float32), (100, torch.float64)):
        gain, matrix = torch.rand(rows, dtype=dtype), torch.randn(rows, 2, 2, dtype=dtype)
        x0, u = torch.randn(rows, 2, dtype=dtype), torch.randn(rows, 5, dtype=dtype)
        gain[-1] = torch.nan
        made = program(st.rows(gain), st.rows(matrix))
        x, out = made(x0, u)
        assert made.compiled
        want, told = made.definition(x0, u)
        torch.testing.assert_close(x, want, equal_nan=True)
        torch.testing.assert_close(out, told, equal_nan=True)
        assert bool(x[-1].isnan().all())  # its own row alone
        assert not bool(x[:-1].isnan().any())
        alone, _ = program(st.rows(gain[:1]), st.rows(matrix[:1]))(x0[:1], u[:1])
        torch.testing.assert_close(alone[0], x[0], rtol=0, atol=0, equal_nan=True)
        gain.fill_(0.0)
        torch.testing.assert_close(made(x0, u)[0], made.definition(x0, u)[0])
    with pytest.raises(ValueError, match=r"a batch of 3 rows met `rows\(\.\.\.\)` of 100"):
        made(x0[:3], u[:3])


def test_modules_of_one_class_become_one_with_the_numbers_of_all() -> None:
    plants, x = [systems.Pendulum(mass=m) for m in (1.0, 2.0)], torch.randn(2, 2).double()
    many = st.rows(plants)
    assert torch.equal(many.drift(x), torch.stack([p.drift(x[k]) for k, p in enumerate(plants)]))
    u = torch.randn(2, 1).double()
    assert torch.equal(many.rate(x, u=u), torch.stack([p.rate(x[k], u[k]) for k, p in enumerate(plants)]))
    assert many.drift(x[0]).shape == (2, 2)  # a point without rows is for all
    nets = [nn.Linear(2, 1).double() for _ in range(2)]
    step = lanes.Program(lambda x, _, row: (x, net(x)))
    net = st.rows(nets)
    with torch.no_grad():
        for found in (step(x, steps=1)[1], step.definition(x, steps=1)[1]):
            torch.testing.assert_close(found[:, 0], torch.stack([n(x[k]) for k, n in enumerate(nets)]))
    with pytest.raises(ValueError, match="or modules of one class; got Pendulum, VanDerPol"):
        st.rows([systems.Pendulum(), systems.VanDerPol()])


def test_a_batch_of_another_size_is_refused_with_both_numbers() -> None:
    plant, cost = systems.Pendulum(mass=st.rows(torch.ones(FEW).double())), adp.QuadraticCost(1.0, 1.0, 2, 1)
    x0, policy = torch.rand(FEW + 1, 2).double(), adp.LQR(systems.Pendulum(), cost)
    for run in (
        lambda: systems.simulate(plant, x0, dt=0.01, steps=3),
        lambda: adp.simulate(policy, plant, cost, x0, dt=0.01, steps=3),
        lambda: plant.drift(x0),
    ):
        with pytest.raises(ValueError, match=r"a batch of 4 rows met .* of 3"):
            run()
    with pytest.raises(ValueError, match=r"met .* of 5"):  # nor do the first three of five serve
        adp.LQR(plant, adp.QuadraticCost(st.rows(spread(1.0, 2.0, 5)), 1.0, 2, 1))


@pytest.mark.parametrize("count", [1, 3])
def test_centers_and_a_basis_called_directly_take_rows(count: int) -> None:
    radii, x = spread(0.1, 0.3), torch.randn(FEW, 2).double()
    layout = st.rings(3) if count == 3 else st.polygon(1)
    many = st.StateFollowingCenters(layout, st.rows(radii))
    for row in range(FEW):
        one = st.StateFollowingCenters(layout, radii[row])
        torch.testing.assert_close(many(x)[row], one(x[row]), rtol=1e-15, atol=0)
        torch.testing.assert_close(many.offsets(x)[row], one.offsets(x[row]), rtol=1e-15, atol=0)


MASSES, BOUNDS = (0.5, 2.0), (1.0, 2.0)


def problems(rows: int, dtype: torch.dtype = torch.float64) -> tuple[Any, list[Any]]:
    """A plant and a bounded cost with numbers of rows, and those of every row alone."""
    masses, bounds = spread(*MASSES, rows).to(dtype), spread(*BOUNDS, rows).to(dtype)

    def made(mass: Any, bound: Any) -> tuple[systems.Plant, adp.Cost]:
        return systems.Pendulum(mass=mass), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-bound, high=bound)

    return made(st.rows(masses), st.rows(bounds)), [made(*each) for each in zip(masses, bounds, strict=True)]


def starts(rows: int) -> Tensor:
    return torch.randn(rows, 2, generator=torch.Generator().manual_seed(1)).double()


@pytest.mark.parametrize("rows", [1, 2, 7])
@pytest.mark.parametrize("period", [None, 0.05])
def test_riccati_equations_of_rows_are_those_of_single_ones_to_the_bit(rows: int, period: Any) -> None:
    many, alone = problems(rows)
    found = adp.LQR(*many, period=period)
    for row, each in enumerate(alone):
        one = adp.LQR(*each, period=period)
        for got, want in ((found.p, one.p), (found.k, one.k)):
            assert torch.equal(got.full[row], want)


def test_a_riccati_equation_without_a_solution_is_named_by_its_row() -> None:
    gain = torch.tensor([1.0, 0.0, 1.0, 0.0]).double()

    class Pushed(Spring):
        def effectiveness(self, x: Tensor) -> Tensor:
            return super().effectiveness(x) * self.get_buffer("gain")

    plant = Pushed(torch.tensor(-1.0))
    plant.register_buffer("gain", st.rows(gain))
    for period in (None, 0.1):
        with pytest.raises(ValueError, match=r"no input reaches its mode .* \(in row 1\)"):
            adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, 2, 1), period=period)


@pytest.mark.parametrize(("rows", "compile"), [(3, False), (2, True)])
def test_plans_of_rows_are_those_of_single_problems_to_the_bit(rows: int, compile: bool) -> None:
    many, alone = problems(rows)
    x0, last = starts(rows), rows - 1
    search = adp.BoxDDP(adp.SampledProblem.of(*many, dt=0.1), steps=4, compile=compile)
    found = search.solve(x0)
    one = adp.BoxDDP(adp.SampledProblem.of(*alone[last], dt=0.1), steps=4, compile=compile)
    for got, want in zip(found, one.solve(x0[last:]), strict=True):
        assert torch.equal(got[last], want[0])
    assert compile or search.solve(x0.float()).control.dtype == torch.float32
    x0[0] = torch.nan
    assert torch.equal(search.solve(x0).control[1:], found.control[1:])
    with pytest.raises(ValueError, match=rf"a batch of {rows + 1} rows met .* of {rows}"):
        search.solve(starts(rows + 1))


def test_rollouts_of_rows_are_those_of_single_plants_to_the_bit(either: str) -> None:
    rows = 7
    many, alone = problems(rows)
    x0, policy, last = starts(rows), adp.RolloutPolicy.of_lqr(*many), rows - 1
    found, one = policy(x0), adp.RolloutPolicy.of_lqr(*alone[last])
    assert torch.equal(found[last:], one(x0[last:]))
    torch.testing.assert_close(policy.value(x0)[last:], one.value(x0[last:]))
    x0[0] = torch.nan
    assert torch.equal(policy(x0)[1:], found[1:])
    with pytest.raises(ValueError, match=rf"a batch of {rows + 1} rows met .* of {rows}"):
        policy(starts(rows + 1))


def test_a_plan_of_rows_is_followed_in_a_loop() -> None:
    many, alone = problems(2)
    x0, settings = starts(2), {"steps": 3, "iterations": 1, "compile": False}
    loop = adp.RecedingHorizon(adp.SampledProblem.of(*many, dt=0.1), **settings)
    found = adp.simulate(loop, *many, x0, dt=0.1, steps=1, compile=False).state
    one = adp.RecedingHorizon(adp.SampledProblem.of(*alone[1], dt=0.1), **settings)
    wanted = adp.simulate(one, *alone[1], x0[1:], dt=0.1, steps=1, compile=False).state
    assert torch.equal(found[1:], wanted)


def test_near_optimal_of_rows_that_look_ahead_differently_far_is_that_of_single_plants_to_the_bit() -> None:
    rates, weights, x0 = spread(0.0, 3.0, 3), spread(1.0, 2.0, 3), starts(3)[:, :1]
    cost = adp.QuadraticCost(1.0, 1.0, 1, 1)

    def made(matrix: Any, weight: Any) -> Any:
        plant = systems.Linear(matrix, [[1.0]])
        return adp.near_optimal(plant, adp.QuadraticCost(weight, 1.0, 1, 1), dt=0.1)

    alone = [made(-rate.view(1, 1), float(weight)) for rate, weight in zip(rates, weights, strict=True)]
    many = made(st.rows(-rates.view(-1, 1, 1)), st.rows(weights))
    assert len({each.steps for each in alone}) > 1
    with lanes.compiling("never"):
        found = many(x0)
        for row, each in enumerate(alone):
            assert torch.equal(found[row : row + 1], each(x0[row : row + 1]))
    with lanes.compiling("always"):
        assert torch.equal(many(x0)[1:2], alone[1](x0[1:2]))
    assert torch.equal(many.value(x0)[-1:], alone[-1].value(x0[-1:]))
    assert many(x0.float()).dtype == torch.float32
    spoilt = torch.cat((x0[:1] + torch.nan, x0[1:]))
    assert torch.equal(many(spoilt)[1:], found[1:])
    with pytest.raises(ValueError, match=r"a batch of 2 rows met `rows\(\.\.\.\)` of 3"):
        many(x0[:2])
    with pytest.raises(ValueError, match=r"`NearOptimal.report\(plant=...\)` must have no numbers of a row"):
        many.report()
    with pytest.raises(ValueError, match=r"must be positive.*\(in row 1\)"):
        adp.near_optimal(systems.Linear([[0.0]], [[1.0]]), cost, dt=0.1, radius=st.rows(spread(1.0, -1.0, 2)))


def test_rows_of_several_kinds_stand_behind_one_filter() -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    lqr, x0 = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, 2, 1)), torch.tensor([[0.2, -1.0]]).double()
    share, decays = torch.tensor([0.0, 1.0, 0.0]).double(), spread(1.0, 3.0)

    def safe(share: Any, decay: Any) -> adp.SafetyFilter:  # of relative degree two, or of one
        return adp.SafetyFilter(
            lqr, plant, lambda x, t: x[:, 0] + share * x[:, 1] + 0.5, dt=0.05, low=-3.0, high=3.0, decay=decay
        )

    many = safe(st.rows(share), st.rows(decays))
    x0 = x0.expand(FEW, 2)
    with lanes.compiling("never"):
        found = many.restrain(x0, lqr(x0))
        for row in range(FEW):
            one = safe(share[row], float(decays[row])).restrain(x0[:1], lqr(x0[:1]))
            for got, want in zip(found, one, strict=True):
                assert torch.equal(got[row : row + 1], want)


def test_a_users_controller_may_call_its_methods_as_it_likes() -> None:
    class Own(adp.LQR):
        def decide(self, x: Tensor) -> Tensor:
            return self(x)

    own = Own(systems.Pendulum(mass=st.rows(spread(*MASSES))), adp.QuadraticCost(1.0, 1.0, 2, 1))
    x = starts(FEW)
    assert torch.equal(deploy.policy_of(own, row=1)(x[1:2]), own.decide(x)[1:2])


def test_rows_whose_brakes_hold_and_rows_whose_brakes_do_not_stand_behind_one_filter() -> None:
    masses, x0 = torch.tensor([0.5, 8.0]).double(), torch.tensor([[-0.3, -0.9]]).double()

    def safe(mass: Any) -> adp.SafetyFilter:
        plant = systems.Pendulum(mass=mass)
        lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, 2, 1))
        return adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] + 0.5, dt=0.1, low=-10.0, high=10.0)

    many, x = safe(st.rows(masses)), torch.cat((x0 - 1.0, 0.5 * x0))
    with lanes.compiling("never"):
        singles = [safe(mass) for mass in masses]
        found = many.restrain(x, many.controller.policy(x))
        for row, (at, one) in enumerate(zip(x.split(1), singles, strict=True)):
            for got, want in zip(found, one.restrain(at, one.controller.policy(at)), strict=True):
                assert torch.equal(got[row : row + 1], want)
    alone = [deploy.policy_of(many, row=row) for row in range(2)]
    for those in (singles, [policy.filter for policy in alone]):  # two kinds, that are one program
        assert [one.follows for one in those] == [False, True]
    assert bool((found.slack > 0).any())


def test_a_row_without_an_optimum_spoils_no_other_and_says_why() -> None:
    plant, cost = systems.Pendulum(mass=st.rows(spread(*MASSES))), adp.QuadraticCost(1.0, 1.0, 2, 1)
    x0, shooting = 0.3 * starts(FEW), adp.DirectShooting(plant, cost, horizon=0.5, intervals=4)
    found = shooting.solve(x0)
    x0[0] = torch.nan
    spoilt = shooting.solve(x0)
    assert spoilt.reason[0].startswith("the cost is not finite")
    assert torch.equal(spoilt.value[1:], found.value[1:])
    with pytest.raises(ValueError, match=r"a batch of 4 rows met `rows\(\.\.\.\)` of 3"):
        shooting.solve(starts(4))


def test_what_does_not_serve_rows_says_so() -> None:
    cost = adp.QuadraticCost(st.rows(spread(1.0, 2.0)), 1.0, 1, 1)
    problem = adp.SampledProblem.of(systems.Linear([[0.0]], [[1.0]]), cost, dt=0.1)
    with pytest.raises(ValueError, match="must have no numbers of a row's own"):
        adp.learn_global_value(problem, [1.0], steps=4)


def test_a_controller_goes_to_a_device_row_by_row(tmp_path: Path) -> None:
    lqr, x = adp.LQR(*problems(2)[0]), starts(2)
    assert torch.equal(deploy.policy_of(lqr, row=1)(x[1:]), lqr(x)[1:])
    for export in (
        lambda: deploy.policy_of(lqr),
        lambda: deploy.export_learning_c(adp.Feedback(lqr), x[:1], tmp_path / "lqr.h", dt=0.1),
    ):
        with pytest.raises(ValueError, match=r"must have no numbers of a row's own .*: name its `row`"):
            export()


@pytest.mark.parametrize(("name", "wrong"), by_turns(list(CASES)[::2], (-1.0, math.inf, 0.0)))
def test_a_rule_that_a_number_breaks_alone_is_broken_in_its_row_by_name(name: str, wrong: float) -> None:
    case = CASES[name]
    numbers = {key: spread(*ends) for key, ends in case.numbers.items()}

    def made(key: str, value: Any) -> str:
        """What is said of this number, beside others that are right."""
        beside = {each: given[0].tolist() for each, given in numbers.items() if each != key}
        try:
            case.run(**beside, **{key: value})
        except ValueError as error:
            return str(error)
        return ""

    for key, given in numbers.items():
        for bad in (math.nan, wrong):
            given[-1].view(-1)[-1] = bad
            alone, many = made(key, given[-1].tolist()), made(key, st.rows(given))
            if alone or many:  # alone it may break no rule, and differ from the others in more than numbers
                assert many.startswith(alone.split(";")[0] or "rows differ in `")
                assert f"row {FEW - 1}" in many


def test_what_is_no_number_of_rows_is_refused() -> None:
    with pytest.raises(ValueError, match="must have a first dimension of rows"):
        st.rows(torch.tensor(1.0))
    with pytest.raises(ValueError, match=r"must be floating-point numbers; got torch\.int64"):
        st.rows(torch.tensor([1]))
    with pytest.raises(ValueError, match="has no single value"):
        float(st.rows(torch.ones(2)))


def test_numbers_of_rows_survive_copies_casts_and_pickles() -> None:
    plant = Spring(st.rows(spread(0.5, 4.0)))
    x = torch.randn(FEW, 2).double()
    for other in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant)), plant.float().double()):
        torch.testing.assert_close(other.drift(x), plant.drift(x), rtol=1e-6, atol=1e-6)
    assert "rows(" in repr(systems.Pendulum(mass=st.rows(spread(1.0, 2.0)))) + repr(
        st.GaussianKernel(st.rows(spread(1.0, 2.0)))
    )


@pytest.mark.parametrize("scaling", [False, True])
def test_streams_with_a_width_and_a_noise_of_their_own_are_streams_alone(scaling: bool) -> None:
    ends = {"radius": (0.3, 0.6), "noise": (0.03, 0.1), "amplitude": (0.8, 1.5), "forgetting": (0.99, 0.999)}
    numbers = {name: spread(*each) for name, each in {**ends, "follow": (0.5, 1.0), "robust": (2, 3)}.items()}
    widths = spread(0.6, 1.2)
    own = {name: st.rows(column) for name, column in numbers.items()}
    many = st.StaFRegressor(st.GaussianKernel(st.rows(widths)), scaling=scaling, **own)
    one = {name: float(column[1]) for name, column in numbers.items()}
    alone = st.StaFRegressor(st.GaussianKernel(float(widths[1])), scaling=scaling, **one)
    for k in range(45):
        x = torch.stack(
            [torch.tensor(0.05 * k + s).sin() * torch.tensor([1.0, 0.7]) for s in range(FEW)]
        ).double()
        y = (2 * x).sin().sum(-1)
        many.partial_fit(x, y)
        alone.partial_fit(x[1:2], y[1:2])
    for found, wanted in zip(many.predict(x, True), alone.predict(x[1:2], True), strict=True):
        torch.testing.assert_close(found[1:2], wanted, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"a batch of 2 rows met `rows\(\.\.\.\)` of 3"):
        st.StaFRegressor(radius=st.rows(spread(0.3, 0.6))).partial_fit(x[:2], y[:2])


def test_another_mass_gain_or_step_needs_neither_a_trace_nor_a_compiler() -> None:
    x0 = torch.tensor([[0.5, 0.1]]).double().expand(2, 2)
    cost, states = adp.QuadraticCost(1.0, 1.0, 2, 1), x0.unsqueeze(1).expand(2, 20, 2)
    basis = st.StaFBasis(st.GaussianKernel(0.7), st.StateFollowingCenters(st.rings(3), 0.3))

    def calls(run: Callable[[], object], name: str) -> int:
        """How often a method of this name is called meanwhile."""
        count = 0

        def seen(frame: Any, event: str, _: object) -> None:
            nonlocal count
            count += event == "call" and frame.f_code.co_name == name

        before = sys.getprofile()
        sys.setprofile(seen)
        try:
            run()
        finally:
            sys.setprofile(before)
        return count

    plants = {m: systems.VanDerPol(damping=m) for m in (1.0, 2.0, -0.5)}
    laws = {step: optim.FixedStep(step) for step in (0.5, 0.9, 0.25)}
    discounts = {rho: adp.QuadraticCost(1.0, 1.0, 2, 1, discount=rho) for rho in (0.5, 1.0, 0.25)}
    lqr = adp.LQR(systems.Pendulum(), cost)
    with lanes.compiling("always"):
        for run, of, method in (
            (lambda v: systems.simulate(plants[v], x0, dt=0.01, steps=5), plants, "drift"),
            (lambda v: st.chase_weights(states, basis, st.targets.Paper(), laws[v]), laws, "descent"),
            (
                lambda v: adp.simulate(lqr, systems.Pendulum(), discounts[v], x0, steps=5, substeps=1),
                discounts,
                "stage_weights",
            ),
        ):
            first, *others = of
            run(first)
            for other in others:
                assert calls(lambda run=run, other=other: run(other), method) == 0


@pytest.mark.parametrize(
    "read",
    [
        lambda k: float(f"{k:.6f}"),
        lambda k: k.tolist(),
        lambda k: float(k.numpy()),
        lambda k: torch.tensor([[k, 1.0]])[0, 0],
        float,
    ],
)
def test_a_number_that_a_step_takes_out_of_torch_is_never_stale(read: Callable[[Tensor], Any]) -> None:
    class Reads(Spring):
        def drift(self, x: Tensor) -> Tensor:
            k = read(self.get_buffer("stiffness"))
            return torch.stack((x[..., 1], -k * x[..., 0]), dim=-1)

    x0 = torch.tensor([[1.0, 0.0]]).double()
    for stiffness in (1.0, 2.0):
        plant = Reads(torch.tensor(stiffness))
        with lanes.compiling("always"):
            found = systems.simulate(plant, x0, dt=0.01, steps=5)
        with lanes.compiling("never"):
            torch.testing.assert_close(found, systems.simulate(plant, x0, dt=0.01, steps=5))


def test_numbers_that_are_equal_in_all_rows_are_of_as_many_rows() -> None:
    x = torch.randn(4, 2).double()
    for rows in (1, 3):
        equal = torch.full((rows,), 0.5).double()
        basis = st.StaFBasis(st.GaussianKernel(0.7), st.StateFollowingCenters(st.rings(3), 0.3))
        for law in (optim.FixedStep(st.rows(equal)), optim.HeavyBall(1.0, st.rows(equal))):
            with pytest.raises(ValueError, match=f"a batch of 4 rows met .* of {rows}"):
                st.chase_weights(x.unsqueeze(1), basis, st.targets.Paper(), law)


ANYWHERE: dict[str, Callable[[Any], Callable[[Tensor], Tensor]]] = {
    "repeat": lambda k: lambda x: lanes.repeat(2, lambda c: c * k.sin(), x),
    "torch.tensor": lambda k: lambda x: x * torch.tensor([k, 0.1]),
    "new_full": lambda k: lambda x: x + x.new_full(x.shape[1:], k),
    "derivative": lambda k: lambda x: torch.func.grad(lambda y: (k * y.sin()).sum())(x),
    "text": lambda k: lambda x: x * float(f"{k:.17g}"),
    "branch": lambda k: lambda x: x * 2 if k > 1.5 else x,
    "constructor": lambda k: lambda x: systems.Pendulum(mass=k).drift(x),
}


@pytest.mark.parametrize("name", ANYWHERE)
def test_a_users_function_may_read_numbers_of_rows_wherever_torch_takes_numbers(name: str) -> None:
    numbers, x = spread(1.0, 2.0), torch.randn(FEW, 2).double()
    function = ANYWHERE[name](st.rows(numbers))
    program = lanes.Program(lambda c, _, row: (c, function(row)))
    singles = [ANYWHERE[name](k)(x[row : row + 1]) for row, k in enumerate(numbers)]
    for run in (program, program.definition):
        torch.testing.assert_close(
            run((), (), x, steps=1)[1][:, 0], torch.cat(singles), rtol=1e-14, atol=1e-14
        )
    assert program.compiled == (name not in ("new_full", "text", "branch"))  # which want a Python number


def test_a_policy_takes_its_number_out_of_torch_and_what_is_differentiated_may_not() -> None:
    plant, cost, gains = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, 2, 1), spread(1.0, 2.0)

    def run(gain: Any, x0: Tensor) -> Tensor:
        policy = adp.Feedback(lambda x: -float(gain) * x[..., :1])
        return adp.simulate(policy, plant, cost, x0, dt=0.02, steps=2).state

    found = run(st.rows(gains), starts(FEW))
    for row, gain in enumerate(gains):
        assert torch.equal(found[row : row + 1], run(gain, starts(FEW)[row : row + 1]))
    wall = st.rows(gains)
    with pytest.raises(ValueError, match=r"numbers leave torch at .*test_rows.py.* write it with torch"):
        adp.SafetyFilter(adp.LQR(plant, cost), plant, lambda x, t: float(wall.numpy()) - x[:, 0], dt=0.05)


def test_equilibria_and_bounds_beside_a_cost_take_rows_and_theorems_refuse_them() -> None:
    pushes, bounds = spread(0.1, 0.3), spread(1.0, 2.0)
    resting = [
        systems.find_equilibrium(systems.RatePlant(lambda x, u, c=c: c - x + u, dim=1, inputs=1), [0.0])
        for c in pushes
    ]
    c = st.rows(pushes)
    many = systems.find_equilibrium(systems.RatePlant(lambda x, u: c - x + u, dim=1, inputs=1), [0.0])
    assert torch.equal(many.input.full, torch.stack([rest.input for rest in resting]))
    cost, plant = adp.QuadraticCost(1.0, 1.0, 2, 1), systems.Pendulum()
    limited = adp.SampledProblem.of(plant, cost, dt=0.1, low=-1.0, high=st.rows(bounds))
    assert torch.equal(limited.bounds.high.full[:, 0], bounds)
    with pytest.raises(ValueError, match=r"`BoxDDP\(tolerance=...\)` must be one number for all rows"):
        adp.BoxDDP(limited, steps=4, tolerance=st.rows(bounds))
    with pytest.raises(
        ValueError, match=r"`layout_errors\(radius=...\)` must have no numbers of a row's own"
    ):
        st.theory.layout_errors(st.targets.Paper(), st.GaussianKernel(), starts(3), c, [st.rings(3)])
