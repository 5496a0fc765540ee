"""Many configurations as one tensor batch: each member gets what it gets alone."""

from __future__ import annotations

import itertools
import json
import logging
import pickle
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composing import settings
from omegaconf import DictConfig

from staf_torch.experiments.adp import LoopSolution, Regulation
from staf_torch.experiments.gradient_chase import ChaseSolution, GradientChase
from staf_torch.results import run_record
from staf_torch.signs import SHOWN
from staf_torch.sweeps import job
from staf_torch.sweeps.hydra_compat import parse_override
from staf_torch.sweeps.job import DEFERRED, Computed, Failed, Outcome

SHORT = ("dt=0.05", "duration=0.5", "settle_time=0.25", "figures=false")


def compose(base: Sequence[str], lines: Sequence[str]) -> list[DictConfig]:
    parsed = [parse_override(line) for line in lines]
    swept = [
        one.sweep_string_iterator() if one.is_sweep_override() else [one.get_value_element_as_str()]
        for one in parsed
    ]
    keys = [one.get_key_element() for one in parsed]
    jobs = (
        [f"{key}={value}" for key, value in zip(keys, values, strict=True)]
        for values in itertools.product(*swept)
    )
    return [settings(*SHORT, *base, *job) for job in jobs]


def solve(cfgs: Sequence[DictConfig]) -> list[Outcome]:
    return job.solve(cfgs, SHOWN)


def flat(cfgs: Sequence[DictConfig]) -> list[job.Flat]:
    return [run_record.flat(cfg) for cfg in cfgs]


def groups(cfgs: Sequence[DictConfig]) -> list[list[int]]:
    return job.groups(flat(cfgs))


def solutions(cfgs: Sequence[DictConfig]) -> list[ChaseSolution]:
    found = [outcome.solution for outcome in solve(cfgs) if isinstance(outcome, Computed)]
    assert len(found) == len(cfgs)
    return [solution for solution in found if isinstance(solution, ChaseSolution)]


def words(outcome: Outcome) -> str:
    assert isinstance(outcome, Failed), outcome
    return str(outcome.error)


def chosen(name: str, cfgs: Sequence[DictConfig], together: Sequence[Any]) -> tuple[DictConfig, Any]:
    """The first or, of every other name, the last member, and what it got: they differ in all settings."""
    assert len(cfgs) == len(together)
    index = 0 if len(name) % 2 else -1
    return cfgs[index], together[index]


TWO = "directions=[[1,0],[0,1]],[[0.6,0.8],[-1,0]]"
STARTS = ("centers.radius=0.1,0.3",)
BATCHES = {
    "shrinking": (["kernel=gaussian", "centers.shrink.offset=0.1"], ["kernel.width=0.7,1.3"]),
    "exact": (["optimizer=exact", "kernel=matern", "centers.count=6"], ["kernel.length_scale=0.7,1.3"]),
    "secant": (
        ["predictor=secant", "predictor.guarded=true", "certificate=true"],
        ["seed=3,4", "trajectories=1,3"],
    ),
    "polynomial": (["kernel=polynomial", "centers=directions"], ["kernel.bias=0.5,2", f"centers.{TWO}"]),
    "targets": (
        ["target=cosine", "optimizer=heavy_ball"],
        ["target.phase=0.0,1.0", "optimizer.step=0.5,0.9", "optimizer.momentum=0.3,0.5"],
    ),
    "steps of time": (["system=linear", "kernel=anchored"], ["dt=0.05,0.049", "settle_time=0.3,0.4,9.0"]),
    "integrated": (["system=van_der_pol"], ["dt=0.05,0.049", "system.damping=0.5,1.0"]),
    "single precision": (["dtype=float32", "target=quadratic"], ["target.matrix=1.0,2.0"]),
}


