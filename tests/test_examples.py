"""The worked examples learn what they say; a notebook runs from top to bottom."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from examples import actor_critic, learned_dynamics, two_optimizers

from staf_torch import lanes

NOTEBOOK = Path(actor_critic.__file__).parent / "notebooks" / "gradients.py"


def test_a_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = NOTEBOOK.read_text()
    assert text.startswith("# %% [markdown]\n# # ")
    with lanes.compiling("auto"):  # gradients in plain torch: minutes
        exec(compile(text, str(NOTEBOOK), "exec"), {"__name__": "__main__"})


def test_the_actor_comes_close_to_the_optimal_policy() -> None:
    before = actor_critic.train(1)
    assert before > 0.8
    assert actor_critic.train() < 0.12 < 0.15 * before


def test_chasing_the_coefficients_beside_adam_beats_adam_alone() -> None:
    torch.manual_seed(1)
    together = two_optimizers.train()
    torch.manual_seed(1)
    alone = two_optimizers.train(chase=False)
    assert together < 2e-3
    assert together < 0.1 * alone


def discounted_cost(gains: torch.Tensor) -> torch.Tensor:
    """Cost of u = gains'x, a row of gains (K, 2) each, on the pendulum itself from four states."""
    x = torch.tensor([[0.8, 0.0], [0.0, 0.8], [0.5, -0.8], [-0.6, -0.4]], dtype=torch.float64)
    x, total, discount = x.unsqueeze(1).expand(-1, len(gains), -1), torch.zeros(4, len(gains)).double(), 1.0
    for _ in range(200):
        u = (x * gains).sum(-1)
        total += discount * (0.1 * x.square().sum(-1) + 0.01 * u.square())
        discount *= 0.95
        x = x + 0.1 * torch.stack((x[..., 1], x[..., 0].sin() + u), dim=-1)
    return total.mean(0)


def test_the_policy_learned_through_value_and_dynamics_is_near_the_best() -> None:
    model_error, bellman_error, gains = learned_dynamics.train()
    assert model_error < 6e-3
    assert bellman_error < 0.04
    grid = [[-p, -q] for p in (2.0, 3.0, 4.0) for q in (2.0, 3.0, 4.0, 5.0)]
    start, found, *others = discounted_cost(torch.tensor([[-1.5, -0.5], gains.tolist(), *grid]).double())
    assert start > 0.9
    assert found < 1.01 * min(others)
