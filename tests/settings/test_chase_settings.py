"""A chase from settings: what does not fit is named, equal settings share objects.

That every option runs is in tests/cli/test_staf.py, that a value which breaks its own rule is refused in
tests/experiments/test_settings_refused.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import composing
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

import staf_torch as st
from staf_torch import StateFollowingCenters
from staf_torch.metrics import Metric
from staf_torch.settings import chase
from staf_torch.settings.chase import ChaseProblem, chase_problem, make, make_centers
from staf_torch.sweeps.hydra_compat import named_packages, trusted


def problem(line: str) -> ChaseProblem:
    return chase_problem(composing.settings(*line.split()))


@pytest.mark.parametrize(
    ("dt", "duration", "steps"), [(0.1, 0.3, 3), (0.01, 0.07, 7), (0.3, 0.9, 3), (1.0, 1.0, 1)]
)
def test_number_of_steps_survives_rounding(dt: float, duration: float, steps: int) -> None:
    assert problem(f"dt={dt} duration={duration}").steps == steps


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("centers.radius=abc", "(radius=...)` must be a number; got 'abc'."),
        ("initial_state=[1,2,3]", "initial_state=...` must have 2 entries"),
        ("device=nope", "`staf device=...` cannot be used here"),
        ("dt=1.0 duration=0.9", "must be at least one step (dt=1.0); got 0.9"),
        ("kernel=custom kernel.path=math.cos", "(kernel=...)` must be a Kernel"),
        ("target=custom target.path=math.pi", "`staf target=...` must be callable"),
        ("system=custom system.path=math.cos", "must be a plant with a method `drift`"),
    ],
)
def test_a_bad_value_is_named(line: str, said: str) -> None:
    own = trusted(named_packages(line.split()))  # as of the command
    with own, pytest.raises(Exception) as found:  # noqa: PT011 (Hydra wraps some; the command unwraps them)
        problem(line)
    assert said in str(found.value) + str(found.value.__cause__)


def test_centers_of_the_users_own_class_are_made_and_other_things_refused() -> None:
    rings = {"_target_": "staf_torch.rings", "count": 3}
    given = {"_target_": "staf_torch.StateFollowingCenters", "directions": rings, "radius": 0.3}
    made = make_centers(OmegaConf.create(given), 2)
    assert isinstance(made, StateFollowingCenters)
    with pytest.raises(ValueError, match="must be StateFollowingCenters"):
        make_centers(OmegaConf.create({"_target_": "staf_torch.GaussianKernel", "width": 1.0}), 2)


def test_what_a_constructor_does_not_know_or_lacks_is_said_in_its_words() -> None:
    for given, said in (({"widht": 2.0}, "widht"), ({"width": 2.0, "length": 1.0}, "length")):
        with pytest.raises(ValueError, match=rf"`staf_torch.GaussianKernel` cannot be built .*{said}"):
            make(OmegaConf.create({"_target_": "staf_torch.GaussianKernel", **given}))


class Demanding:
    """A user's class that has an error of its own."""

    def __init__(self, width: float) -> None:
        raise {1.0: TypeError("a width of one"), 2.0: KeyError("unexpected keyword argument")}[width]


@pytest.mark.parametrize(("width", "words"), [(1.0, "a width of one"), (2.0, "unexpected keyword")])
def test_an_error_of_the_users_own_class_is_not_taken_for_one_of_the_settings(
    width: float, words: str
) -> None:
    with pytest.raises(Exception, match=words) as caught:
        make(OmegaConf.create({"_target_": f"{__name__}.Demanding", "width": width}))
    assert "cannot be built from these settings" not in str(caught.value)


POINTS = [[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"layout": "rings", "count": 6}, lambda: st.rings(6)),
        ({"layout": "polygon", "count": 4, "dim": 2}, lambda: st.polygon(4)),
        ({"layout": "simplex", "dim": 3, "count": 4}, lambda: st.simplex(3)),
        ({"layout": "cross_polytope", "dim": 2, "count": 4}, lambda: st.cross_polytope(2)),
        ({"layout": "ball", "dim": 3, "count": 4}, lambda: st.ball(4, 3)),
        ({"layout": "directions", "directions": POINTS, "dim": 2}, lambda: torch.tensor(POINTS).double()),
    ],
)
@pytest.mark.parametrize("size", [{}, {"radius": 0.3, "shrink": {"offset": 0.2, "gain": 2.0}}])
def test_centers_are_those_of_the_layout_and_the_radius(
    given: dict[str, Any], wanted: Callable[[], Tensor], size: dict[str, Any]
) -> None:
    made = chase.centers_of(**given, **size)
    assert torch.equal(made.directions, wanted())
    assert made.directions.dtype == torch.float64
    x = torch.ones(made.dim).double()
    square, radius = float(made.dim), size.get("radius", 0.1)
    assert isinstance(made.radius, st.StateRadius if "shrink" in size else st.ConstantRadius)
    expected = radius * (square + 0.2) / (1 + 2.0 * square) if "shrink" in size else radius
    assert float(made.radius(x)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"layout": "no"}, "'simplex', 'cross_polytope', 'ball', 'directions'; got 'no'."),
        (
            {"layout": "polygon", "count": 3, "dim": 3},
            "`centers=polygon` lies in the plane, but the system has 3 states: use",
        ),
        (
            {"layout": "directions", "directions": "???"},
            "centers.directions=...` must be a list of points; got '???'.",
        ),
        (
            {"layout": "ball", "count": 3},
            "`centers(dim=...)` must be given for the layout ball: instantiate(..., dim=n)",
        ),
        (
            {"layout": "simplex", "dim": 2, "count": 4},
            "must be 3 (or null) for simplex with 2 states; got 4.",
        ),
    ],
)
def test_centers_that_there_are_not_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        chase.centers_of(**given)


