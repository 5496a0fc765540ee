"""Closed loops from settings: the groups below `adp`, a user's own options."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import composing
import pytest
import torch
from omegaconf import DictConfig
from torch import nn

from staf_torch import adp
from staf_torch.adp.loop.simulation import AdpProblem
from staf_torch.settings import adp as loops
from staf_torch.settings import config_directory
from staf_torch.settings.adp import adp_problem
from staf_torch.settings.chase import chase_problem
from staf_torch.sweeps.hydra_compat import trusted

OPTIONS = {
    group: [path.stem for path in sorted((Path(config_directory()) / "adp" / group).glob("*.yaml"))]
    for group in ("policy", "law", "basis", "extrapolation", "cost")
}
PARTS = [OPTIONS[group] for group in ("law", "basis", "extrapolation")]  # of the policy that learns
LINES = [f"adp/policy={option}" for option in OPTIONS["policy"] if option not in ("lqr", "actor_critic")]
LINES += [f"adp/policy=lqr adp/cost={option}" for option in OPTIONS["cost"]]
LINES += [
    "adp/law={} adp/basis={} adp/extrapolation={}".format(*(part[number % len(part)] for part in PARTS))
    for number in range(max(map(len, PARTS)))
]


def settings(*overrides: str) -> DictConfig:
    return composing.settings("experiment=adp", *overrides)


def problem(*overrides: str) -> AdpProblem:
    return adp_problem(settings(*overrides))


def control(built: AdpProblem) -> torch.Tensor:
    """The first control from the first state."""
    x = built.initial_states
    uniform = x.new_full((len(x), built.controller.draws, x.shape[1]), 0.3)
    return built.controller.step(x, built.controller.init(x), uniform, built.dt)[0]


@pytest.mark.parametrize("line", LINES)
def test_every_option_builds_a_loop_with_a_finite_control(line: str) -> None:
    assert torch.isfinite(control(problem(*line.split()))).all()


def test_options_combine() -> None:
    built = problem(
        "adp/policy=rollout", "adp/basis=quadratic", "adp/cost=bounded_input", "adp.cost.bound=0.2"
    )
    assert built.dt == 0.01  # the period of the rollout policy
    assert control(built).abs().max() <= 0.2


MODULE = '''
import torch
from staf_torch import adp, systems

class Pump(torch.nn.Module):
    """A policy of x alone, which asks for the plant by name."""
    def __init__(self, system, gain=2.0):
        super().__init__()
        self.inputs, self.gain = system.inputs, gain
    def forward(self, x):
        return -self.gain * x[..., :self.inputs]

class Fourth(adp.ValueBasis):
    def __init__(self, dim, scale):
        super().__init__()
        self.dim = self.count = dim
        self.scale = scale
    def forward(self, y, x):
        return self.scale * (y.square() + y.pow(4))
    def gradient(self, y, x):
        return torch.diag_embed(self.scale * (2 * y + 4 * y.pow(3)))

class Doubled(adp.QuadraticCost):
    def __init__(self, factor, dim, inputs):
        super().__init__(factor, factor, dim, inputs)

def down(x):
    return -x[..., 1:]
'''


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A user's folder: a module, and an option of each group in YAML, found through Hydra's search path."""
    (tmp_path / "my_control.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in {
        "policy/pump": "_target_: my_control.Pump\ngain: 3.0",
        "policy/down": "_target_: my_control.down\n_partial_: true",
        "basis/fourth": "_target_: my_control.Fourth\nscale: 0.5",
        "basis/pumped": "_target_: my_control.Pump\nsystem: {_target_: staf_torch.systems.TwoState}",
        "cost/doubled": "_target_: my_control.Doubled\nfactor: 2.0",
    }.items():
        path = tmp_path / "settings" / "adp" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    with trusted(["my_control"]):
        yield tmp_path / "settings"


def test_a_class_and_a_yaml_of_ones_own_make_a_variant(own: Path) -> None:
    path = f"hydra.searchpath=[file://{own}]"
    built = problem(path, "adp/policy=pump", "adp/cost=doubled")
    assert torch.equal(control(built), -3.0 * built.initial_states[:, :1])
    assert built.controller.label == "Pump"
    assert torch.equal(built.cost.q, 2 * torch.eye(2, dtype=torch.float64))
    assert torch.equal(control(problem(path, "adp/policy=down")), -built.initial_states[:, 1:])
    learner = problem(path, "adp/basis=fourth").controller
    assert isinstance(learner, adp.ActorCritic)
    assert learner.basis.scale == 0.5


