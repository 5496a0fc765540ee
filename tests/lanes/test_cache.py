"""What the user's cache must not do: bring back code that was replaced, run what a file says, grow."""

from __future__ import annotations

import functools
import hashlib
import importlib
import io
import os
import pickle
import pickletools
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor, nn
from variants import KERNELS, over

from staf_torch import StaFBasis, StateFollowingCenters, chase, kernels, optim, rings, targets
from staf_torch.lanes import build, compiler, patches, trace_cache
from staf_torch.lanes.captured import Recipe
from staf_torch.lanes.kept import Kept
from staf_torch.lanes.program import Program

X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)


def of(kept: Kept, kernel: nn.Module) -> Program:
    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        x = 0.5 * x + 0.1 * kernel(x.unsqueeze(-2), torch.ones(1, 2).double()).squeeze(-2)
        return x, x.sum(-1)

    found = kept.of(step, kernel, owners=(kernel,))
    assert found is not None
    return found


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache for traces; what is compiled stays where it is."""
    monkeypatch.setattr("staf_torch.lanes.trace_cache._cache", lambda: tmp_path)
    return tmp_path


def twice(self: nn.Module, x1: Tensor, x2: Tensor) -> Tensor:
    return 2 * (x1 @ x2.mT)


@pytest.mark.parametrize("same_process", [True, False])
def test_a_method_that_was_replaced_meets_no_old_trace(
    same_process: bool, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel, kept = kernels.ExponentialKernel(), Kept("a test")
    for _ in range(3):  # from the second on a watch says whether something has changed
        before = of(kept, kernel)(X, steps=1)[1]
    assert len(list(cache.iterdir())) == 1
    assert kept.unchanged(kernel) is not None
    monkeypatch.setattr(kernels.ExponentialKernel, "forward", twice)
    assert not patches.unpatched()
    assert kept.unchanged(kernel) is None
    program = of(kept if same_process else Kept("a test"), kernel)
    found = program(X, steps=1)[1]
    torch.testing.assert_close(found, program.definition(X, steps=1)[1])
    assert not torch.allclose(found, before)
    assert len(list(cache.iterdir())) == 1  # nor is it written for others


class Called:
    def __call__(self, *given: Any) -> Any:
        return given


@pytest.mark.parametrize(
    "put",
    [
        lambda patch: patch.setattr("staf_torch.lanes.pivoted_cholesky.pivoted_cholesky", twice),
        lambda patch: patch.setattr(kernels.ExponentialKernel, "forward", staticmethod(twice)),
        lambda patch: patch.setattr(kernels.ExponentialKernel, "state_free", property(twice)),
        lambda patch: patch.setattr(kernels.ExponentialKernel, "forward", kernels.GaussianKernel.forward),
        lambda patch: patch.setattr(kernels.ExponentialKernel, "forward", functools.partial(twice, None)),
        lambda patch: patch.setattr("staf_torch.lanes.pivoted_cholesky.pivoted_cholesky", mock.MagicMock()),
        lambda patch: patch.setattr("staf_torch.lanes.pivoted_cholesky.pivoted_cholesky", Called()),
    ],
)
def test_foreign_functions_are_seen_and_the_librarys_own_are_not(
    put: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert patches.unpatched()
    put(monkeypatch)
    assert not patches.unpatched()
    monkeypatch.undo()
    assert patches.unpatched()


def test_no_module_of_the_package_looks_patched() -> None:
    for name in ("adp", "envs", "experiments", "metrics", "online", "theory"):
        importlib.import_module(f"staf_torch.{name}")
    patched = [] if patches.unpatched() else [name for name, (_, own) in patches._seen.items() if not own]
    assert not patched


class Harm:
    def __reduce__(self) -> Any:
        return os.system, ("exit 0",)


@pytest.mark.parametrize("content", [Harm(), Path("x"), os.getcwd])
def test_a_file_that_names_other_code_is_no_trace(content: object, cache: Path) -> None:
    path = cache / "trace-0"
    packed = zlib.compress(pickle.dumps((content,)))
    path.write_bytes(packed + hashlib.sha256(packed).digest())
    with pytest.raises(pickle.UnpicklingError, match="does not belong into a trace"):
        trace_cache._Reader(io.BytesIO(pickle.dumps((content,))), ()).load()
    assert trace_cache.load(path, ()) is None


def test_a_trace_names_no_module_for_what_torch_has_by_name() -> None:
    """pickle would name the first module that has imported torch: a user's, which no other process knows."""
    named, file = (torch.contiguous_format, torch.float32, torch.strided), io.BytesIO()
    trace_cache._Writer(file, {}, Recipe(torch.empty(0), [], [], [], [])).dump(named)
    codes = {code.name for code, _, _ in pickletools.genops(file.getvalue())}
    assert not codes & {"GLOBAL", "STACK_GLOBAL", "INST"}
    assert trace_cache._Reader(io.BytesIO(file.getvalue()), ()).load() == named