@pytest.mark.parametrize("name", BATCHES)
def test_a_member_gets_what_it_gets_alone(name: str) -> None:
    base, lines = BATCHES[name]
    cfgs = compose(base, [*STARTS, *lines])
    (group,) = groups(cfgs)
    assert group == list(range(len(cfgs)))
    together = GradientChase().solve(cfgs, SHOWN)  # raises where `job.solve` would run each alone
    digits = 1e-9 if name != "single precision" else 1e-3
    cfg, found = chosen(name, cfgs, together)
    (alone,) = solutions([cfg])
    assert isinstance(found, ChaseSolution), found
    for key in ("state", "value"):
        assert np.array_equal(found.history[key], alone.history[key]), key
    weights, size = found.history["weights"], np.abs(alone.history["weights"]).max()
    np.testing.assert_allclose(weights, alone.history["weights"], rtol=digits, atol=digits * size)
    missing = [{key for key, number in one.metrics.items() if number is None} for one in (found, alone)]
    assert missing[0] == missing[1]
    numbers = [{k: v for k, v in one.metrics.items() if v is not None} for one in (found, alone)]
    assert numbers[0] == pytest.approx(numbers[1], rel=digits, abs=digits / 10)
    assert np.array_equal(found.outcome.diverged_at, alone.outcome.diverged_at)
    ends = [one.history["weights"] for one in (together[0], together[-1])]
    assert ends[0].shape != ends[1].shape or not np.array_equal(*ends)  # the settings made a difference


MIXED = ["centers.count=3,6", "centers.radius=0.05,-1,0.2"]


def test_a_sweep_of_numbers_and_counts_is_one_call_for_each_count(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "staf_torch")
    cfgs = compose([], MIXED)
    chosen = groups(cfgs)
    assert [len(group) for group in chosen] == [3, 3]
    found = {
        k: one for group in chosen for k, one in zip(group, solve([cfgs[k] for k in group]), strict=True)
    }
    assert "one after the other" not in caplog.text
    for k, cfg in enumerate(cfgs):
        if cfg.centers.radius < 0:
            assert words(found[k]) == "`ConstantRadius(radius=...)` must be positive; got -1."
            continue
        outcome = found[k]
        assert isinstance(outcome, Computed)
        (alone,) = solutions([cfg])
        assert outcome.metrics == pytest.approx(alone.metrics, rel=1e-9, abs=1e-10)


