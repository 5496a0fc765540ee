"""The parts of a closed loop from settings, one by one, and the settings of many members."""

from __future__ import annotations

from typing import Any

import composing
import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from staf_torch import adp
from staf_torch.settings import adp as loops
from staf_torch.settings.chase import chase_problem
from staf_torch.settings.plain import ManySettings, PlainSettings, to_read


@pytest.mark.parametrize(
    ("wanted", "steps", "batch", "every"),
    [
        (7, 100, 1, 7),
        (None, 100, 1, 1),
        (None, 200_000, 1, 1),
        (None, 200_001, 1, 3),
        (None, 1000, 400, 2),
        (None, 999, 401, 3),
        (None, 7, 10**5, 7),
        (None, 8, 10**5, 4),
        (None, 5, 10**6, 5),
    ],
)
def test_of_many_states_so_few_are_recorded_that_they_fit(
    wanted: Any, steps: int, batch: int, every: int
) -> None:
    assert loops._every(wanted, steps, batch) == every
    for value, said in ((0, "must be at least 1; got 0"), ("a", "must be an integer; got 'a'")):
        with pytest.raises(ValueError, match=f"`staf adp.record_every=...` {said}"):
            loops._every(value, 3, 1)


def optimum(**given: Any) -> Any:
    usual = {"shooting": True, "states": 0, "horizon": None, "intervals": None}
    return loops._optimum_settings(OmegaConf.create(usual | given))


def test_settings_of_the_optimum_are_checked() -> None:
    found = optimum(states=3, horizon=2, intervals=4)
    assert (found.shooting, found.states, found.horizon, found.intervals) == (True, 3, 2.0, 4)
    found = optimum()
    assert (found.states, found.horizon, found.intervals) == (0, None, None)
    for wrong, said in (
        ({"shooting": 1}, "shooting=...` must be true or false"),
        ({"states": -1}, "states=...` must be at least 0"),
        ({"horizon": 0}, "horizon=...` must be positive"),
        ({"intervals": 3}, "intervals=...` must be at least 4"),
    ):
        with pytest.raises(ValueError, match=f"`staf adp.optimum.{said}"):
            optimum(**wrong)


def test_settings_of_members_are_made_once_and_only_where_they_are_asked_for() -> None:
    asked = []

    def make(index: int) -> Any:
        asked.append(index)
        return OmegaConf.create({"made": index})

    plains = [PlainSettings({"plain": 0}), None, PlainSettings({"plain": 2})]
    many = ManySettings(plains, [{"k": k} for k in range(3)], make)
    assert len(many) == 3
    assert many.read() == [plains[0], {"made": 1}, plains[2]]
    assert many[-1].made == many[2].made == 2
    assert asked == [1, 2]
    with pytest.raises(IndexError):
        many[3]
    part = many[1:]
    assert isinstance(part, ManySettings)
    assert [dict(each) for each in part.flat] == [{"k": 1}, {"k": 2}]
    assert [each.made for each in part] == [1, 2]
    assert to_read(many.of([2, 0])) == [plains[2], plains[0]]
    others = [OmegaConf.create({"a": 1})]
    assert to_read(others) is others


def looped(*overrides: str) -> Any:
    return loops.adp_problem(composing.settings("experiment=adp", "adp/policy=lqr", *overrides))


def test_a_loop_has_the_steps_that_fit_its_duration_and_its_own_choices() -> None:
    built = looped(
        "dt=0.1", "duration=1.04", "seed=5", "trajectories=3", "adp.record_every=2", "adp.integrator=euler"
    )
    assert (built.dt, built.steps, built.every, built.seed, built.integrator) == (0.1, 10, 2, 5, "euler")
    assert built.initial_states.shape == (3, 2)
    assert looped("dt=0.1", "duration=0.05001").steps == 1
    with pytest.raises(ValueError, match=r"duration=...` must be at least one step \(dt=0.1\); got 0.049"):
        looped("dt=0.1", "duration=0.049")
    single = looped("dtype=float32")
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


def test_walls_put_a_filter_before_the_policy() -> None:
    assert not isinstance(looped().controller, adp.SafetyFilter)
    for low, high in (("null", "[2.0,3.0]"), ("[-2.0,null]", "null")):
        built = looped(f"adp.walls.low={low}", f"adp.walls.high={high}", "adp.walls.decay=3.0", "dt=0.02")
        assert isinstance(built.controller, adp.SafetyFilter)


def test_a_policy_that_learns_is_supervised_where_it_is_trusted_only_so_far() -> None:
    for trust, kind in (("null", adp.ActorCritic), ("0.5", adp.Supervised)):
        cfg = composing.settings("experiment=adp", f"adp.trust={trust}")
        assert type(loops.adp_problem(cfg).controller) is kind


def test_options_of_groups_are_exchanged_by_name_and_numbers_as_they_are() -> None:
    cfg = composing.settings("experiment=adp")
    new = loops.changed(cfg, {"policy": "lqr", "trust": 3.0})
    assert new.adp.policy["_target_"] != cfg.adp.policy["_target_"]
    assert (new.adp.trust, cfg.adp.trust != 3.0) == (3.0, True)
    with pytest.raises(ValueError, match=r"`staf adp.policy=...` must be one of .*'lqr'.*; got 'no'"):
        loops.changed(cfg, {"policy": "no"})


class Asking(nn.Module):
    """A policy that asks for all that there is."""

    def __init__(self, **given: Any) -> None:
        super().__init__()
        self.given = given

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


def asking(
    system: Any, model: Any, plant: Any, cost: Any, dim: Any, inputs: Any, lqr: Any,
    basis: Any, extrapolation: Any, law: Any, critic: Any, actor: Any,
) -> Asking:  # fmt: skip
    return Asking(**locals())


def test_a_policy_gets_whatever_it_asks_for_by_name() -> None:
    weights = "adp.critic=[0.1,0.2,0.3]", "adp.actor=[0.4,0.5,0.6]", "adp.trust=null"
    cfg = composing.settings("experiment=adp", *weights)
    learner = loops.adp_problem(cfg).controller
    assert isinstance(learner, adp.ActorCritic)
    assert (learner.critic.tolist(), learner.actor.tolist()) == ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    cfg.adp.policy = {"_target_": f"{__name__}.asking"}
    system = loops.plant(cfg)
    cost = loops.make_cost(cfg, system)
    held = loops.controller(cfg, system, cost)
    assert isinstance(held, adp.Feedback)
    given = held.policy.given
    assert given["system"] is given["model"] is given["plant"] is system
    assert (given["cost"], given["dim"], given["inputs"]) == (cost, 2, 1)
    kinds = {"lqr": adp.LQR, "basis": adp.ValueBasis, "extrapolation": adp.Extrapolation}
    for name, kind in {**kinds, "law": adp.ActorCriticLaw}.items():
        assert isinstance(given[name], kind)
    assert (given["critic"], given["actor"]) == ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
