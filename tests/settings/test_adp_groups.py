"""Closed loops from settings: the groups below `adp`, a user's own options."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import composing
import pytest
import torch
from omegaconf import DictConfig

from staf_torch import adp, systems
from staf_torch.adp.problem import AdpProblem
from staf_torch.cli.staf import config_directory
from staf_torch.settings.adp import adp_problem, make_cost
from staf_torch.sweeps.hydra_compat.program import trusted

GROUPS = ("policy", "law", "basis", "extrapolation", "cost")
OPTIONS = [
    f"adp/{group}={path.stem}"
    for group in GROUPS
    for path in sorted((Path(config_directory()) / "adp" / group).glob("*.yaml"))
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


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_builds_a_loop_with_a_finite_control(option: str) -> None:
    needs = ["adp/policy=lqr"] if option == "adp/cost=bounded_input" else []
    assert torch.isfinite(control(problem(option, *needs))).all()


def test_options_combine() -> None:
    built = problem(
        "adp/policy=rollout", "adp/basis=quadratic", "adp/cost=bounded_input", "adp.cost.bound=0.2"
    )
    assert built.dt == 0.01  # the period of the rollout policy
    assert control(built).abs().max() <= 0.2
    learner = problem("adp/basis=quadratic", "adp/law=published", "adp/extrapolation=quadrature").controller
    assert isinstance(learner, adp.ActorCritic)
    assert (learner.basis.count, learner.extrapolation.count) == (3, 49)
    assert isinstance(learner.law, adp.Published)
    torch.testing.assert_close(learner.critic, torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))


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


def test_a_cost_has_the_sizes_of_any_kind_of_plant() -> None:
    step = systems.StepPlant(lambda x, u: 0.9 * x + u.sum(-1, keepdim=True), dim=3, inputs=2, dt=0.1)
    for plant, dim, inputs in ((step, 3, 2), (systems.ThreeState(), 3, 2), (systems.TwoState(), 2, 1)):
        cost = make_cost(settings(), plant)
        assert (cost.dim, cost.inputs) == (dim, inputs)