CLOSED = ("adp.compile=false", "figures=false")
LOOPS = {
    "information": (
        ["adp.trust=0.5", "dt=0.02", "duration=0.12"],
        ["adp.actor=[0.2,0.3,0.4],[0.5,0.5,0.5]", "adp.gains.actor=1.2,2.0", "centers.shrink.gain=1,1.5"],
    ),
    "published": (
        ["adp/law=published", "dt=0.005", "duration=0.03"],
        ["adp.gains.critic_extrapolated=0.25,0.1"],
    ),
    "behind walls": (
        ["adp/policy=lqr", "system=pendulum", "adp.walls.high=[1.0,null]", "adp.optimum.shooting=false"],
        ["system.mass=0.5,2", "initial_state=[0.5,0.0]", "dt=0.005", "duration=0.005"],
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_a_closed_loop_in_a_batch_is_the_one_alone(name: str) -> None:
    base, lines = LOOPS[name]
    cfgs = compose(["experiment=adp", *CLOSED, *base], lines)
    (group,) = groups(cfgs)
    assert group == list(range(len(cfgs)))
    together = Regulation().solve(cfgs, SHOWN)
    digits = 1e-9
    for each in together:
        if isinstance(each, Exception):
            raise each  # which may say that an extra is absent
        assert isinstance(each, LoopSolution)
    cfg, found = chosen(name, cfgs, together)
    (alone,) = Regulation().solve([cfg], SHOWN)
    assert isinstance(alone, LoopSolution)
    for key in ("state", "control", "critic_weights", "actor_weights", "running_cost"):
        ours, theirs = getattr(found.result, key).numpy(), getattr(alone.result, key).numpy()
        np.testing.assert_allclose(ours, theirs, rtol=digits, atol=digits)
    numbers = [{k: v for k, v in one.metrics.items() if v is not None} for one in (found, alone)]
    assert numbers[0] == pytest.approx(numbers[1], rel=100 * digits, abs=digits)
    ends = [one.result.cost.sum().item() for one in (together[0], together[-1])]
    assert ends[0] != ends[1]  # the settings made a difference


@pytest.mark.parametrize(
    ("lines", "shared"),
    [
        (["kernel=gaussian,matern", "centers.count=3,6", "seed=1,2"], [[0, 1], [2, 3], [4, 5], [6, 7]]),
        (["kernel=matern", "kernel.smoothness=0.5,1.5", "kernel.length_scale=1,2"], [[0, 1, 2, 3]]),
        (["centers.shrink.offset=null,0.1,0.2", "optimizer.inner_steps=1,2"], [[0], [1], [2, 4], [3, 5]]),
        (["dt=0.05,0.1", "duration=0.5,1.0"], [[0, 3], [1], [2]]),  # of as many steps
    ],
)
def test_only_what_may_differ_within_a_batch_shares_a_group(
    lines: list[str], shared: list[list[int]]
) -> None:
    assert groups(compose([], lines)) == shared


def test_a_member_that_is_refused_fails_alone_with_its_own_sentence() -> None:
    cfgs = compose([], ["centers.count=3,7", "centers.radius=0.1,oops"])
    assert groups(cfgs) == [[0], [1], [2], [3]]
    for index, said in ((1, "must be a number; got 'oops'"), (2, "must be one of")):
        assert said in words(solve([cfgs[index]])[0])


def test_a_member_that_diverges_leaves_the_others_as_they_are() -> None:
    cfgs = compose(["system=van_der_pol", "dt=0.2", "duration=4"], ["initial_state=[1.0,0.0],[90.0,90.0]"])
    (kept, lost), (alone,) = solutions(cfgs), solutions(cfgs[:1])
    assert lost.metrics["diverged_fraction"] == 1
    assert lost.metrics["ultimate_error"] is None
    assert kept.metrics == alone.metrics
    assert np.array_equal(kept.history["weights"], alone.history["weights"])


def test_warnings_belong_to_the_members_that_they_are_about(tmp_path: Path) -> None:
    cfgs = compose(["history=false"], ["centers.radius=0.1,1.5", "seed=1,2"])
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        solved = solutions(cfgs)
    assert given == []
    assert [len(one.warnings) for one in solved] == [0, 0, 1, 1]
    with pytest.warns(UserWarning, match=r"\|x\| r = 1.5 > 1"):
        GradientChase().write(cfgs[2], tmp_path, solved[2])


def test_writing_what_was_solved_leaves_what_a_run_leaves(tmp_path: Path) -> None:
    cfgs = compose(["kernel=gaussian"], ["seed=1,2", "trajectories=2"])
    solved = pickle.loads(pickle.dumps(solve(cfgs)))
    for name, cfg in (("batch", cfgs[0]), ("alone", cfgs[0])):
        (tmp_path / name).mkdir()
        outcome = DEFERRED if name == "alone" else solved[0]
        job.completion(cfg, outcome)(cfg, tmp_path / name)
    files = [{p.name: p for p in (tmp_path / name).iterdir()} for name in ("batch", "alone")]
    assert files[0].keys() == files[1].keys() == {"metrics.json", "history.npz"}
    with np.load(files[0]["history.npz"]) as found, np.load(files[1]["history.npz"]) as expected:
        assert found.files == expected.files
        for key in ("time", "state", "value", "estimate", "weights"):
            assert np.array_equal(found[key], expected[key]), key
    numbers = [json.loads(each["metrics.json"].read_text()) for each in files]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-9, abs=1e-12)
