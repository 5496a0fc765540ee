"""What an export says of itself: what a call costs, the sheet, the refusals, tables of numbers in C."""

from __future__ import annotations

import importlib.util
import math
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from deploy.test_deploy import LQR, PLANT, actor, fitted, rollout
from helpers import tensor
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, deploy
from staf_torch.deploy import approximators, c_header, controllers, formats, remembered, sheet

X = tensor([[0.4, -0.3]])
SHEET: dict[str, Any] = {
    "file": "policy.h",
    "what": "u(x)",
    "run": "/runs/a`b\nc",
    "row": 3,
    "version": "1.2",
    "torch": "2.9",
    "batch": "any",
    "dtype": "float32",
    "inputs": [{"name": "state", "size": 2, "unit": "m", "region": "near"}],
    "outputs": [
        {"name": "value", "size": None, "unit": "J", "region": "V"},
        {"name": "u", "size": 1, "unit": "N", "region": "any"},
    ],
    "work": {"parameters": 7, "bytes_constants": 28, "bytes_in_out": 12, "flops": 40, "functions": 2},
    "latency": {"calls": 100, "median_us": 1.26, "p99_us": 2.04, "worst_us": 30.0},
    "runtime": "C",
    "machine": "a processor",
    "equality": {"value": 1.234e-7, "u": 0.0},
    "float32_error": {"value": 0.5, "u": 2e-7},
}


def test_a_sheet_says_all_that_is_known_of_a_file() -> None:
    assert sheet.markdown(SHEET).splitlines() == [
        "# policy.h",
        "",
        "u(x)",
        "",
        "From `/runs/a'b\\nc`, trajectory 3, by staf_torch 1.2 and torch 2.9. Batch B: any.",
        "",
        "| | name | shape | dtype | unit | region |",
        "|---|---|---|---|---|---|",
        "| input | `state` | (B, 2) | float32 | m | near |",
        "| output | `value` | (B,) | float32 | J | V |",
        "| output | `u` | (B, 1) | float32 | N | any |",
        "",
        "| a call with one row | |",
        "|---|---|",
        "| constants | 7 (28 bytes) |",
        "| flops | 40, and 2 calls of exp, sin, ... |",
        "| bytes | 40: constants, input and output once |",
        "| latency, median | 1.3 us |",
        "| latency, 99 % | 2.0 us |",
        "| latency, worst of 100 | 30.0 us |",
        "",
        "Latency: from Python, C, one core of a processor.",
        "",
        "| output | file against library, same dtype | float32 against float64 |",
        "|---|---|---|",
        "| `value` | 1.2e-07 | 0.5 |",
        "| `u` | 0 | 2e-07 |",
        "",
        "Errors are the largest difference over the largest value, at 1000 random points of the region.",
    ]
    assert sheet.markdown(SHEET).endswith("region.\n")


def test_a_difference_is_a_share_of_the_largest_value() -> None:
    got, wanted = (tensor([1.0, -4.5]), tensor([2.0])), (tensor([1.25, -4.0]), tensor([2.0]))
    assert sheet.worst_difference(got, wanted) == [0.125, 0.0]
    tiny = sheet.worst_difference((torch.tensor([1.0 + 2**-20]),), (torch.tensor([1.0]),))
    assert tiny == [2**-20]


def test_calls_are_timed_on_one_core_after_others_that_warm_it() -> None:
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("no choice of a core here")
    before, cores, gradients = os.sched_getaffinity(0), [], []

    def run(x: Tensor) -> None:
        cores.append(frozenset(os.sched_getaffinity(0)))
        gradients.append(torch.is_grad_enabled())

    assert sheet.latency(run, X, calls=7).calls == 7
    assert len(cores) == 500 + 7
    assert set(cores) == {frozenset({max(before)})}
    assert not any(gradients)
    assert os.sched_getaffinity(0) == before


def test_the_processor_is_named() -> None:
    named = sheet.machine()
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    assert named == models[0] if models else named


