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

import mpmath as mp
import numpy as np
import pytest
from composing import settings
from omegaconf import DictConfig
from truth import paper

from staf_torch import rings
from staf_torch.experiments.adp import LoopSolution, Regulation
from staf_torch.experiments.gradient_chase import ChaseSolution, GradientChase
from staf_torch.experiments.numbers_of_jobs import ToldOnce
from staf_torch.results import run_record
from staf_torch.signs import SHOWN
from staf_torch.sweeps import batching
from staf_torch.sweeps.batching import DEFERRED, Computed, Failed, Outcome
from staf_torch.sweeps.hydra_compat import parse_override

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
    return batching.solve(cfgs, SHOWN)


def flat(cfgs: Sequence[DictConfig]) -> list[batching.Flat]:
    return [run_record.flat(cfg) for cfg in cfgs]


def groups(cfgs: Sequence[DictConfig]) -> list[list[int]]:
    return batching.groups(flat(cfgs))


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


WIDTHS = {
    "gaussian": "kernel.width=0.7,1.3",
    "matern": "kernel.length_scale=0.7,1.3",
    "polynomial": "kernel.bias=0.5,2",
    "anchored": "seed=3,4",
}
STARTS = ("centers.radius=0.1,0.3", "trajectories=1,3")
BATCHES = {
    **{kernel: ([f"kernel={kernel}", "centers.count=6"], [width]) for kernel, width in WIDTHS.items()},
    "shrinking": (["kernel=gaussian", "centers.shrink.offset=0.1"], [WIDTHS["gaussian"]]),
    "fixed step": (["optimizer=fixed_step", "kernel=gaussian"], ["optimizer.step=0.5,1.2"]),
    "heavy ball": (["optimizer=heavy_ball"], ["optimizer.step=0.5,0.9", "optimizer.momentum=0.3,0.5"]),
    "exact": (["optimizer=exact", "kernel=gaussian"], ["seed=3,4"]),
    "secant": (["predictor=secant", "predictor.guarded=true", "certificate=true"], ["seed=3,4"]),
    "targets": (["target=cosine"], ["target.phase=0.0,1.0", "target.frequency=1,2"]),
    "steps of time": (["system=linear"], ["dt=0.05,0.049", "settle_time=0.3,0.4,9.0"]),
    "integrated": (["system=van_der_pol"], ["dt=0.05,0.049", "initial_state=[1.0,0.0],[0.5,0.5]"]),
    "plants": (["system=van_der_pol", "kernel=gaussian"], ["system.damping=0.5,1.0"]),
    "directions": (["centers=directions"], ["centers.directions=[[1,0],[0,1]],[[0.6,0.8],[-1,0]]"]),
    "single precision": (["dtype=float32", "target=quadratic"], ["target.matrix=1.0,2.0"]),
}


@pytest.mark.parametrize("name", BATCHES)
def test_a_member_gets_what_it_gets_alone(name: str) -> None:
    base, lines = BATCHES[name]
    cfgs = compose(base, [*STARTS, *lines])
    (group,) = groups(cfgs)
    assert group == list(range(len(cfgs)))
    together = GradientChase().solve(cfgs, SHOWN)  # raises where `batching.solve` would run each alone
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


RADII = ("0.05", "0.1", "0.3")


def chased_in_high_precision(states: np.ndarray, radius: float) -> list[list[mp.mpf]]:
    """The weights of steepest descent from zero, ten iterations a state, three centers, the paper's V."""
    found, a = [], mp.matrix([0, 0, 0])
    for x in states.tolist():
        at = [[x[k] + mp.mpf(radius) * mp.mpf(u[k]) for k in (0, 1)] for u in rings(3).tolist()]
        k = mp.matrix([[mp.exp(c[0] * d[0] + c[1] * d[1]) for d in at] for c in at])
        for _ in range(10):
            g = mp.matrix([*map(paper, at)]) - k * a
            a += (g.T * g)[0] / (g.T * k * g)[0] * g
        found.append([*a])
    return found


def test_a_job_in_a_compiled_batch_is_as_close_to_the_truth_as_alone() -> None:
    """What follows from a radius alone is found once by torch, or in the program of the rows: last digits."""
    cfgs = compose(["duration=0.9", "settle_time=0.5"], [f"centers.radius={','.join(RADII)}", "seed=1,2"])
    together = solutions(cfgs)
    with mp.workdps(50):
        for k, radius in zip(range(0, 6, 2), RADII, strict=True):
            (alone,) = solutions([cfgs[k]])
            for key in ("state", "value"):
                assert np.array_equal(together[k].history[key], alone.history[key])
            truth = chased_in_high_precision(alone.history["state"][0], float(radius))
            size = max(abs(w) for row in truth for w in row)
            errors = [
                max(
                    abs(w - t)
                    for found, row in zip(one.history["weights"][0].tolist(), truth, strict=True)
                    for w, t in zip(found, row, strict=True)
                )
                for one in (together[k], alone)
            ]
            assert errors[0] <= 4 * errors[1] + 1e-13 * size


MIXED = ["centers.count=3,6", "centers.radius=0.05,-1,0.2", "kernel=gaussian,polynomial"]


