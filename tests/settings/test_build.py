"""From settings to objects: every option composes, and every wrong value is named."""

from __future__ import annotations

import functools
from pathlib import Path

import composing
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from staf_torch import StateFollowingCenters, StateRadius
from staf_torch.cli.staf import config_directory
from staf_torch.settings.chase import (
    ChaseProblem,
    _key,
    chase_problem,
    initial_states,
    make,
    make_centers,
)
from staf_torch.sweeps.hydra_compat.program import named_packages, trusted

GROUPS = ("kernel", "centers", "target", "system", "optimizer")
OPTIONS = [
    f"{group}={path.stem}"
    for group in GROUPS
    for path in sorted((Path(config_directory()) / group).glob("*.yaml"))
    if path.stem
    not in ("custom", "mujoco")  # of the user's own; the second in tests/settings/test_adp_groups.py
]


@functools.cache
def composed(*choices: str) -> DictConfig:
    return composing.settings(*choices)


def settings(line: str) -> DictConfig:
    """A command line as Hydra would compose it, each choice of groups but once."""
    words = line.split()
    choices = [word for word in words if word.partition("=")[0] in GROUPS]
    values = [word for word in words if word not in choices]
    cfg = composed(*choices).copy()
    for value in OverridesParser.create().parse_overrides(values):
        OmegaConf.update(cfg, value.key_or_group, value.value(), force_add=value.is_add())
    return cfg


def problem(line: str) -> ChaseProblem:
    return chase_problem(settings(line))


NEEDS = {  # what some options cannot do without
    "centers=directions": "centers.directions=[[0,1],[1,0],[-1,0]]",
    "system=cart_pole": "centers=simplex initial_state=[0,0,0,0]",
    "system=planar_quadrotor": "centers=simplex initial_state=[0,0,0,0,0,0]",
    "system=two_link_robot": "centers=simplex initial_state=[0,0,0,0]",
    "system=three_state": "centers=simplex initial_state=[0,0,0]",
}


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_of_every_group_builds_its_problem(option: str) -> None:
    built = problem(f"{option} {NEEDS.get(option, '')}")
    assert built.initial_states.shape == (1, built.basis.dim)
    assert built.basis.count >= 3


def test_defaults_are_the_simulation_of_the_paper() -> None:
    built = problem("")
    assert built.initial_states.tolist() == [[1.0, 0.0]]
    assert (built.dt, built.steps, built.inner_steps, built.settle_time) == (0.01, 1128, 10, 5.0)
    assert torch.equal(
        built.basis.centers.offsets(torch.zeros(2).double())[0], torch.tensor([0.0, 0.1], dtype=torch.float64)
    )


@pytest.mark.parametrize(
    ("dt", "duration", "steps"), [(0.1, 0.3, 3), (0.01, 0.07, 7), (0.3, 0.9, 3), (1.0, 1.5, 1)]
)
def test_number_of_steps_survives_rounding(dt: float, duration: float, steps: int) -> None:
    assert problem(f"dt={dt} duration={duration}").steps == steps


def test_first_states_do_not_depend_on_how_many_follow_and_repeat_by_seed() -> None:
    few, many = (problem(f"trajectories={b} seed=7").initial_states for b in (3, 50))
    assert torch.equal(many[:3], few)
    assert many[0].tolist() == [1.0, 0.0]
    assert ((many - many[0]).abs() <= 0.5).all()
    assert len(set(map(tuple, many.tolist()))) == 50
    assert torch.equal(problem("trajectories=3 seed=7").initial_states, few)
    assert not torch.equal(problem("trajectories=3 seed=8").initial_states, few)


def test_single_precision_reaches_every_part() -> None:
    built = problem("dtype=float32 kernel=gaussian target=quadratic trajectories=4")
    assert built.initial_states.dtype == torch.float32
    double = problem("kernel=gaussian target=quadratic trajectories=4")
    torch.testing.assert_close(built.initial_states, double.initial_states.float(), rtol=0, atol=0)
    floating = [buffer for buffer in built.basis.buffers() if buffer.is_floating_point()]
    assert floating
    assert all(buffer.dtype == torch.float32 for buffer in floating)


def test_an_offset_makes_the_radius_shrink() -> None:
    radius = problem("centers.shrink.offset=0.01 centers.shrink.gain=2").basis.centers.radius
    assert isinstance(radius, StateRadius)
    x = torch.tensor([1.0, 0.0]).double()
    assert float(radius(x)) == pytest.approx(0.1 * 1.01 / 3)