@pytest.mark.compiled
@over(KERNELS)
def test_what_was_traced_of_a_chase_is_there_for_the_next_process(
    name: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel, kept = KERNELS[name].make(), []
    write = trace_cache.save

    def save(path: Path, trace: trace_cache.Trace, tensors: Any) -> None:
        write(path, trace, tensors)
        kept.append(trace_cache.load(path, tensors))

    monkeypatch.setattr(trace_cache, "save", save)
    monkeypatch.setattr(compiler, "function", mock.Mock(side_effect=OSError("not asked")))
    basis = StaFBasis(kernel, StateFollowingCenters(rings(3), 0.3))
    x = 0.01 * torch.arange(32).double().view(1, 16, 2)
    chase(x, basis, targets.Quadratic(2.0), optim.SteepestDescent(), inner_steps=2, certificate=True)
    ours = type(kernel).__module__.startswith("staf_torch")
    assert [trace is not None for trace in kept] == [True] * ours  # a user's own is traced in every process


def test_the_cache_forgets_what_nobody_has_used_and_nothing_of_today(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day, now = build._DAY, 1e9
    ages = {"lanes-new.so": 0.5, "trace-old": 61, "lanes-old.so": 70, "lanes-mid.so": 20, "trace-mid": 10}
    ages |= {"tmpabc": 2, "tmpnow": 0.01, "notes.txt": 400}
    for name, days in ages.items():
        (tmp_path / name).write_bytes(b"0" * 100)
        os.utime(tmp_path / name, (now - days * day,) * 2)
    (tmp_path / "tmpdir").mkdir()
    os.utime(tmp_path / "tmpdir", (now - 3 * day,) * 2)

    def left() -> set[str]:
        build.prune(tmp_path, now=now)
        return {path.name for path in tmp_path.iterdir()}

    kept = {"lanes-new.so", "lanes-mid.so", "trace-mid", "tmpnow", "notes.txt"}
    assert left() == kept
    monkeypatch.setattr(build, "_MOST_BYTES", 300)
    assert left() == kept - {"lanes-mid.so"}
    monkeypatch.setattr(build, "_MOST_BYTES", 0)
    assert left() == {"lanes-new.so", "tmpnow", "notes.txt"}
    for name in ("lanes-a.so", "lanes-b.so"):  # another process takes the second one away at the same time
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (now - 99 * day,) * 2)
    unlink = Path.unlink

    def both(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok)
        unlink(tmp_path / "lanes-b.so", missing_ok=True)

    monkeypatch.setattr(Path, "unlink", both)
    (tmp_path / "tmpgone").mkdir()
    os.utime(tmp_path / "tmpgone", (now - 3 * day,) * 2)
    taken = shutil.rmtree

    def twice(path: Path, ignore_errors: bool = False) -> None:
        taken(path)  # by another process, and then by this one
        taken(path, ignore_errors=ignore_errors)

    monkeypatch.setattr(shutil, "rmtree", twice)
    assert left() == {"lanes-new.so", "tmpnow", "notes.txt"}
    build.used(tmp_path / "lanes-new.so")
    assert (tmp_path / "lanes-new.so").stat().st_mtime > now