class Rows(Metric):
    """A metric of the user's."""

    def __init__(self, name: str = "rows") -> None:
        self.name = name

    def __call__(self, result: Any, problem: Any) -> Tensor:
        raise NotImplementedError


def two(names: list[str]) -> Any:
    return tuple(Rows(name) for name in names)


def rows_and_words() -> Any:
    return [Rows(), "word"]


def metric(target: str, **more: Any) -> Any:
    return chase.make_metrics(OmegaConf.create({"_target_": f"{__name__}.{target}", **more}))


def test_metrics_are_none_one_or_several() -> None:
    assert chase.make_metrics(None) == chase.make_metrics(OmegaConf.create({"_target_": None})) == ()
    assert [each.name for each in metric("Rows")] == ["rows"]
    assert [each.name for each in metric("two", names=["a", "b"])] == ["a", "b"]
    assert isinstance(metric("Rows"), tuple)
    with pytest.raises(ValueError, match=r"metric=...` must have a name that no other metric has; got 'a'"):
        metric("two", names=["a", "a"])
    with pytest.raises(ValueError, match=r"metric=...` must be a `staf_torch.metrics.Metric`, or several"):
        metric("rows_and_words")


def test_a_path_is_a_class_that_is_called_or_a_thing_as_it_is() -> None:
    assert chase.load("math.pi") == math.pi
    assert chase.load("math.cos", {}, inner_steps=3) is math.cos
    assert chase.load(f"{__name__}.Rows", {"name": "x"}).name == "x"
    assert chase.load(f"{__name__}.Rows").name == "rows"
    for path, said in (
        ("pi", "must be a dotted path `package.module.name`; got 'pi'."),
        ("math.no_such", "cannot be imported (module 'math' has no attribute 'no_such')"),
        ("no_such_module.x", "cannot be imported (No module named 'no_such_module'); got"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"`custom(path=...)` {said}")):
            chase.load(path)  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match=re.escape("`custom(arguments=...)` needs a class or a function at math.pi")
    ):
        chase.load("math.pi", {"a": 1})


def bowl(x: Tensor, scale: float = 1.0) -> Tensor:
    return scale * x.square().sum(-1)


def made_plant(rate: float = 1.0) -> st.systems.Plant:
    return st.systems.Linear([[0.0, rate], [-rate, 0.0]], [[0.0], [1.0]])


def test_a_function_is_a_target_or_makes_a_plant() -> None:
    x = torch.rand(5, 2, dtype=torch.float64)
    for given, scale in ({}, 1.0), ({"scale": 3.0}, 3.0):
        target = chase.make(OmegaConf.create({"_target_": f"{__name__}.bowl", **given}))
        assert target(x).equal(bowl(x, scale))
    own = f"system=custom system.path={__name__}.made_plant"
    for line, rate in (own, 1.0), (f"{own} system.arguments={{rate:2.0}}", 2.0):
        assert problem(line).system.drift(x).equal(made_plant(rate).drift(x))


def test_states_are_the_stated_one_and_others_in_a_box_around_it() -> None:
    spread = 0.5
    given = {"initial_state": [1.0, -3.0], "trajectories": 200, "spread": spread, "seed": 0}
    states = chase.initial_states(OmegaConf.create(given), 2)
    assert states.shape == (200, 2)
    assert states[0].tolist() == [1.0, -3.0]
    away = states[1:] - states[0]
    assert 0.9 * spread < float(away.max()) <= spread
    assert -spread <= float(away.min()) < -0.9 * spread
    assert float(away.mean(0).abs().max()) < 0.15 * spread


def test_a_list_of_numbers_is_sorted_and_has_no_number_twice() -> None:
    cfg = OmegaConf.create({"a": {"b": [3, 1, 2.0, 1.0]}, "none": [], "word": "x", "zero": [1, 0]})
    assert chase.numbers(cfg, "a.b") == [1.0, 2.0, 3.0]
    for name, said in (
        ("none", "must be a list of numbers; got []"),
        ("word", "must be a list of numbers; got 'x'"),
        ("zero", "must be positive; got 0"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"`staf {name}=...` {said}")):
            chase.numbers(cfg, name)


@pytest.mark.parametrize(("states", "index"), [(4, [0, 2, 5, 7]), (99, list(range(10)))])
def test_states_of_a_trajectory_are_equally_spaced_without_the_last(states: int, index: list[int]) -> None:
    cfg = composing.settings(
        "experiment=layouts", "dt=0.1", "duration=1.0", "trajectories=3", "centers.radius=0.25"
    )
    OmegaConf.update(cfg, "experiment.states", states, force_add=True)
    found = chase.local_problem(cfg, "experiment.states")
    problem = chase.chase_problem(cfg)
    path = chase.simulate(problem.system, problem.initial_states[:1], dt=0.1, steps=10)[0]
    torch.testing.assert_close(found.states, path[index])
    torch.testing.assert_close(found.time, 0.1 * torch.tensor(index).double())
    assert found.radius == 0.25
    cfg.centers.shrink.offset = 0.1
    with pytest.raises(ValueError, match=r"`staf centers.shrink.offset=...` must be null here: .*; got 0.1"):
        chase.local_problem(cfg, "experiment.states")
