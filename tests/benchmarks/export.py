"""One evaluation of V^ and its gradient, M = 6, n = 2, exported: microseconds a call from Python, one core.

python tests/benchmarks/export.py FOLDER       # exports what FOLDER lacks, then times 10000 calls of each
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from staf_torch import ExponentialKernel, StaF, StaFBasis, StateFollowingCenters, deploy, rings, targets
from staf_torch.deploy.data_sheet import latency
from staf_torch.results.build import processor

STATE = torch.tensor([1.0, 0.3], dtype=torch.float64)
NAMES = ["value", "gradient"]


def fitted() -> StaF:
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
    return StaF(basis).fit_(STATE, targets.Paper())


def prepare(folder: Path, dtype: torch.dtype) -> tuple[Path, Path]:
    kind = str(dtype).removeprefix("torch.")
    onnx, package = folder / f"{kind}.onnx", folder / f"{kind}.aoti.pt2"
    if not (onnx.exists() and package.exists()):
        program = deploy.trace(deploy.approximator(fitted(), dtype), STATE[None].to(dtype))
        deploy.export_onnx(program, onnx, ["state"], NAMES)
        deploy.export_package(program, package)
    return onnx, package


def bound(session: onnxruntime.InferenceSession, y: Tensor) -> Callable[[Tensor], object]:
    """The same session with input and outputs in place."""
    binding, value = session.io_binding(), onnxruntime.OrtValue.ortvalue_from_numpy
    outputs = (np.zeros(1, y.numpy().dtype), np.zeros((1, 2), y.numpy().dtype))
    binding.bind_ortvalue_input("state", value(y.numpy()))
    for name, place in zip(NAMES, outputs, strict=True):
        binding.bind_ortvalue_output(name, value(place))
    return lambda _: session.run_with_iobinding(binding)


def runners(folder: Path, dtype: torch.dtype, y: Tensor) -> dict[str, Callable[[Tensor], object]]:
    onnx, package = prepare(folder, dtype)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(onnx), options, providers=["CPUExecutionProvider"])
    feed, model = (
        {"state": y.numpy()},
        importlib.import_module("torch._inductor").aoti_load_package(str(package)),
    )
    lean = deploy.approximator(fitted(), dtype)
    return {
        "onnxruntime, session.run": lambda _: session.run(None, feed),
        "onnxruntime, io binding": bound(session, y),
        "AOTInductor, package(x)": model,
        "AOTInductor, loader.run([x])": lambda x: model.loader.run([x]),
        "the same module in eager torch": lean,
    }


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{processor()}, torch {torch.__version__}, onnxruntime {onnxruntime.__version__}")
    for dtype in (torch.float32, torch.float64):
        y = (STATE + 0.03)[None].to(dtype)
        for name, run in runners(folder, dtype, y).items():
            late = latency(run, y)
            numbers = f"{late.median_us:8.2f} {late.p99_us:8.2f} {late.worst_us:9.1f}"
            print(f"{dtype!s:14} {name:32} {numbers}   us (median, 99 %, worst of {late.calls})")
    staf, y = fitted(), (STATE + 0.03)[None]
    late = latency(lambda x: (staf(x), staf.gradient(x)), y, 2000)
    print(f"StaF in eager torch, float64: {late.median_us:.1f} us")


if __name__ == "__main__":
    main()
