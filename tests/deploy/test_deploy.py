"""Fixed approximations and controllers, and what is written of them."""

from __future__ import annotations

import importlib.util
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import tensor
from torch import Tensor, nn
from variants import SMOOTH_KERNELS

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    GaussianKernel,
    Kernel,
    MaternKernel,
    RationalQuadraticKernel,
    StaF,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    ball,
    deploy,
    rings,
    systems,
    targets,
)
from staf_torch.deploy import data_sheet, formats
from staf_torch.deploy.approximators import LocalApproximator, RidgeApproximator
from staf_torch.deploy.c_header import runner_c
from staf_torch.deploy.controllers import ActorPolicy

PLANT = systems.TwoState()
COST = adp.QuadraticCost(1.0, 1.0, 2, 1)
LQR = adp.LQR(PLANT, COST)
X = tensor([[0.4, -0.3]])
BOX = adp.RandomPoints(1, StateRadius(2.1, 1e-5))
needs_onnx = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="needs the extra onnx",
)

needs_cc = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("cc", "gcc", "g++", "clang")), reason="needs a C compiler"
)


def fitted(kernel: Kernel, radius: float, directions: Tensor | None = None) -> StaF:
    directions = rings(6) if directions is None else directions
    x = torch.tensor([1.0, 0.3, -0.4], dtype=torch.float64)[: directions.shape[1]]
    target = targets.Paper() if len(x) == 2 else targets.Cosine(0.7)
    return StaF(StaFBasis(kernel, StateFollowingCenters(directions, radius))).fit_(x, target)


def around(staf: StaF, reach: float, count: int = 50) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    apart = torch.randn(count, staf.basis.dim, dtype=torch.float64, generator=generator)
    share = torch.rand(count, 1, dtype=torch.float64, generator=generator)
    radius = staf.basis.centers.radius(staf.state)
    return staf.state + reach * radius * share * apart / apart.norm(dim=-1, keepdim=True)


def relative(found: Tensor, wanted: Tensor) -> float:
    return float(((found.double() - wanted).abs().max() / wanted.abs().max()).detach())


def actor(kernel: Kernel, gradient: str = "total") -> adp.ActorCritic:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(kernel), centers), gradient)
    return adp.ActorCritic(basis, PLANT, COST, BOX, actor=[0.2, 0.8, -0.2])


def rollout(
    kernel: Kernel, radius: float | StateRadius = 0.1, count: int = 6, **settings: float
) -> adp.RolloutPolicy:
    basis = StaFBasis(kernel, StateFollowingCenters(rings(count), radius))
    return adp.RolloutPolicy(basis, PLANT, COST, LQR, LQR.value, **{"steps": 2, "horizon": 0.1, **settings})


CONTROLLERS = {
    "lqr": adp.Feedback(LQR),
    "bounded_lqr": adp.Feedback(adp.LQR(PLANT, adp.BoundedInputCost(1.0, 1.0, 2, 1, bound=2.0))),
    "rollout": adp.Feedback(rollout(ExponentialKernel())),
    "rollout_gaussian": adp.Feedback(rollout(GaussianKernel(0.9))),
    "rollout_matern": adp.Feedback(rollout(MaternKernel())),
    "rollout_twice": adp.Feedback(rollout(ExponentialKernel(), steps=1, depth=2)),
    "rollout_of_moving_radius": adp.Feedback(rollout(ExponentialKernel(), StateRadius(0.3, 0.1))),
    "actor": actor(ExponentialKernel()),
    "actor_partial": actor(ExponentialKernel(), "partial"),
    "actor_gaussian": actor(GaussianKernel()),
    "supervised": adp.Supervised(actor(ExponentialKernel()), LQR, COST),
    "quadratic": adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, BOX),
    "rbf_grid": adp.ActorCritic(adp.RBFGridBasis(2, 3), PLANT, COST, BOX),
}


@pytest.mark.parametrize("name", list(SMOOTH_KERNELS))
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_deployed_approximation_equals_the_module(name: str, dtype: torch.dtype) -> None:
    staf = fitted(SMOOTH_KERNELS[name].make(), 0.1)
    y = around(staf, 2.0).to(dtype)
    value, gradient = deploy.approximator(staf, dtype)(y)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-6
    assert value.dtype == gradient.dtype == dtype
    assert relative(value, staf(y.double())) <= tolerance
    assert relative(gradient, staf.gradient(y.double())) <= tolerance


@pytest.mark.parametrize("radius", [1e-6, 1e-3, 0.1, 0.5])
@pytest.mark.parametrize(
    "kernel", [ExponentialKernel(), GaussianKernel(0.8)], ids=["exponential", "gaussian"]
)
@pytest.mark.parametrize("directions", [rings(15), ball(10, 3)], ids=["15", "in 3d"])
def test_folded_series_keeps_its_digits_at_every_radius(
    radius: float, kernel: Kernel, directions: Tensor
) -> None:
    staf = fitted(kernel, radius, directions)
    y = around(staf, 9.9)
    assert relative(RidgeApproximator(staf)(y)[0], staf(y)) <= 1e-12
    if radius >= 1e-3:  # else x + z has no digits of z in float32
        near = around(staf, 1.0).float()
        assert relative(RidgeApproximator(staf, torch.float32)(near)[0], staf(near.double())) <= 1e-6