def test_a_sweep_of_numbers_and_counts_is_one_call_for_each_count(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "staf_torch")
    cfgs = compose([], MIXED)
    chosen = groups(cfgs)
    assert [len(group) for group in chosen] == [3, 3, 3, 3]
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


CLOSED = ("dt=0.005", "duration=0.1", "adp.compile=false", "figures=false")
SHORT_LOOP = ("adp.optimum.shooting=false", "initial_state=[0.5,0.0]")
LOOPS = {
    "information": ([], ["adp.critic=0.4,0.8", "adp.gains.actor=1.2,2.0", "centers.shrink.gain=1,1.5"]),
    "published": (
        ["adp/law=published", "trajectories=2", "adp.gain=250"],
        ["adp.gains.critic_extrapolated=0.25,0.1"],
    ),
    "supervised": (
        ["adp.trust=0.5", "duration=0.5", "dt=0.01"],
        ["adp.actor=[0.2,0.3,0.4],[0.5,0.5,0.5]", "seed=0,1"],
    ),
    "lqr": (["adp/policy=lqr"], ["initial_state=[-1.0,1.0],[0.5,0.5]"]),
    "plants": (
        ["adp/policy=lqr", "system=pendulum", *SHORT_LOOP],
        ["system.mass=0.5,2", "adp.cost.control=1,3"],
    ),
    "behind walls": (
        ["adp/policy=lqr", "system=pendulum", "adp.walls.high=[1.0,null]", "duration=0.015", *SHORT_LOOP],
        ["system.mass=0.5,2"],
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


def test_only_what_may_differ_within_a_batch_shares_a_group() -> None:
    cfgs = compose([], ["kernel=gaussian,matern", "centers.count=3,6", "centers.radius=0.1,0.2"])
    assert groups(cfgs) == [[0, 1], [2, 3], [4, 5], [6, 7]]
    cfgs = compose(["kernel=matern"], ["kernel.smoothness=0.5,1.5", "kernel.length_scale=1,2", "seed=1,2"])
    assert groups(cfgs) == [list(range(8))]  # every number of a kernel, also of a user's own
    cfgs = compose([], ["centers.shrink.offset=null,0.1,0.2", "optimizer.inner_steps=1,2"])
    assert groups(cfgs) == [[0], [1], [2, 4], [3, 5]]


def test_steps_of_time_share_a_group_where_their_number_is_the_same() -> None:
    cfgs = compose([], ["dt=0.05,0.025,0.1"])
    assert groups(cfgs) == [[0], [1], [2]]
    cfgs = compose([], ["dt=0.05,0.1", "duration=0.5,1.0"])
    assert groups(cfgs) == [[0, 3], [1], [2]]


def test_experiments_without_batches_stay_alone() -> None:
    cfgs = compose(["experiment=feasibility"], ["seed=1,2"])
    assert groups(cfgs) == [[0], [1]]
    assert solve(cfgs[:1]) == [DEFERRED]


def test_a_member_that_is_refused_fails_alone_with_its_own_sentence() -> None:
    cfgs = compose([], ["centers.radius=0.1,-1,0.2,oops"])
    found = solve([cfgs[0], cfgs[1], cfgs[2]])
    assert [type(one) for one in found] == [Computed, Failed, Computed]
    assert words(found[1]) == "`ConstantRadius(radius=...)` must be positive; got -1."
    assert groups(cfgs) == [[0, 1, 2], [3]]
    assert "must be a number; got 'oops'" in words(solve([cfgs[3]])[0])


def test_a_member_that_diverges_leaves_the_others_as_they_are() -> None:
    cfgs = compose(["system=van_der_pol", "dt=0.2", "duration=4"], ["initial_state=[1.0,0.0],[90.0,90.0]"])
    (kept, lost), (alone,) = solutions(cfgs), solutions(cfgs[:1])
    assert lost.metrics["diverged_fraction"] == 1
    assert lost.metrics["ultimate_error"] is None
    assert kept.metrics == alone.metrics
    assert np.array_equal(kept.history["weights"], alone.history["weights"])


def test_a_layout_that_cannot_have_the_count_fails_alone() -> None:
    cfgs = compose([], ["centers.count=3,7"])
    assert groups(cfgs) == [[0], [1]]
    assert "must be one of" in words(solve([cfgs[1]])[0])


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
        batching.completion(cfg, outcome)(cfg, tmp_path / name)
    files = [{p.name: p for p in (tmp_path / name).iterdir()} for name in ("batch", "alone")]
    assert files[0].keys() == files[1].keys() == {"metrics.json", "history.npz"}
    with np.load(files[0]["history.npz"]) as found, np.load(files[1]["history.npz"]) as expected:
        assert found.files == expected.files
        for key in ("time", "state", "value", "estimate", "weights"):
            assert np.array_equal(found[key], expected[key]), key
    numbers = [json.loads(each["metrics.json"].read_text()) for each in files]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-9, abs=1e-12)


def test_a_call_that_fails_and_is_made_again_in_parts_counts_its_progress_once() -> None:
    told: list[int] = []
    once = ToldOnce(told.append)

    def fails() -> None:
        with once.call() as tell:
            tell(3)
            tell(4)
            raise ValueError("midway")

    with pytest.raises(ValueError, match="midway"):
        fails()
    for _ in range(2):
        with once.call() as tell:
            tell(5)
    assert sum(told) == 10