def test_an_object_of_another_kind_is_refused_by_name(own: Path) -> None:
    with pytest.raises(ValueError, match=r"`staf adp.basis=...` must be a ValueBasis; got Pump"):
        problem(f"hydra.searchpath=[file://{own}]", "adp/basis=pumped")


def test_model_of_mujoco_is_a_plant_of_closed_loops(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    path = tmp_path / "cart.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="j" type="slide" axis="1 0 0"/><geom size="0.1"/></body>'
        '</worldbody><actuator><motor joint="j"/></actuator></mujoco>'
    )
    model = ("system=mujoco", f"system.model={path}", "system.dt=0.02", "initial_state=[0.1,0.0]", "dt=0.02")
    built = problem(*model, "adp/policy=lqr")
    assert (built.dt, built.system.period) == (0.02, 0.02)
    assert float(control(built)) < 0
    with pytest.raises(ValueError, match=r"`ActorCritic\(model=...\)` must be a ControlAffineSystem"):
        problem(*model)


@pytest.mark.parametrize(
    ("steps", "batch", "every"),
    [(100, 1, 1), (999, 401, 3), (8, 10**5, 4)],
)
def test_of_many_states_so_few_are_recorded_that_they_fit(steps: int, batch: int, every: int) -> None:
    line = ("adp/policy=lqr", "dt=0.01", f"duration={0.01 * steps}", f"trajectories={batch}")
    assert problem(*line).every == every
    assert problem(*line, "adp.record_every=7").every == 7


def test_a_loop_has_the_steps_that_fit_its_duration_and_its_own_choices() -> None:
    built = problem(
        "adp/policy=lqr",
        "dt=0.1",
        "duration=1.04",
        "seed=5",
        "trajectories=3",
        "adp.record_every=2",
        "adp.integrator=euler",
    )
    assert (built.dt, built.steps, built.every, built.seed, built.integrator) == (0.1, 10, 2, 5, "euler")
    assert built.initial_states.shape == (3, 2)
    assert problem("adp/policy=lqr", "dt=0.1", "duration=0.05001").steps == 1
    with pytest.raises(ValueError, match=r"duration=...` must be at least one step \(dt=0.1\); got 0.049"):
        problem("adp/policy=lqr", "dt=0.1", "duration=0.049")
    single = problem("adp/policy=lqr", "dtype=float32")
    assert single.initial_states.dtype == torch.float32
    for module in (single.system, single.cost, single.controller):
        assert isinstance(module, nn.Module)
        assert {buffer.dtype for buffer in module.buffers() if buffer.is_floating_point()} <= {torch.float32}


def test_a_problem_is_where_and_as_precise_as_the_settings_say() -> None:
    """On a device without numbers, which every machine has."""
    asked = ("device=meta", "dtype=float32")
    loop = loops.adp_problem(composing.settings("experiment=adp", "adp/policy=lqr", *asked))
    chased = chase_problem(composing.settings(*asked))
    parts = loop.system, loop.cost, loop.controller, chased.basis
    held = [each for part in parts for each in part.state_dict().values() if each.is_floating_point()]
    assert held
    for each in (loop.initial_states, chased.initial_states, *held):
        assert (each.device.type, each.dtype) == ("meta", torch.float32)


def test_options_of_groups_are_exchanged_by_name_and_numbers_as_they_are() -> None:
    cfg = composing.settings("experiment=adp")
    new = loops.changed(cfg, {"policy": "lqr", "trust": 3.0})
    assert new.adp.policy["_target_"] != cfg.adp.policy["_target_"]
    assert (new.adp.trust, cfg.adp.trust != 3.0) == (3.0, True)
    with pytest.raises(ValueError, match=r"`staf adp.policy=...` must be one of .*'lqr'.*; got 'no'"):
        loops.changed(cfg, {"policy": "no"})


def test_weights_are_those_of_the_settings() -> None:
    weights = "adp.critic=[0.1,0.2,0.3]", "adp.actor=[0.4,0.5,0.6]", "adp.trust=null"
    learner = problem(*weights).controller
    assert isinstance(learner, adp.ActorCritic)
    assert (learner.critic.tolist(), learner.actor.tolist()) == ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
