"""Numbers of a row's own: a batch of B plants, costs, kernels, laws, filters is the loop of B single ones."""

from __future__ import annotations

import copy
import math
import pickle
import random
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers_rows import CASES, ROWS, Spring
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


@pytest.mark.parametrize(("name", "rows"), by_turns(CASES, (2, ROWS, 1, 2)))
def test_everything_with_numbers_of_rows_is_the_loop_of_single_ones(name: str, rows: int) -> None:
    case, real = CASES[name], torch.float32 if rows == ROWS else torch.float64
    names, draw = [*case.numbers], random.Random(name)
    own = draw.sample(names, draw.randint(1, len(names)))  # the others are one number for all rows
    numbers = {key: spread(*case.numbers[key], rows) for key in names}
    told = {key: st.rows(value) if key in own else value[0].tolist() for key, value in numbers.items()}
    with lanes.compiling("never"):
        many = flatten(case.run(**told)(slice(0, rows), real))[0]
        row = draw.randrange(rows)
        single = {key: value[row if key in own else 0].tolist() for key, value in numbers.items()}
        alone = flatten(case.run(**single)(slice(row, row + 1), real))[0]
    close = case.tolerance * (1e7 if real == torch.float32 else 1)
    for found, wanted in zip(many, alone, strict=True):
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


def starts(rows: int) -> Tensor:
    return torch.randn(rows, 2, generator=torch.Generator().manual_seed(1)).double()


COST, MASSES = adp.QuadraticCost(1.0, 1.0, 2, 1, low=-2.0, high=2.0), st.rows(spread(0.5, 2.0))
PENDULUM, PLANT, X = systems.Pendulum(), systems.Pendulum(mass=MASSES), starts(FEW)
BASIS = st.StaFBasis(st.GaussianKernel(0.7), st.StateFollowingCenters(st.rings(3), 0.3))
SAMPLED = adp.SampledProblem.of(PLANT, COST, dt=0.1)
DOORS: dict[str, Callable[[], Callable[[Tensor], Any]]] = {
    "plant": lambda: PLANT.drift,
    "simulation": lambda: lambda x: systems.simulate(PLANT, x, dt=0.01, steps=3)[:, -1],
    "loop": lambda: lambda x: adp.simulate(adp.LQR(PENDULUM, COST), PLANT, COST, x, dt=0.01, steps=3).cost,
    "plan": lambda: lambda x: adp.BoxDDP(SAMPLED, steps=4, compile=False).solve(x).control,
    "rollout": lambda: adp.RolloutPolicy.of_lqr(PLANT, COST, steps=3, horizon=0.15),
    "near_optimal": lambda: adp.near_optimal(PLANT, COST, dt=0.1, reach="local"),
    "chase": lambda: (
        lambda x: (
            st.chase_weights(
                x.unsqueeze(1), BASIS, st.targets.Paper(), optim.HeavyBall(1.0, st.rows(spread(0.5, 0.9)))
            ).weights
        )
    ),
    "stream": lambda: lambda x: st.StaFRegressor(radius=MASSES).partial_fit(x, x[:, 0]).predict(x),
}


@pytest.mark.parametrize("name", DOORS)
def test_a_row_that_is_not_a_number_spoils_no_other_and_a_batch_of_another_size_is_refused(name: str) -> None:
    called, spoilt = DOORS[name](), torch.cat((X[:1] * torch.nan, X[1:]))
    if name != "stream":  # which leaves such a sample out
        assert torch.equal(called(spoilt)[1:], called(X)[1:])
    for others in (starts(FEW + 1), X[:2]):
        with pytest.raises(ValueError, match=rf"a batch of {len(others)} rows met .* of 3"):
            called(others)


