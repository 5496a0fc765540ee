"""The parts of a chase from settings, one by one: centers, caches, metrics, states, lists of numbers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import composing
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

import staf_torch as st
from staf_torch.metrics import Metric
from staf_torch.settings import chase
from staf_torch.settings.plain import PlainSettings

SHRINK = {"offset": 0.2, "gain": 2.0}
POINTS = [[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]


# Centers


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"layout": "rings", "count": 6}, lambda: st.rings(6)),
        ({"layout": "polygon", "count": 4, "dim": 2}, lambda: st.polygon(4)),
        ({"layout": "simplex", "dim": 3}, lambda: st.simplex(3)),
        ({"layout": "simplex", "dim": 3, "count": 4}, lambda: st.simplex(3)),
        ({"layout": "cross_polytope", "dim": 2, "count": 4}, lambda: st.cross_polytope(2)),
        ({"layout": "ball", "dim": 3, "count": 4}, lambda: st.ball(4, 3)),
        ({"layout": "directions", "directions": POINTS}, lambda: torch.tensor(POINTS).double()),
        ({"layout": "directions", "directions": POINTS, "dim": 2}, lambda: torch.tensor(POINTS).double()),
    ],
)
@pytest.mark.parametrize(
    "size", [{}, {"radius": 0.3}, {"radius": 0.3, "shrink": {"offset": 0.2, "gain": 2.0}}]
)
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


def test_a_shrinking_radius_has_a_gain_of_one_and_none_shrinks_without_an_offset() -> None:
    made = chase.centers_of("rings", 3, 0.3, {"offset": 0.2})
    assert float(made.radius(torch.ones(2).double())) == pytest.approx(0.3 * 2.2 / 3)
    for shrink in ({"offset": None, "gain": 2.0}, {}, None):
        assert isinstance(chase.centers_of("rings", 3, 0.3, shrink).radius, st.ConstantRadius)
    assert chase.make_radius(0.5, None, 3.0) == 0.5


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"layout": "no"},
            "'simplex', 'cross_polytope', 'ball', 'directions'; got 'no'.",
        ),
        (
            {"layout": "polygon", "count": 3, "dim": 3},
            "`centers=polygon` lies in the plane, but the system has 3 states: use",
        ),
        ({"layout": "rings", "count": None}, "`rings(count=...)` must be an integer; got None."),
        ({"layout": "directions"}, "`staf centers.directions=...` must be a list of points; got None."),
        (
            {"layout": "directions", "directions": "???"},
            "centers.directions=...` must be a list of points; got '???'.",
        ),
        (
            {"layout": "directions", "directions": [[1.0]], "dim": 2},
            "directions=...` must have 2 entries, one a state; got",
        ),
        (
            {"layout": "ball", "count": 3},
            "`centers(dim=...)` must be given for the layout ball: instantiate(..., dim=n)",
        ),
        (
            {"layout": "simplex", "dim": 2, "count": 4},
            "must be 3 (or null) for simplex with 2 states; got 4.",
        ),
        (
            {"layout": "simplex", "dim": 2, "count": "4"},
            "centers.count=...` must be an integer; got '4'.",
        ),
        ({"layout": "simplex", "dim": 2, "count": 0}, "`staf centers.count=...` must be at least 1; got 0."),
    ],
)
def test_centers_that_there_are_not_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        chase.centers_of(**given)


def test_settings_of_centers_are_read_plain_or_as_hydras() -> None:
    node = {"layout": "simplex", "count": None, "radius": 0.2, "shrink": None}
    target = {"_target_": "staf_torch.settings.chase.centers_of"}
    for cfg in (OmegaConf.create(node | target), PlainSettings(node | target)):
        made = chase.make_centers(cfg, 3)
        assert torch.equal(made.directions, st.simplex(3))
        assert float(made.radius(torch.zeros(3).double())) == 0.2


# Parts


def test_equal_settings_share_one_object_and_its_warning_is_said_each_time() -> None:
    parts, made = chase.Parts(), []

    def make(*given: Any) -> object:
        made.append(given)
        if len(given) > 1:
            warnings.warn("two", stacklevel=1)
        return object()

    node = {"a": [1, {"b": 2}]}
    first = parts(make, OmegaConf.create(node))
    assert parts(make, OmegaConf.create(node)) is first
    assert parts(make, PlainSettings(node)) is first
    assert parts(make, OmegaConf.create({"a": [1, {"b": 3}]})) is not first
    assert parts(lambda cfg: object(), OmegaConf.create(node)) is not first
    assert parts(make, 1) is parts(make, 1) is not parts(make, "1")
    place = {"a": Path("b")}  # which JSON does not have
    assert parts(make, PlainSettings(place)) is parts(make, OmegaConf.create(place))
    assert parts(make, PlainSettings(place)) is not parts(make, PlainSettings({"a": Path("c")}))
    thing = [1]
    assert parts(make, thing) is parts(make, thing) is not parts(make, [1])
    assert len(made) == 8
    for _ in range(2):
        with pytest.warns(UserWarning, match="^two$"):
            again = parts(make, 1, None)
    assert parts._made[make, 1, None] == (again, ["two"])
    assert len(made) == 9


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
    with pytest.raises(ValueError, match=r"must have a name that no other metric has; got 'ball_error'"):
        metric("Rows", name="ball_error")
    for target in ("rows_and_words", "Demanding"):
        with pytest.raises(
            ValueError, match=r"metric=...` must be a `staf_torch.metrics.Metric`, or several"
        ):
            metric(target)


class Demanding(dict[str, Any]):
    """No metric."""


def test_a_path_is_a_class_that_is_called_or_a_thing_as_it_is() -> None:
    import math

    assert chase.load("math.pi") == math.pi
    assert chase.load("math.cos", {}, inner_steps=3) is math.cos
    assert chase.load(f"{__name__}.Rows", {"name": "x"}).name == "x"
    assert chase.load(f"{__name__}.Rows").name == "rows"
    for path, said in (
        ("pi", "must be a dotted path `package.module.name`; got 'pi'."),
        (3, "must be a dotted path `package.module.name`; got 3."),
        (
            "math.no_such",
            "cannot be imported (module 'math' has no attribute 'no_such')",
        ),
        (
            "no_such_module.x",
            "cannot be imported (No module named 'no_such_module'); got",
        ),
    ):
        with pytest.raises(ValueError, match=re.escape(f"`custom(path=...)` {said}")):
            chase.load(path)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=re.escape("`custom(arguments=...)` needs a class at math.pi")):
        chase.load("math.pi", {"a": 1})


def test_settings_are_plain_python_whoever_made_them() -> None:
    tree = {"a": 1, "b": {"c": [1, 2]}}
    for cfg in (OmegaConf.create(tree), PlainSettings({"a": 1, "b": PlainSettings({"c": [1, 2]})})):
        found = chase.plain(cfg)
        assert found == tree
        assert (type(found), type(found["b"]), type(found["b"]["c"])) == (dict, dict, list)
    assert chase.plain(OmegaConf.create({"a": 1, "b": "${a}"})) == {"a": 1, "b": 1}
    assert chase.plain("x") == "x"


def test_a_placement_is_a_device_and_a_dtype_that_can_be_used() -> None:
    assert chase.placement("cpu", "float32") == (torch.device("cpu"), torch.float32)
    assert chase.placement(torch.device("cpu"), "float64")[1] == torch.float64
    with pytest.raises(ValueError, match=r"`staf device=...` cannot be used here \(.*\); got 'nowhere'\.$"):
        chase.placement("nowhere", "float64")
    with pytest.raises(ValueError, match=r"`staf dtype=...` must be one of 'float64', 'float32'; got 'half'"):
        chase.placement("cpu", "half")


class Undimensioned:
    """A system that takes states of any dimension."""


class Dimensioned(Undimensioned):
    """One that states its own."""

    def __init__(self, dim: Any) -> None:
        self.dim = dim


def test_the_dimension_is_the_systems_or_else_that_of_the_state() -> None:
    assert chase._dimension(Dimensioned(3), [1.0, 2.0]) == 3  # type: ignore[arg-type]
    assert chase._dimension(Undimensioned(), [1.0, 2.0]) == 2  # type: ignore[arg-type]
    assert chase._dimension(Dimensioned(None), OmegaConf.create([1.0] * 4)) == 4  # type: ignore[arg-type]
    assert chase._dimension(Dimensioned(1), []) == 1  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"`Dimensioned\(dim=...\)` must be at least 1; got 0"):
        chase._dimension(Dimensioned(0), [1.0])  # type: ignore[arg-type]


@pytest.mark.parametrize("spread", [0.5, 2.0])
def test_states_are_the_stated_one_and_others_in_a_box_around_it(spread: float) -> None:
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
        ("absent", "must be a list of numbers; got None"),
        ("zero", "must be positive; got 0"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"`staf {name}=...` {said}")):
            chase.numbers(cfg, name)
    assert chase.case_name(0.10, 1e-3) == "r0.1.eps0.001"


@pytest.mark.parametrize(
    ("states", "index"), [(1, [0]), (4, [0, 2, 5, 7]), (10, list(range(10))), (99, list(range(10)))]
)
def test_states_of_a_trajectory_are_equally_spaced_without_the_last(states: int, index: list[int]) -> None:
    cfg = composing.settings(
        "experiment=layouts", "dt=0.1", "duration=1.0", "trajectories=3", "centers.radius=0.25"
    )
    OmegaConf.update(cfg, "experiment.states", states, force_add=True)
    found = chase.local_problem(cfg, "experiment.states")
    problem = chase.chase_problem(cfg)
    path = torch.cat(
        list(chase.trajectory(problem.system, problem.initial_states[:1], dt=0.1, steps=10)), dim=1
    )[0]
    torch.testing.assert_close(found.states, path[index])
    torch.testing.assert_close(found.time, 0.1 * torch.tensor(index).double())
    assert found.radius == 0.25
    cfg.centers.shrink.offset = 0.1
    with pytest.raises(ValueError, match=r"`staf centers.shrink.offset=...` must be null here: .*; got 0.1"):
        chase.local_problem(cfg, "experiment.states")