def test_operations_are_counted_by_the_entries_that_they_make() -> None:
    class Module(nn.Module):
        def forward(self, x: Tensor) -> tuple[Tensor, ...]:
            moved = torch.cat((x.unsqueeze(1), x.reshape(1, 1, 2)), 1).transpose(1, 2)
            return 3.0 * x, x.sum(-1), x.mean(-1), x.amax(-1), x.exp() + x.sin(), moved

    counted = sheet.work(deploy.trace(Module(), X, batch=1))
    assert counted.flops == 2 + 1 + 1 + 1 + 2  # products, three reductions, sums; what only moves is free
    assert counted.functions == 4
    assert counted.bytes_in_out == 8 * (2 + 2 + 1 + 1 + 1 + 2 + 4)


def test_a_header_counts_its_constants_in_the_bytes_of_its_dtype() -> None:
    source = c_header.Source(10, 20, 3)
    assert source.work(4, torch.float64) == sheet.Work(10, 20, 3, 80, 32)
    assert source.work(4, torch.float32) == sheet.Work(10, 20, 3, 40, 16)
    assert (c_header._c_type(torch.float32), c_header._c_type(torch.float64)) == ("float", "double")


@pytest.mark.parametrize("note", ["", "one\ntwo"])
def test_a_header_begins_with_its_note_and_what_a_call_takes(note: str, tmp_path: Path) -> None:
    source = deploy.export_c(deploy.policy_of(LQR), torch.cat((X, X)), tmp_path / "p.h", ["u"], note=note)
    assert (source.flops, source.functions) == (4, 0)
    lines = (tmp_path / "p.h").read_text().splitlines()
    at = lines.index(" * A call takes 4 additions and the like,")
    assert lines[at + 1] == " * 0 calls of exp and the like, whatever the state is."
    assert [line.removeprefix(" * ") for line in lines[1:at]] == note.split()


# Refusals


