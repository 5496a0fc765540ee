"""The cases of `faults`: their plants by formulas of their own, what they are made of, what is measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from helpers_experiments import made_of
from recorded import Record
from torch import Tensor

from staf_torch import adp
from staf_torch.experiments import faults

Rate = Callable[[np.ndarray, np.ndarray, np.ndarray], list[float]]


def made(name: str, rows: int = 3, seed: int = 0) -> faults.Case:
    return faults.CASES[name](rows, torch.Generator().manual_seed(seed))


# x' of a state, an input and the parameters theta, by hand.
RATES: dict[str, Rate] = {
    "short_period": lambda x, u, t: [
        t[0] * x[0] + t[1] * x[1] + -0.194 * u[0] * t[4] + -0.03593 * u[1] * t[5],
        t[2] * x[0] + t[3] * x[1] + -19.29 * u[0] * t[4] + -3.803 * u[1] * t[5],
    ],
    "unstable": lambda x, u, t: [x[1], 25 * x[0] + t[0] * u[0] + t[1] * u[1] / 10],
    "mass": lambda x, u, t: [x[1], 9.81 * math.sin(x[0]) + t[0] * (u[0] - 0.1 * x[1])],
}


@pytest.mark.parametrize("name", RATES)
def test_the_plant_of_a_case_moves_as_its_text_says(name: str) -> None:
    case = made(name)
    count, inputs = case.model.parameters_count, case.model.inputs
    x, u, theta = uniform(5, 2, seed=1), uniform(5, inputs, seed=2), uniform(5, count, seed=3)
    rows = zip(x.numpy(), u.numpy(), theta.numpy(), strict=True)
    expected = tensor([RATES[name](*row) for row in rows])
    torch.testing.assert_close(case.model.believing(theta).motion(x, u), expected, rtol=1e-12, atol=1e-12)
    single = case.model.believing(theta.float()).motion(x.float(), u.float())
    assert single.dtype == torch.float32


@pytest.mark.parametrize("name", RATES)
def test_a_case_is_made_of_the_recorded_numbers(name: str, record: Record) -> None:
    case = made(name)
    assert all(
        part.dtype == torch.float64 for part in (case.x0, case.before, case.after, case.at, case.model.theta)
    )
    for rows in (1, 4):
        other = made(name, rows, seed=1)
        assert [len(part) for part in (other.x0, other.before, other.after, other.at)] == [rows] * 4
        again = made(name, rows, seed=1)
        assert torch.equal(other.x0, again.x0)  # of the generator alone
        assert torch.equal(other.at, again.at)
    record(made_of(case), rtol=1e-5)


@pytest.mark.parametrize("name", RATES)
def test_what_a_controller_sees_is_measured_but_for_the_parameters(name: str) -> None:
    case = made(name)
    n, p = 2, case.model.parameters_count
    controllers: dict[str, Any] = faults._controllers(case)
    assert list(controllers) == ["ignorant LQR", "informed LQR", "adaptive"]
    for one in ("ignorant LQR", "adaptive"):
        assert controllers[one].noise.tolist() == [case.noise] * n
        assert controllers[one].output is None
    informed = controllers["informed LQR"]
    assert informed.noise.tolist() == [case.noise] * n + [0.0] * p
    assert controllers["adaptive"].controller is case.adaptive
    z = torch.arange(n + 2 * p + 1).double().unsqueeze(0)  # the state, both parameters, the clock
    assert informed.seen(z)[0].tolist() == [*range(n), *range(n + p, n + 2 * p)]
    # The ignorant one is designed for healthy actuators and the first estimate, and held for the period.
    first = torch.ones(p).double()
    first[: p - 2] = case.before[0, : p - 2]  # the drift of the short period
    design = controllers["ignorant LQR"].controller.policy
    expected = adp.LQR(case.model.believing(first), case.cost, period=case.dt)
    torch.testing.assert_close(design.k, expected.k, rtol=1e-12, atol=0)
    assert not torch.allclose(expected.k, adp.LQR(case.model.believing(first), case.cost).k, rtol=1e-9)


@pytest.mark.parametrize("name", RATES)
def test_the_informed_has_the_gain_of_every_rows_own_plant(name: str) -> None:
    case = made(name, 4)
    policy: Any = faults._Informed(case)
    x = uniform(4, 2, low=-0.01, high=0.01, seed=4)
    found = policy(torch.cat((x, case.after), dim=-1))
    for row in range(4):
        own = adp.LQR(case.model.believing(case.after[row]), case.cost, period=case.dt)
        torch.testing.assert_close(found[row], own(x[row : row + 1])[0], rtol=1e-9, atol=1e-12)
    assert len(policy.laws) == len(case.after.unique(dim=0))


class Stub:
    """Takes the place of a shooting, and says which plant it was asked about."""

    def __init__(self, model: adp.ParametricPlant, cost: adp.Cost) -> None:
        self.model, self.cost = model, cost

    def solve(self, x0: Tensor) -> Any:
        return SimpleNamespace(value=x0[:, 0] + 10 * self.model.theta.reshape(-1)[0])


def test_the_optimum_is_of_every_rows_own_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faults, "DirectShooting", Stub)
    case = made("mass", 5)
    best = case.optimum()
    assert best is not None
    torch.testing.assert_close(best, case.x0[:, 0] + 10 * tensor([2.0, 0.5, 2.0, 0.5, 2.0]))
    assert made("unstable").optimum() is None
    short = made("short_period", 4).optimum()
    assert short is not None
    assert short.tolist() == [pytest.approx(25 - 11.75)] * 4  # all begin at the same state


@pytest.mark.parametrize(("name", "duration", "times"), [("unstable", 0.06, 4), ("mass", 0.05, 6)])
def test_a_run_is_recorded_every_hundredth_of_a_second_or_every_control(
    name: str, duration: float, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, Any]] = []

    def simulated(
        controller: object, plant: adp.ChangingPlant, cost: adp.Cost, z0: Tensor, **named: Any
    ) -> str:
        asked.append(named | {"plant": plant, "cost": cost, "z0": z0})
        return "done"

    monkeypatch.setattr(faults, "simulate", simulated)
    case = made(name)
    assert faults._simulated(case, case.adaptive, duration) == "done"
    (one,) = asked
    every = max(1, round(0.01 / case.dt))
    assert (one["dt"], one["every"], one["steps"]) == (case.dt, every, every * (times - 1))
    assert torch.equal(one["z0"], one["plant"].start(case.x0, case.before, case.after, case.at))
    assert one["cost"].dim == one["plant"].dim
    faults._simulated(case, case.adaptive, 1e-4)  # one recorded period at least
    assert asked[1]["steps"] == every


def result_of(state: Tensor, **more: Any) -> Any:
    """A run of 0.5 s a recorded time."""
    rows, times = state.shape[:2]
    given = {
        "time": 0.5 * torch.arange(times).double(),
        "state": state,
        "cost": torch.arange(1, rows + 1).double(),
        "diverged": torch.zeros(rows, dtype=torch.bool),
        "identifier": torch.zeros(rows, times, 1).double(),
    }
    return SimpleNamespace(**given | more)


def test_a_row_is_regulated_where_the_last_second_is_near_the_origin() -> None:
    case = made("unstable")._replace(near=0.5)
    state = torch.zeros(6, 5, 2).double()  # at 0, .5, 1, 1.5, 2 s: the last second begins at 1 s
    state[0, 1] = 9.0  # before it
    state[1, 2, 0] = 0.6  # as it begins
    state[2, 4] = tensor([0.4, 0.4])  # a norm of .57
    state[3, 3] = tensor([0.3, 0.4])  # at the edge, which is not within
    state[4, 3] = tensor([0.3, -0.39])
    wide = torch.cat((state, torch.full((6, 5, 3), 7.0).double()), dim=-1)  # parameters do not count
    diverged = tensor([0, 0, 0, 0, 0, 1]) > 0
    found = faults._measured(case, "ignorant LQR", result_of(wide, diverged=diverged), None)
    assert found["regulated"] == pytest.approx(2 / 6)  # the first and the fifth
    assert (found["cost_median"], found["cost_max"]) == (3.0, 6.0)
    for name in ("ratio_median", "ratio_max", "found_median", "parameter_error"):
        assert found[name] is None
    best = torch.full((6,), 0.5).double()
    found = faults._measured(case, "informed LQR", result_of(wide), best)
    assert (found["ratio_median"], found["ratio_max"]) == (6.0, 12.0)
    found = faults._measured(case, "informed LQR", result_of(wide, diverged=diverged), best)
    assert found["ratio_max"] == math.inf


def adapting(alarm: float | None, **now: Any) -> Any:
    """An adaptive policy that has found what it is told."""
    return SimpleNamespace(
        law=SimpleNamespace(alarm=alarm), adaptation=lambda identifier: SimpleNamespace(**now)
    )


def test_what_is_found_is_found_when_the_model_is_certain_for_the_first_time() -> None:
    certain = tensor([[0, 0, 1, 0, 1], [0, 1, 1, 1, 1], [0, 0, 0, 0, 1]])
    theta = torch.zeros(3, 5, 2).double()
    theta[:, -1] = tensor([[0.5, 1.0], [0.5, 1.0], [0.7, 1.1]])
    after = tensor([[0.5, 1.0]]).expand(3, 2)
    case = made("unstable")._replace(
        after=after, adaptive=adapting(None, certain=certain, estimate=SimpleNamespace(theta=theta))
    )
    found = faults._measured(case, "adaptive", result_of(torch.zeros(3, 5, 5).double()), None)
    assert found["found_median"] == 1.0  # 1, 0.5 and 2 s
    assert found["parameter_error"] == pytest.approx(0.2)  # of a parameter below 1 it is absolute
    case = case._replace(after=tensor([[-4.0, 1.0]]).expand(3, 2))
    found = faults._measured(case, "adaptive", result_of(torch.zeros(3, 5, 5).double()), None)
    assert found["parameter_error"] == pytest.approx(4.7 / 4)


def test_an_alarm_is_counted_from_the_change_and_none_is_never() -> None:
    alarmed = torch.zeros(3, 5).double()
    alarmed[:, -1] = tensor([0.9, 0.0, 0.5])
    theta = torch.zeros(3, 5, 2).double()
    about = {"certain": alarmed, "alarmed_at": alarmed, "estimate": SimpleNamespace(theta=theta)}
    case = made("unstable")._replace(at=tensor([0.25, 0.5, 0.1]), adaptive=adapting(5.0, **about))
    found = faults._measured(case, "adaptive", result_of(torch.zeros(3, 5, 5).double()), None)
    assert found["found_median"] == pytest.approx(0.4)  # 0.65, -0.5 (alarmed at 0 s, before), 0.4
    alarmed[:2, -1] = -1.0
    found = faults._measured(case, "adaptive", result_of(torch.zeros(3, 5, 5).double()), None)
    assert found["found_median"] == math.inf


def test_a_picture_is_of_the_first_row() -> None:
    state = uniform(2, 4, 7, seed=5)
    theta, certain = uniform(2, 4, 2, seed=6), tensor([[0.0, 1.0, 0.0, 2.0], [1.0, 0.0, 1.0, 1.0]])
    case = made("unstable", 2)._replace(
        at=tensor([0.5, 1.0]),
        before=tensor([[1.0, 2.0], [3.0, 4.0]]),
        after=tensor([[5.0, 6.0], [7.0, 8.0]]),
        adaptive=adapting(None, certain=certain, estimate=SimpleNamespace(theta=theta)),
    )
    picture = faults._picture(case, {"adaptive": result_of(state), "other": result_of(2 * state)})
    assert picture.time.tolist() == [0.0, 0.5, 1.0, 1.5]
    norms = np.linalg.norm(state[0, :, :2].numpy(), axis=-1)
    np.testing.assert_allclose(picture.norms["adaptive"], norms, rtol=1e-12)
    np.testing.assert_allclose(picture.norms["other"], 2 * norms, rtol=1e-12)
    np.testing.assert_array_equal(picture.parameters, theta[0].numpy())
    assert picture.truth.tolist() == [[1.0, 2.0], *[[5.0, 6.0]] * 3]  # from the time of the change on
    assert picture.certain.tolist() == [False, True, False, True]


def test_what_a_run_measures_is_in_its_table_its_metrics_and_its_figure(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With runs that take no time: what the experiment does around them."""
    seen: dict[str, Any] = {}
    case = made("unstable", 2)
    asked: list[tuple[int, int]] = []

    def mine(rows: int, generator: torch.Generator) -> faults.Case:
        asked.append((rows, generator.initial_seed()))
        return case

    measured = {"cost_median": 2.123456789, "cost_max": math.inf, "regulated": 0.5, "found_median": None}
    monkeypatch.setattr(faults, "CASES", {"my_case": mine})
    monkeypatch.setattr(faults, "_simulated", lambda case, control, duration: duration)
    monkeypatch.setattr(faults, "_measured", lambda case, method, result, best: measured)
    monkeypatch.setattr(faults, "_picture", lambda case, results: results)
    monkeypatch.setattr(faults, "draw_faults", lambda pictures: seen.update(pictures))
    monkeypatch.setattr(faults, "images", lambda figure: {"txt": b"drawn"})
    given = ("experiment=faults", "faults.cases=[my_case]", "trajectories=2", "duration=3", "seed=5")
    found = faults.run(settings(*given, "figures=true"), tmp_path)
    assert asked == [(2, 5)]
    methods = ["ignorant LQR", "informed LQR", "adaptive"]
    assert seen == {"my case": dict.fromkeys(methods, 3.0)}
    assert (tmp_path / "figures" / "faults.txt").read_bytes() == b"drawn"
    parts = {"cost_median": 2.123456789, "cost_max": None, "regulated": 0.5}
    keys = ("ignorant_LQR", "informed_LQR", "adaptive")
    assert found == {f"my_case_{key}_{name}": value for key in keys for name, value in parts.items()}
    lines = (tmp_path / "faults.csv").read_text().splitlines()
    assert [line.split(",")[:3] for line in lines[1:]] == [
        ["my case", name, "2.123456789"] for name in methods
    ]
    assert " 2.1235 " in (tmp_path / "faults.md").read_text()
    other = tmp_path / "other"
    other.mkdir()
    faults.run(settings(*given, "figures=false", "trajectories=1"), other)
    assert asked[-1] == (1, 5)
    assert not (other / "figures").exists()
    with pytest.raises(ValueError, match=r"`staf faults.cases=...` must be one of 'my_case'"):
        faults.run(settings(*given, "faults.cases=[other]"), other)


def test_a_case_is_what_it_says_of_itself() -> None:
    """Numbers of the docstrings: each is there."""
    unstable, mass = made("unstable", 200), made("mass", 400)
    assert unstable.dt == 0.02
    assert 0.1 <= float(unstable.at.min()) < 0.11
    assert 0.49 < float(unstable.at.max()) <= 0.5
    assert unstable.after.unique(dim=0).tolist() == [[0.5, 1.0]]
    assert float(unstable.x0.abs().max()) <= 1
    assert bool((unstable.x0.amin(0) < -0.9).all())
    assert mass.noise == 0.01
    assert mass.x0[:, 0].abs().max() <= 1.5
    assert 0.3 < float((mass.x0[:, 0] > 0).double().mean()) < 0.7  # on both sides
