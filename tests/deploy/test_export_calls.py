"""What an export asks of torch and of onnxruntime, and how a call is timed: by stubs of what is slow."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch.deploy import formats, sheet


def test_an_onnx_model_is_optimised_named_and_made_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(formats, "need_onnx", lambda: asked.append("onnx"))

    def export(program: Any, **given: Any) -> Any:
        asked.append((program, given))
        return SimpleNamespace(save=asked.append)

    monkeypatch.setattr(torch.onnx, "export", export)
    program: Any = object()
    formats.export_onnx(program, Path("policy.onnx"), ["state"], ["control", "value"])
    given = {
        "dynamo": True,
        "input_names": ["state"],
        "output_names": ["control", "value"],
        "verbose": False,
        "optimize": True,
    }
    assert asked == ["onnx", (program, given), "policy.onnx"]


def test_a_package_is_compiled_for_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(formats, "need_compiler", lambda: asked.append("compiler"))
    stub = SimpleNamespace(aoti_compile_and_package=lambda program, **given: asked.append((program, given)))
    monkeypatch.setitem(vars(torch), "_inductor", stub)  # which torch imports where it is asked for
    program: Any = object()
    formats.export_package(program, Path("policy.pt2"))
    given = {"package_path": "policy.pt2", "inductor_configs": {"cpp.threads": 1}}
    assert asked == ["compiler", (program, given)]


def test_an_onnx_model_runs_on_one_thread_of_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    class Session:
        def __init__(self, *given: Any, **more: Any) -> None:
            made.append((given, more))

        def get_inputs(self) -> list[Any]:
            return [SimpleNamespace(name="state")]

        def run(self, outputs: Any, fed: dict[str, Any]) -> list[Any]:
            assert outputs is None
            return [2 * fed["state"], fed["state"].sum(-1)]

    stub = SimpleNamespace(SessionOptions=SimpleNamespace, InferenceSession=Session)
    monkeypatch.setitem(sys.modules, "onnxruntime", stub)
    monkeypatch.setattr(formats, "need_onnx", lambda: None)
    run = formats.runner_onnx(Path("policy.onnx"))
    x = torch.tensor([[1.0, 2.0]]).double()
    double, total = run(x)
    assert (double.tolist(), total.tolist()) == ([[2.0, 4.0]], [3.0])
    ((path, options), more) = made[0]
    assert (path, more) == ("policy.onnx", {"providers": ["CPUExecutionProvider"]})
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)


def test_one_output_is_a_tuple_of_one() -> None:
    x = torch.ones(2)
    assert formats.as_tuple(x) == (x,)
    assert formats.as_tuple((x, x)) == (x, x)
    assert isinstance(formats.as_tuple([x, x]), tuple)  # type: ignore[arg-type]


def test_a_call_is_timed_one_by_one_after_500_that_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, calls = [0], 0

    def run(x: Tensor) -> None:
        nonlocal calls
        calls += 1
        assert not torch.is_grad_enabled()
        # 1, 2, ... 100 microseconds of those that count; those before take a second each.
        clock[0] += 1000 * (calls - 500) if calls > 500 else 10**9

    monkeypatch.setattr(time, "perf_counter_ns", lambda: clock[0])
    found = sheet.latency(run, torch.zeros(1, 2), calls=101)
    assert calls == 601
    assert (found.calls, found.median_us, found.worst_us) == (101, 51.0, 101.0)
    assert found.p99_us == pytest.approx(100.0)


def test_calls_are_timed_on_the_last_core_and_the_others_are_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda who: {1, 3, 2} if who == 0 else set(), raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda who, cores: asked.append((who, cores)), raising=False)

    def run(x: Tensor) -> None:
        assert asked == [(0, {3})]

    sheet.latency(run, torch.zeros(1, 2), calls=1)
    assert asked == [(0, {3}), (0, {1, 2, 3})]
    monkeypatch.delattr(os, "sched_setaffinity")
    assert sheet.latency(lambda x: None, torch.zeros(1, 2), calls=2).calls == 2