@pytest.mark.parametrize("name", ["no-such-compiler", None])
def test_without_a_c_compiler_it_is_said(name: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    if name is not None:
        monkeypatch.setenv("CC", name)
    else:
        monkeypatch.setattr(shutil, "which", lambda each: None)
    with pytest.raises(ValueError, match=rf"there is no C compiler here: .*; got {name!r}\.$"):
        c_header.need_c_compiler()


@pytest.mark.parametrize("there", ["cc", "gcc", "g++", "clang"])
def test_the_compiler_that_is_there_is_taken_or_the_named(
    there: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda each: f"/bin/{each}" if each in (there, "own") else None)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    assert c_header.need_c_compiler() == there
    if there == "g++":
        formats.need_compiler()
    monkeypatch.setenv("CC", "own")
    assert c_header.need_c_compiler() == "own"
    monkeypatch.setenv("CXX", "own")
    formats.need_compiler()
    monkeypatch.setattr(shutil, "which", lambda each: None)
    with pytest.raises(ValueError, match=r"there is no compiler here: .* got 'own'\. ONNX and pt2 need none"):
        formats.need_compiler()


@pytest.mark.parametrize(
    ("missing", "said"),
    [(("onnx",), "onnx, which is not"), (("onnx", "onnxruntime"), "onnx, onnxruntime, which are not")],
)
def test_what_onnx_lacks_is_named(
    missing: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in missing else object())
    with pytest.raises(ValueError, match=rf"^ONNX needs {said} installed: pip install 'staf_torch\[onnx\]'"):
        formats.need_onnx()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    formats.need_onnx()


def test_weights_are_of_an_actor_alone() -> None:
    weights = tensor([0.5, 0.1, 1.0])
    with pytest.raises(ValueError, match=r"weights=...\)` must be None for LQR; got \[0.5, 0.1, 1.0\]"):
        deploy.policy_of(LQR, weights)
    learner = actor(st.ExponentialKernel())
    for chosen in (None, weights):
        policy = deploy.policy_of(learner, chosen)
        assert torch.equal(policy.weights, learner.actor if chosen is None else weights)
        guarded = deploy.policy_of(adp.Supervised(learner, LQR, learner.cost), chosen)
        assert torch.equal(guarded.policy.weights, policy.weights)
        wall = adp.SafetyFilter(learner, PLANT, lambda x, t: 9.0 - x[:, 0], dt=0.1)
        fenced = deploy.policy_of(wall, chosen)
        assert torch.equal(fenced.policy.weights, policy.weights)
    for wrong in (weights.expand(1, 3), torch.tensor([math.inf, 0.0, 0.0]).double()):
        with pytest.raises(ValueError, match=r"`ActorPolicy\(weights=...\)` must be 3 finite numbers"):
            deploy.ActorPolicy(learner, wrong)
    with pytest.raises(ValueError, match=r"`ActorPolicy\(weights=...\)` must have 3 entries"):
        deploy.ActorPolicy(learner, weights[:2])


def test_a_policy_is_a_copy_that_learns_nothing_in_the_dtype_that_is_asked_for() -> None:
    policy = deploy.policy_of(adp.Feedback(LQR))
    assert policy is not LQR
    assert not policy.training
    assert {part.dtype for part in policy.buffers()} == {torch.float64}
    assert {part.dtype for part in deploy.policy_of(LQR, dtype=torch.float32).buffers()} == {torch.float32}
    layer = nn.Linear(2, 1).double()
    assert not any(part.requires_grad for part in deploy.policy_of(layer).parameters())
    assert all(part.requires_grad for part in layer.parameters())


@pytest.mark.parametrize(
    ("kernel", "radius", "folds"),
    [
        (st.ExponentialKernel(), 0.3, True),
        (st.GaussianKernel(0.8), 0.3, True),
        (st.MaternKernel(2.5), 0.3, True),
        (st.PolynomialKernel(3), 0.3, False),
        (st.GaussianKernel(0.8), st.StateRadius(0.3, 0.1), False),
    ],
)
def test_a_rollout_is_folded_where_one_matrix_serves_all_states(
    kernel: st.Kernel, radius: Any, folds: bool
) -> None:
    policy = rollout(kernel, radius)
    assert controllers.foldable(policy) is folds
    assert isinstance(deploy.policy_of(policy), deploy.FoldedRollout) is folds


# Approximations


def test_a_series_holds_up_to_its_reach_and_not_beyond() -> None:
    staf = fitted(st.GaussianKernel(0.8), 0.1)
    found = deploy.RidgeApproximator(staf, reach=2.0)
    assert (found.radius, found.reach) == (pytest.approx(0.1), 2.0)
    assert deploy.RidgeApproximator(staf).reach == 10.0
    far = torch.zeros_like(found.state)
    far[0] = 0.2
    for share, inside in ((0.999999, True), (1.000001, False)):
        value, gradient = found((found.state + share * far)[None])
        assert bool(value.isfinite().all()) is inside
        assert bool(gradient.isfinite().all()) is inside
    assert found.degree < deploy.RidgeApproximator(staf, reach=20.0).degree
    assert deploy.RidgeApproximator(staf, torch.float32, reach=2.0).degree < found.degree
    with pytest.raises(ValueError, match=r"`RidgeApproximator\(reach=...\)` must be positive; got 0"):
        deploy.RidgeApproximator(staf, reach=0.0)


def test_the_derivative_of_a_series_has_its_powers() -> None:
    c = tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert approximators._derivative(c).tolist() == [[3.0, 4.0], [10.0, 12.0], [0.0, 0.0]]


def test_the_leanest_approximation_is_a_series_where_there_is_one() -> None:
    kinds = {deploy.RidgeApproximator: st.GaussianKernel(0.8), deploy.LocalApproximator: st.MaternKernel(2.5)}
    for kind, kernel in kinds.items():
        staf = fitted(kernel, 0.1)
        for dtype in (torch.float64, torch.float32):
            found = deploy.approximator(staf, dtype)
            assert type(found) is kind
            value, gradient = found(staf.state[None].to(dtype))
            assert (value.dtype, gradient.dtype) == (dtype, dtype)
            assert found.radius == pytest.approx(0.1)
    assert deploy.approximator(fitted(st.GaussianKernel(0.8), 0.1), reach=3.0).reach == 3.0


# Tables in C


def test_a_table_has_eight_numbers_a_line_and_the_digits_of_its_dtype() -> None:
    text = remembered._table("double", "a", torch.arange(17.0).double() / 3, False)
    lines = text.splitlines()
    assert lines[0] == "static const double a[17] = {"
    assert [line.count(".") for line in lines[1:4]] == [8, 8, 1]
    assert lines[1].startswith("0.0, 0.3333333333333333, 0.6666666666666666, ")
    assert lines[1].endswith(",")
    assert lines[-1] == "};"
    assert remembered._table("float", "a", torch.tensor([1 / 3]), True).splitlines()[1] == "0.333333343"
    assert (
        remembered._table("int", "a", torch.tensor([1, 2]), False) == "static const int a[2] = {\n1, 2\n};\n"
    )
