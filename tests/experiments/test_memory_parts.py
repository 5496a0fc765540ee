"""What the experiment `memory` compares, with chases and memories that are made up."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import basis_of, tensor, uniform
from torch import Tensor

from staf_torch import targets
from staf_torch.centers import probe_points
from staf_torch.experiments import memory
from staf_torch.experiments.memory import Region, Revisits, Settings

BASIS, TARGET = basis_of("exponential", 3, 0.25), targets.Paper()


def problem(**more: Any) -> Any:
    law: Any = "the law"
    given = {"basis": BASIS, "target": TARGET, "law": law, "inner_steps": 3, "predictor": None, "dt": 0.5}
    return SimpleNamespace(**given | more)


class Remembered:
    """A memory that knows V where the first coordinate is positive, and starts from coordinates."""

    count = tensor([3.0, 7.0])

    def query(self, y: Tensor) -> Tensor:
        return torch.where(y[..., 0] > 0, TARGET(y) + 0.5, math.nan)

    def start(self, x: Tensor) -> Tensor:
        return torch.cat((x, x[..., :1] * 2), dim=-1)


REMEMBERED: Any = Remembered()


def test_errors_are_of_the_points_of_the_ball_at_the_chosen_times() -> None:
    states, models = uniform(2, 6, 2, seed=1), uniform(2, 6, 3, seed=2)
    index = torch.tensor([1, 4])
    found = memory.errors(problem(), REMEMBERED, states, models, index)
    assert found.time.tolist() == [0.5, 2.0]
    zeta = probe_points(13, 2).double()
    assert [each.shape for each in found.errors.values()] == [(2, 2, len(zeta))] * 3
    for row in range(2):
        for k, at in enumerate(index.tolist()):
            y = states[row, at] + 0.25 * zeta
            truth = TARGET(y)
            local = BASIS.local(states[row, at]).evaluate(0.25 * zeta, models[row, at])
            torch.testing.assert_close(found.errors["passing"][row, k], (local - truth).abs())
            last = BASIS.local(states[row, -1]).evaluate(y - states[row, -1], models[row, -1])
            torch.testing.assert_close(found.errors["last"][row, k], (last - truth).abs())
            known = torch.where(y[:, 0] > 0, 0.5, math.nan).double()
            torch.testing.assert_close(found.errors["memory"][row, k], known, equal_nan=True)


@pytest.mark.parametrize(("steps", "starts", "length"), [(3, [4, 5, 7], 3), (50, [4, 4, 4], 8)])
def test_the_state_comes_back_to_earlier_ones_from_three_starts(
    steps: int, starts: list[int], length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def chase(states: Tensor, basis: object, target: object, law: object, **named: Any) -> Any:
        asked.append((states, basis, target, law, named))
        return SimpleNamespace(excess=states[..., 0] + len(asked))

    monkeypatch.setattr(memory, "chase", chase)
    states, excess = uniform(2, 12, 2, seed=1), uniform(2, 12, low=0, seed=2)
    weights = uniform(2, 12, 3, seed=3)
    found: Any = SimpleNamespace(state=states, weights=weights, excess=excess)
    given = Settings(capacity=5, reach=2.0, spacing=0.5, states=4, revisits=3, steps=steps)
    again = memory.revisits(problem(), given, REMEMBERED, found, 4)
    assert torch.equal(again.settled, excess[:, 4:].amax(1))
    pieces = torch.stack([states[:, k : k + length] for k in starts], dim=1)
    assert list(again.excess) == ["memory", "carried", "zero"]
    for number, (name, each) in enumerate(again.excess.items(), start=1):
        torch.testing.assert_close(each, pieces[..., 0] + number)
        path, basis, target, law, named = asked[number - 1]
        assert torch.equal(path, pieces.flatten(0, 1))
        assert (basis, target, law) == (BASIS, TARGET, "the law")
        begun = named.pop("weights")
        assert named == {"inner_steps": 3, "predictor": None}
        if name == "carried":
            assert torch.equal(begun, weights[:, -1].repeat_interleave(3, dim=0))
        elif name == "zero":
            assert torch.equal(begun, torch.zeros(6, 3).double())
        else:
            x = pieces[:, :, 0].flatten(0, 1)
            expected = BASIS.local(x).weights(REMEMBERED.start(x))
            torch.testing.assert_close(begun, expected)


def test_a_summary_is_the_worst_of_all_trajectories() -> None:
    nan = math.nan
    errors = {
        "memory": tensor([[[3.0, nan], [4.0, 0.0]], [[nan, nan], [1.0, 1.0]]]),
        "last": tensor([[[1.0, 2.0], [2.0, 0.0]], [[0.0, 0.0], [0.0, 6.0]]]),
    }
    excess = {
        "memory": tensor([[[0.5, 0.1], [9.0, 9.0]], [[0.2, 0.2], [0.3, 0.3]]]),
        "zero": tensor([[[4.0, 0.5], [5.0, 0.7]], [[7.0, 2.0], [2.0, 2.0]]]),
    }
    again = Revisits(excess, tensor([0.5, 2.0]))
    found = memory.summary(REMEMBERED, Region(tensor([0.0]), errors), again)
    assert found["models"] == 7.0
    assert found["covered_fraction"] == 5 / 8
    assert found["memory_rms_error"] == pytest.approx((25 / 3) ** 0.5)
    assert found["last_rms_error"] == pytest.approx(3.0)
    assert (found["memory_max_error"], found["last_max_error"]) == (4.0, 6.0)
    assert found["settled_excess"] == 2.0
    assert (found["revisit_excess_memory"], found["revisit_excess_zero"]) == (9.0, 7.0)
    assert found["revisit_steps_memory"] is None  # one of them never comes down to where it had settled
    excess["zero"][0, 1, 1] = 0.5
    excess["memory"][0, 1] = 0.5
    found = memory.summary(REMEMBERED, Region(tensor([0.0]), errors), again)
    assert (found["revisit_steps_memory"], found["revisit_steps_zero"]) == (1.0, 2.0)
    nothing = {"memory": torch.full((1, 1, 2), nan).double()}
    found = memory.summary(REMEMBERED, Region(tensor([0.0]), nothing), again)
    assert (found["memory_rms_error"], found["covered_fraction"], found["memory_max_error"]) == (
        None,
        0.0,
        0.0,
    )


def test_a_memory_is_fed_with_the_models_as_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    class Memory:
        def __init__(self, *given: Any, **named: Any) -> None:
            asked.append((given, named))

        def to(self, like: Tensor) -> Memory:
            asked.append(like.dtype)
            return self

        def add(self, x: Tensor, model: Tensor) -> None:
            asked.append((x, model))

    monkeypatch.setattr(memory, "ExperienceMemory", Memory)
    states, kept = uniform(2, 4, 2, seed=1), uniform(2, 4, 3, seed=2)
    given = Settings(capacity=5, reach=2.5, spacing=0.75, states=4, revisits=3, steps=2)
    memory.remember(problem(), given, states, kept)
    assert asked[0] == ((BASIS, 5, (2,)), {"reach": 2.5, "spacing": 0.75})
    assert asked[1] == torch.float64
    for k, (x, model) in enumerate(asked[2:]):
        assert torch.equal(x, states[:, k])
        assert torch.equal(model, kept[:, k])
    assert len(asked) == 6


def test_a_picture_is_of_the_first_trajectory_and_its_memory() -> None:
    path = uniform(7, 2, seed=1)
    stored = torch.tensor([[True, False, True], [True, True, True]])
    kept: Any = SimpleNamespace(states=uniform(2, 3, 2, seed=2), stored=stored, basis=BASIS)
    errors = {name: uniform(2, 5, 4, low=0, seed=k) for k, name in enumerate(memory.APPROXIMANTS)}
    excess = {name: uniform(2, 3, 6, low=0, seed=k) for k, name in enumerate(memory.STARTS)}
    region, again = Region(torch.arange(5).double(), errors), Revisits(excess, tensor([3.0, 4.0]))
    found = memory._picture(path, kept, region, again)
    np.testing.assert_array_equal(found.path, path.numpy())
    np.testing.assert_array_equal(found.stored, kept.states[0, [0, 2]].numpy())
    assert found.radius.tolist() == [0.25, 0.25]
    assert found.time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert found.settled == 3.0
    assert list(found.errors) == ["memory", "chase, in passing", "last local model"]
    np.testing.assert_array_equal(found.errors["last local model"], errors["last"][0].amax(1).numpy())
    assert list(found.excess) == ["memory", "carried weights", "zero"]
    np.testing.assert_array_equal(found.excess["zero"], excess["zero"][0].amax(0).numpy())


@pytest.mark.parametrize(("settle", "first"), [("0", 0), ("0.25", 5), ("0.951", 19)])
def test_a_run_remembers_the_settled_part_and_looks_at_it_evenly(
    settle: str, first: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}
    remember, errors, revisits = memory.remember, memory.errors, memory.revisits

    def remembered(problem: Any, given: Settings, states: Tensor, kept: Tensor, progress: Any) -> Any:
        seen["remember"] = states, kept
        return remember(problem, given, states, kept, progress)

    def erred(problem: Any, kept: Any, states: Tensor, models: Tensor, index: Tensor) -> Region:
        seen["errors"] = states, models, index
        return errors(problem, kept, states, models, index)

    def revisited(*given: Any) -> Revisits:
        seen["revisits"] = given
        return revisits(*given)

    for name, each in (("remember", remembered), ("errors", erred), ("revisits", revisited)):
        monkeypatch.setattr(memory, name, each)
    monkeypatch.setattr(memory, "draw_memory", lambda picture: seen.update(picture=picture))
    monkeypatch.setattr(memory, "images", lambda figure: {"txt": b"drawn"})
    words = ("dt=0.05", "duration=1.0", f"settle_time={settle}", "memory.states=7", "memory.revisits=2")
    cfg = settings("experiment=memory", *words, "memory.steps=2", "memory.capacity=6", "figures=true")
    found = memory.run(cfg, tmp_path)
    states, models, index = seen["errors"]
    assert states.shape == (1, 21, 2)
    assert torch.equal(seen["remember"][0], states[:, first:])
    assert torch.equal(seen["remember"][1], models[:, first:])
    assert index.tolist() == sorted({first + k * (20 - first) // 7 for k in range(7)})
    assert seen["revisits"][-1] == first
    np.testing.assert_array_equal(seen["picture"].path, states[0, first:].numpy())
    assert len((tmp_path / "memory.csv").read_text().splitlines()) == 2
    words = (tmp_path / "memory.md").read_text()  # type: ignore[assignment]
    for label in (*memory.APPROXIMANTS.values(), *memory.STARTS.values()):
        assert f"| {label} " in words
    assert (tmp_path / "figures" / "memory.txt").exists()
    assert found["revisit_steps_zero"] != 0
    other = tmp_path / "other"
    other.mkdir()
    cfg.figures = False
    memory.run(cfg, other)
    assert not (other / "figures").exists()
    for wrong in ("1.0", "1.2"):
        cfg.settle_time = float(wrong)
        with pytest.raises(
            ValueError, match=rf"`staf settle_time=...` must lie within the duration; got {wrong}"
        ):
            memory.run(cfg, other)


def test_two_tables_are_shown_by_label() -> None:
    names = [f"{key}_{what}" for key in memory.APPROXIMANTS for what in ("rms_error", "max_error")]
    names += [f"revisit_{what}_{key}" for key in memory.STARTS for what in ("excess", "steps")]
    numbers = {name: float(k + 1) for k, name in enumerate(names)}
    first, second = (table.markdown().splitlines() for table in memory._shown(numbers))
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (*first, *second)]
    assert cells[0] == ["error over the visited balls", "rms", "max"]
    assert [line[0] for line in cells[2:5]] == list(memory.APPROXIMANTS.values())
    assert [[float(each) for each in line[1:]] for line in cells[2:5]] == [[1, 2], [3, 4], [5, 6]]
    assert cells[5] == ["start at a revisit", "excess after a step", "steps"]
    assert [[float(each) for each in line[1:]] for line in cells[7:]] == [[7, 8], [9, 10], [11, 12]]


def test_a_memory_may_be_as_small_as_it_can() -> None:
    names = ("capacity", "states", "revisits", "steps")
    cfg = settings("experiment=memory", *(f"memory.{name}=1" for name in names), "memory.reach=0.5")
    cfg.memory.spacing = 0.125
    assert memory.settings_of(cfg) == Settings(1, 0.5, 0.125, 1, 1, 1)