def test_a_row_without_an_optimum_spoils_no_other_and_says_why() -> None:
    shooting, x0 = adp.DirectShooting(PLANT, COST, horizon=0.3, intervals=4), 0.1 * X
    spoilt = shooting.solve(torch.cat((X[:1] * torch.nan, x0[1:])))
    assert spoilt.reason[0].startswith("the cost is not finite")
    assert torch.equal(spoilt.value[1:], shooting.solve(x0).value[1:])
    with pytest.raises(ValueError, match=r"a batch of 4 rows met .* of 3"):
        shooting.solve(starts(4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: st.rows(torch.tensor(1.0)), "must have a first dimension of rows"),
        (lambda: st.rows(torch.tensor([1])), r"must be floating-point numbers; got torch\.int64"),
        (lambda: float(st.rows(torch.ones(2))), "has no single value"),
        (lambda: st.rows([PENDULUM, systems.VanDerPol()]), "or modules of one class; got Pendulum, Van"),
        (
            lambda: adp.LQR(PLANT, adp.QuadraticCost(st.rows(spread(1.0, 2.0, 5)), 1.0, 2, 1)),
            r"rows met `rows\(\.\.\.\)` of",  # nor do the first three of five serve
        ),
        (
            lambda: adp.near_optimal(PLANT, adp.QuadraticCost(1.0, 1.0, 2, 1), dt=0.1).report(),
            r"\(plant=...\)` must have no numbers of a row's own",
        ),
        (
            lambda: adp.near_optimal(PENDULUM, COST, dt=0.1, radius=st.rows(spread(1.0, -1.0, 2))),
            r"must be positive.*\(in row 1\)",
        ),
        (lambda: adp.learn_global_value(SAMPLED, [1.0, 1.0], steps=4), "must have no numbers of a row's own"),
        (lambda: adp.BoxDDP(SAMPLED, steps=4, tolerance=MASSES), "must be one number for all rows"),
        (
            lambda: st.theory.layout_errors(
                st.targets.Paper(), st.GaussianKernel(), X, MASSES, [st.rings(3)]
            ),
            r"`layout_errors\(radius=...\)` must have no numbers of a row's own",
        ),
        (lambda: deploy.policy_of(adp.LQR(PLANT, COST)), "own .*: name its `row`"),
        (
            lambda: adp.SafetyFilter(
                adp.LQR(PENDULUM, COST), PENDULUM, lambda x, t: float(MASSES.numpy()) - x[:, 0], dt=0.05
            ),
            r"numbers leave torch at .*test_rows.py.* write it with torch",
        ),
    ],
)
def test_what_does_not_serve_rows_says_so(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_near_optimal_of_rows_that_look_ahead_differently_far_is_that_of_single_plants_to_the_bit() -> None:
    rates, x0 = spread(0.0, 3.0), X[:, :1]

    def made(matrix: Any) -> Any:
        return adp.near_optimal(systems.Linear(matrix, [[1.0]]), adp.QuadraticCost(1.0, 1.0, 1, 1), dt=0.1)

    alone, many = [made(-rate.view(1, 1)) for rate in rates], made(st.rows(-rates.view(-1, 1, 1)))
    assert len({each.steps for each in alone}) > 1
    found = many(x0)
    for row, each in enumerate(alone):
        assert torch.equal(found[row : row + 1], each(x0[row : row + 1]))
    with lanes.compiling("always"):
        assert torch.equal(many(x0)[1:2], alone[1](x0[1:2]))
    assert torch.equal(many.value(x0)[-1:], alone[-1].value(x0[-1:]))


def of_degree(share: Any) -> adp.SafetyFilter:
    """A wall of relative degree two, or of one."""
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    settings = {"dt": 0.05, "low": -3.0, "high": 3.0}
    return adp.SafetyFilter(
        adp.LQR(plant, COST), plant, lambda x, t: x[:, 0] + share * x[:, 1] + 0.5, **settings
    )


def of_mass(mass: Any) -> adp.SafetyFilter:
    """A wall before which a light pendulum brakes in time, and a heavy one does not."""
    plant = systems.Pendulum(mass=mass)
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, 2, 1))
    return adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] + 0.5, dt=0.1, low=-10.0, high=10.0)