BAD: dict[str, tuple[str, tuple[str, ...]]] = {
    "count is a word": ("centers.count=abc", ("(count=...)` must be an integer; got 'abc'.",)),
    "count of a simplex": ("centers=simplex centers.count=7", ("must be 3 (or null) for simplex", "got 7")),
    "count of a ball": (
        "centers=ball centers.count=null",
        ("`ball(count=...)` must be an integer; got None.",),
    ),
    "radius is a word": ("centers.radius=abc", ("(radius=...)` must be a number; got 'abc'.",)),
    "negative offset": ("centers.shrink.offset=-1", ("(offset=...)` must not be negative; got -1.",)),
    "width is not a number": ("kernel=gaussian kernel.width=nan", ("(width=...)` must be finite; got nan.",)),
    "smoothness": ("kernel=matern kernel.smoothness=1", ("(smoothness=...)` must be one of 0.5, 1.5, 2.5",)),
    "long initial state": ("initial_state=[1,2,3]", ("initial_state=...` must have 2 entries",)),
    "word in the initial state": (
        "initial_state=[a,0.0]",
        ("initial_state=...` must be a list of numbers",),
    ),
    "initial state is a number": ("initial_state=5", ("initial_state=...` must be a list of numbers",)),
    "initial state is missing": ("initial_state=null", ("initial_state=...` must be a list of numbers",)),
    "negative dt": ("dt=-0.01", ("`staf dt=...` must be positive; got -0.01.",)),
    "dt is infinite": ("dt=inf", ("`staf dt=...` must be finite; got inf.",)),
    "dt is null": ("dt=null", ("`staf dt=...` must be a number; got None.",)),
    "duration is a word": ("duration=abc", ("`staf duration=...` must be a number; got 'abc'.",)),
    "settle time is a word": ("settle_time=abc", ("`staf settle_time=...` must be a number; got 'abc'.",)),
    "half a trajectory": ("trajectories=1.5", ("`staf trajectories=...` must be an integer; got 1.5.",)),
    "negative spread": ("trajectories=2 spread=-1", ("`staf spread=...` must be positive; got -1.",)),
    "negative seed": ("seed=-1", ("`staf seed=...` must be at least 0; got -1.",)),
    "no iterations": (
        "optimizer.inner_steps=0",
        ("`staf optimizer.inner_steps=...` must be at least 1; got 0.",),
    ),
    "unknown device": ("device=nope", ("`staf device=...` cannot be used here",)),
    "unknown dtype": ("dtype=float16", ("`staf dtype=...` must be one of 'float64', 'float32'",)),
    "planar layout in space": (
        "system=linear system.matrix=[[0,1,0],[0,0,1],[-1,-1,-1]] initial_state=[1,0,0]",
        ("`centers=rings` lies in the plane, but the system has 3 states",),
    ),
    "matrix that is not square": (
        "system=linear system.matrix=[[1,2]]",
        ("`Linear(matrix=...)` must have 1",),
    ),
    "frequency": ("system.frequency=0", ("`Oscillator(frequency=...)` must be positive; got 0.",)),
    "asymmetric target": ("target=quadratic target.matrix=[[1,2],[0,1]]", ("must be symmetric",)),
    "path without a module": ("target=custom target.path=bowl", ("must be a dotted path",)),
    "arguments of a function": (
        "target=custom target.path=math.cos +target.arguments.a=1",
        ("needs a class at math.cos",),
    ),
    "kernel that is none": ("kernel=custom kernel.path=math.cos", ("(kernel=...)` must be a Kernel",)),
    "system that is none": ("system=custom system.path=math.cos", ("must be a plant with a method `drift`",)),
    "target that is none": ("target=custom target.path=math.pi", ("`staf target=...` must be callable",)),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_value_is_named(name: str) -> None:
    line, expected = BAD[name]
    own = trusted(named_packages(line.split()))  # as of the command
    with own, pytest.raises(Exception) as found:  # noqa: PT011 (Hydra wraps some; the command unwraps them)
        problem(line)
    messages, error = [], found.value
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    for words in expected:
        assert words in "\n".join(messages)


def test_settings_that_differ_by_what_they_refer_to_are_not_the_same_part() -> None:
    one, two = (OmegaConf.create({"a": value, "part": {"b": "${a}"}}).part for value in (1, 2))
    again = OmegaConf.create({"a": 1, "part": {"b": 1}}).part
    assert _key(one) != _key(two)
    assert _key(one) == _key(again)
    assert _key(one) != _key(None)


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


def test_other_initial_states_are_drawn_in_a_box_around_the_stated_one() -> None:
    cfg = composing.settings("trajectories=4", "seed=3", "spread=0.2", "initial_state=[1.0,-2.0]")
    drawn = torch.rand(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    low = torch.tensor([0.8, -2.2], dtype=torch.float64)
    found = initial_states(cfg, 2)
    torch.testing.assert_close(found[0], low + 0.2)
    torch.testing.assert_close(found[1:], low + 0.4 * drawn)
