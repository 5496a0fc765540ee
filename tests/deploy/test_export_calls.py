"""What an export asks of torch and of onnxruntime, and how a call is timed: by stubs of what is slow."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch.deploy import c_header, formats, sheet


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
    needed: list[str] = []
    monkeypatch.setattr(formats, "need_onnx", lambda: needed.append("onnx"))
    run = formats.runner_onnx(Path("policy.onnx"))
    assert needed == ["onnx"]
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


def test_a_header_is_compiled_in_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    header = tmp_path / "of an odd name.h"
    header.write_text("/* a header */")
    asked: list[Any] = []

    def run(line: list[str], **given: Any) -> None:
        folder = Path(given["cwd"])
        asked.append(
            (line, {**given, "cwd": None}, {each.name: each.read_text() for each in folder.iterdir()})
        )

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(c_header, "need_c_compiler", lambda: "some-cc")
    monkeypatch.setattr(ctypes, "CDLL", lambda path: SimpleNamespace(call=Path(path).name))
    assert c_header._built(header, "void call() {}", "#include <time.h>\n") == "call.so"
    ((line, given, files),) = asked
    assert line == ["some-cc", *["-O2", "-shared", "-fPIC", "-x", "c", "call.c", "-o", "call.so", "-lm"]]
    assert given == {"cwd": None, "check": True, "capture_output": True}
    source = '#include <time.h>\n#include "exported.h"\nvoid call() {}\n'
    assert files == {"exported.h": "/* a header */", "call.c": source}


@pytest.mark.parametrize(("dtype", "kind"), [(torch.float64, "double"), (torch.float32, "float")])
def test_calls_in_c_get_rows_where_they_lie_and_their_times_are_counted(
    dtype: torch.dtype, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts: list[str] = []
    number = ctypes.c_double if kind == "double" else ctypes.c_float

    def timed(x: Any, taken: Any, rows: Any, n: Any) -> None:
        assert (rows.value, n.value) == (101, 2)
        assert (number * 2).from_address(x.value)[1] == 0.5
        (ctypes.c_double * 101).from_address(taken.value)[:] = [float(k) for k in range(1, 102)]

    def called(x: Any, first: Any, second: Any) -> None:
        a, b = (number * 2).from_address(x.value)
        number.from_address(first.value).value = a + b
        (number * 2).from_address(second.value)[:] = [a, 2 * b]

    def built(path: Path, function: str, head: str = "") -> Any:
        texts.append(function)
        return timed if head else called

    monkeypatch.setattr(c_header, "_built", built)
    found = c_header.time_c(Path("x.h"), torch.full((101, 2), 0.5, dtype=dtype), [1, 2])
    assert (found.calls, found.median_us, found.worst_us) == (101, 51.0, 101.0)
    assert found.p99_us == pytest.approx(100.0)
    run = c_header.runner_c(Path("x.h"), [None, 2], dtype)
    total, pair = run(torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=dtype))
    assert total.dtype == pair.dtype == dtype
    assert (total.tolist(), pair.tolist()) == ([3.0, 7.0], [[1.0, 4.0], [3.0, 8.0]])
    assert f"const {kind} *x, double *us" in texts[0]
    assert texts[1] == f"void call(const {kind} *state, {kind} *o0, {kind} *o1) {{ staf(state, o0, o1); }}"