@pytest.mark.parametrize(("made", "ends"), [(of_degree, (0.0, 1.0)), (of_mass, (0.5, 8.0))])
def test_rows_of_two_kinds_stand_behind_one_filter(
    made: Callable[[Any], adp.SafetyFilter], ends: tuple[float, float]
) -> None:
    numbers, x = spread(*ends, 2), torch.tensor([[-1.3, -1.9], [-0.15, -0.45]]).double()
    many, singles = made(st.rows(numbers)), [made(number) for number in numbers]
    found = many.restrain(x, many.controller.policy(x))
    for row, (at, one) in enumerate(zip(x.split(1), singles, strict=True)):
        for got, want in zip(found, one.restrain(at, one.controller.policy(at)), strict=True):
            assert torch.equal(got[row : row + 1], want)
    assert made is of_degree or [one.follows for one in singles] == [False, True]


def test_a_controller_of_rows_is_deployed_row_by_row() -> None:
    class Own(adp.LQR):
        """A user's controller, which calls its methods as it likes."""

        def decide(self, x: Tensor) -> Tensor:
            return self(x)

    own = Own(PLANT, COST)
    assert torch.equal(deploy.policy_of(own, row=1)(X[1:2]), own.decide(X)[1:2])


def test_equilibria_of_rows_are_those_of_single_plants() -> None:
    pushes = spread(0.1, 0.3)

    def rest(push: Any) -> Any:
        plant = systems.RatePlant(lambda x, u: push - x + u, dim=1, inputs=1)
        return systems.find_equilibrium(plant, [0.0]).input

    assert torch.equal(rest(st.rows(pushes)).full, torch.stack([rest(push) for push in pushes]))


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


def test_numbers_of_rows_survive_copies_casts_and_pickles() -> None:
    plant = Spring(st.rows(spread(0.5, 4.0)))
    x = torch.randn(FEW, 2).double()
    for other in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant)), plant.float().double()):
        torch.testing.assert_close(other.drift(x), plant.drift(x), rtol=1e-6, atol=1e-6)
    assert "rows(" in repr(systems.Pendulum(mass=st.rows(spread(1.0, 2.0)))) + repr(
        st.GaussianKernel(st.rows(spread(1.0, 2.0)))
    )


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


def test_another_damping_gain_or_discount_needs_neither_a_trace_nor_a_compiler() -> None:
    lqr = adp.LQR(PENDULUM, COST)

    def swung(damping: float) -> object:
        return systems.simulate(systems.VanDerPol(damping=damping), X, dt=0.01, steps=5)

    def paid(discount: float) -> object:
        cost = adp.QuadraticCost(1.0, 1.0, 2, 1, discount=discount)
        return adp.simulate(lqr, PENDULUM, cost, X, dt=0.05, steps=5, substeps=1)

    def chased(step: float) -> object:
        law, states = optim.FixedStep(step), X.unsqueeze(1).expand(-1, 20, -1)
        return st.chase_weights(states, BASIS, st.targets.Paper(), law)

    with lanes.compiling("always"):
        for run, method in ((swung, "drift"), (paid, "stage_weights"), (chased, "descent")):
            run(0.5)
            assert calls(lambda run=run: run(0.9), method) == 0


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


def test_a_policy_may_take_its_number_out_of_torch() -> None:
    plant, cost, gains = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, 2, 1), spread(1.0, 2.0)

    def run(gain: Any, x0: Tensor) -> Tensor:
        policy = adp.Feedback(lambda x: -float(gain) * x[..., :1])
        return adp.simulate(policy, plant, cost, x0, dt=0.02, steps=2).state

    found = run(st.rows(gains), starts(FEW))
    for row, gain in enumerate(gains):
        assert torch.equal(found[row : row + 1], run(gain, starts(FEW)[row : row + 1]))