@pytest.mark.parametrize("name", list(CONTROLLERS))
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_deployed_controller_equals_the_one_of_the_loop(name: str, dtype: torch.dtype) -> None:
    controller = CONTROLLERS[name]
    x = 4 * torch.rand(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 2
    x = x.to(dtype).double()
    wanted, _ = controller.step(x, controller.init(x), x.new_zeros(20, controller.draws, 2), 0.01)
    found = deploy.policy_of(controller, dtype=dtype)(x.to(dtype))
    assert found.dtype == dtype
    # A rollout differentiates differences of size r of its values: float32 loses a factor 1 / r there.
    loss = 100 if "rollout" in name else 1
    assert relative(found, wanted) <= (1e-12 if dtype == torch.float64 else loss * 1e-6)


class WithThirds(nn.Module):
    """An approximation, and numbers that float32 does not hold."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return *self.module(x), 0.1 * x + (x - 1 / 3).square() / 0.7


def test_c_header_in_float_is_refused_where_it_would_lose_its_digits(tmp_path: Path) -> None:
    module = deploy.approximator(fitted(RationalQuadraticKernel(), 0.1), torch.float32)
    with pytest.raises(ValueError, match="needs float64 inside"):
        deploy.export_c(module, torch.ones(1, 2), tmp_path / "a.h", ["value", "gradient"])
    assert not list(tmp_path.iterdir())


@needs_cc
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("exponential", torch.float64),
        ("exponential", torch.float32),
        ("actor", torch.float32),
        ("rollout", torch.float64),
    ],
)
def test_c_header_computes_the_same(name: str, dtype: torch.dtype, tmp_path: Path) -> None:
    staf = fitted(ExponentialKernel(), 0.1)
    given = {"actor": CONTROLLERS["actor"], "rollout": rollout(ExponentialKernel(), steps=1)}
    module = deploy.policy_of(given[name], dtype=dtype) if name in given else deploy.approximator(staf, dtype)
    x = around(staf, 1.0, 5).to(dtype)
    wanted = formats.as_tuple(module(x))
    outputs = [f"out{k}" for k in range(len(wanted))]
    deploy.export_c(module, x, tmp_path / "a.h", outputs)
    run = runner_c(tmp_path / "a.h", [None if out.dim() == 1 else out.shape[1] for out in wanted], dtype)
    loss = 100 if name == "rollout" else 1  # its differences, in float
    tolerance = 1e-12 if dtype == torch.float64 else loss * 1e-6
    assert max(data_sheet.worst_difference(run(x), wanted)) <= tolerance


@needs_onnx
def test_onnx_file_computes_the_same_in_onnxruntime(tmp_path: Path) -> None:
    """With the digits of numbers in the code, too."""
    staf = fitted(ExponentialKernel(), 0.1)
    module, y = WithThirds(deploy.approximator(staf)), around(staf, 1.0)
    names = ["value", "gradient", "thirds"]
    deploy.export_onnx(deploy.trace(module, y), tmp_path / "a.onnx", ["state"], names)
    run = formats.runner_onnx(tmp_path / "a.onnx")
    for rows in (1, 7):
        value, gradient, third = run(y[:rows])
        wanted = (staf(y[:rows]), staf.gradient(y[:rows]))
        assert max(data_sheet.worst_difference((value, gradient), wanted)) <= 1e-12
        assert data_sheet.worst_difference((third,), (module(y[:rows])[2],))[0] <= 1e-15


def test_operations_are_counted_by_the_entries_that_they_make() -> None:
    class Module(nn.Module):
        def forward(self, x: Tensor) -> tuple[Tensor, ...]:
            moved = torch.cat((x.unsqueeze(1), x.reshape(1, 1, 2)), 1).transpose(1, 2)
            return table.exp().sum() * x, x.sum(-1), x.mean(-1), x.amax(-1), x.exp() + x.sin(), moved

    table = torch.ones(5, 5, dtype=torch.float64)
    counted = data_sheet.work(deploy.trace(Module(), X, batch=1))
    assert counted.flops == 2 + 1 + 1 + 1 + 2  # products, three reductions, sums; no constants, no moves
    assert counted.functions == 4
    assert counted.bytes_in_out == 8 * (2 + 2 + 1 + 1 + 1 + 2 + 4)


def test_weights_are_of_an_actor_alone() -> None:
    weights = tensor([0.5, 0.1, 1.0])
    with pytest.raises(ValueError, match=r"weights=...\)` must be None for LQR; got \[0.5, 0.1, 1.0\]"):
        deploy.policy_of(LQR, weights)
    learner = actor(ExponentialKernel())
    wall = adp.SafetyFilter(learner, PLANT, lambda x, t: 9.0 - x[:, 0], dt=0.1)
    for chosen in (None, weights):
        policy = deploy.policy_of(learner, chosen)
        assert torch.equal(policy.weights, learner.actor if chosen is None else weights)
        for around_it in (adp.Supervised(learner, LQR, learner.cost), wall):
            assert torch.equal(deploy.policy_of(around_it, chosen).policy.weights, policy.weights)
    for wrong in (weights[:2], torch.tensor([math.inf, 0.0, 0.0]).double()):
        with pytest.raises(ValueError, match=r"`ActorPolicy\(weights=...\)` must"):
            ActorPolicy(learner, wrong)


def test_a_policy_is_a_copy_that_learns_nothing_in_the_dtype_that_is_asked_for() -> None:
    policy = deploy.policy_of(adp.Feedback(LQR))
    assert policy is not LQR
    assert not policy.training
    assert {part.dtype for part in policy.buffers()} == {torch.float64}
    assert {part.dtype for part in deploy.policy_of(LQR, dtype=torch.float32).buffers()} == {torch.float32}
    layer = nn.Linear(2, 1).double()
    assert not any(part.requires_grad for part in deploy.policy_of(layer).parameters())
    assert all(part.requires_grad for part in layer.parameters())


def test_a_series_is_taken_where_there_is_one_and_holds_up_to_its_reach() -> None:
    staf = fitted(GaussianKernel(0.8), 0.1)
    found = deploy.approximator(staf, reach=2.0)
    assert isinstance(found, RidgeApproximator)
    assert (found.radius, found.reach) == (pytest.approx(0.1), 2.0)
    far = torch.zeros_like(found.state)
    far[0] = 0.2
    for share, inside in ((0.999999, True), (1.000001, False)):
        parts = found((found.state + share * far)[None])
        assert all(bool(part.isfinite().all()) is inside for part in parts)
    assert RidgeApproximator(staf, torch.float32, reach=2.0).degree < found.degree
    assert found.degree < RidgeApproximator(staf, reach=20.0).degree
    assert type(deploy.approximator(fitted(MaternKernel(2.5), 0.1))) is LocalApproximator


def test_program_file_comes_back_with_its_note_and_another_format_is_refused(tmp_path: Path) -> None:
    x = torch.ones(3, 2, dtype=torch.float64)
    path = tmp_path / "lqr.pt2"
    program = deploy.trace(deploy.policy_of(LQR), X)
    deploy.export_program(program, path, {"what": "lqr"})
    loaded, note = deploy.load_program(path)
    assert note == {"format": 1, "what": "lqr"}
    torch.testing.assert_close(loaded.module()(x), LQR(x))
    torch.export.save(program, path, extra_files={"staf_torch.json": '{"format": 2}'})
    with pytest.raises(ValueError, match=r"has format 2 .* reads format 1: export the run anew"):
        deploy.load_program(path)
    torch.export.save(program, path)
    with pytest.raises(ValueError, match="must have been written by staf-export"):
        deploy.load_program(path)
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"must be a \.pt2 file of staf-export"):
        deploy.load_program(path)


def test_what_cannot_be_deployed_is_refused() -> None:
    two = StaF(fitted(ExponentialKernel(), 0.1).basis, (2,))
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: deploy.policy_of(lambda x: x), r"`policy_of\(controller=...\)` must be"),  # type: ignore[arg-type]
        (lambda: deploy.trace(nn.Identity(), X[0]), r"`trace\(example=...\)`"),
        (lambda: deploy.trace(nn.Identity(), X, batch=0), r"`trace\(batch=...\)`"),
        (lambda: deploy.trace(nn.Bilinear(2, 2, 1), X), r"^`Bilinear` cannot be exported for any batch"),
        (lambda: deploy.approximator(two), "must have one state; got the batch"),
        (lambda: RidgeApproximator(fitted(ExponentialKernel(), 0.9), reach=1e3), "must be smaller"),
    ]
    for call, said in cases:
        with pytest.raises(ValueError, match=said):
            call()


def test_without_a_compiler_it_is_said_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    module, x = deploy.policy_of(LQR), torch.zeros(1, 2, dtype=torch.float64)
    deploy.export_c(module, x, tmp_path / "a.h", ["u"])
    program = deploy.trace(module, x)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    for named in (None, "no-such-compiler"):
        if named is not None:
            monkeypatch.setenv("CC", named)
            monkeypatch.setenv("CXX", named)
        with pytest.raises(ValueError, match=rf"there is no C compiler here: .*; got {named!r}\.$"):
            deploy.time_c(tmp_path / "a.h", x, [1])
        with pytest.raises(ValueError, match=rf"there is no compiler here: .* got {named!r}\. ONNX and pt2"):
            deploy.export_package(program, tmp_path / "a.pt2")


def test_calls_are_timed_on_one_core_after_others_that_warm_it() -> None:
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("no choice of a core here")
    before, cores = os.sched_getaffinity(0), []
    found = data_sheet.latency(lambda x: cores.append(frozenset(os.sched_getaffinity(0))), X, calls=7)
    assert found.calls == 7 < len(cores)
    assert 0 <= found.median_us <= found.p99_us <= found.worst_us
    assert set(cores) == {frozenset({max(before)})}
    assert os.sched_getaffinity(0) == before
