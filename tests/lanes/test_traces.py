"""Traces in a file: what is written of one, what is read back, and which content is refused."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from staf_torch.lanes import trace_cache
from staf_torch.lanes.emission import Text
from staf_torch.lanes.given import Given
from staf_torch.lanes.one_row import trace
from staf_torch.lanes.trace_cache import Trace, load, place, save

A, B = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64)


def traced(step: Callable[[Tensor], Any]) -> Trace:
    """What is kept of a step, with an empty program in the place of its text."""
    x = torch.linspace(0, 1, 6, dtype=torch.float64).view(2, 3)
    found = trace(lambda carry, now, row: (carry, step(row)), Given.of(x[:, 0], (), x, 1))
    text = Text("void f();\n", [0.5, 0.0], [(1, 0)])
    return Trace(text, found.recipe, torch.float64, found.outputs, found.structure)


def again(step: Callable[[Tensor], Any], old: list[Tensor], new: list[Tensor], path: Path) -> list[float]:
    """The numbers of a step that another process reads with other tensors."""
    save(path, traced(step), old)
    found = load(path, new)
    assert found is not None
    numbers: list[float] = found.recipe.values.tolist()
    return numbers


STEPS: dict[str, tuple[Callable[[Tensor], Any], Callable[[Tensor], Tensor]]] = {
    "itself": (lambda x: x * A, lambda a: a),
    "made of it": (lambda x: x * (2 * A + 1).exp(), lambda a: (2 * a + 1).exp()),
    "of another dtype": (lambda x: x * A.to(torch.float32).double(), lambda a: a.float().double()),
    "with a constant of the step": (
        lambda x: x * torch.add(A, torch.tensor([1.0, 0.0, 4.0]).double(), alpha=2),
        lambda a: a + torch.tensor([2.0, 0.0, 8.0]),
    ),
    "of two that were made": (
        lambda x: x * (A * 2 + A.sin()) * (A * 2).cumsum(0),
        lambda a: torch.cat((a * 2 + a.sin(), (2 * a).cumsum(0))),
    ),
    "of one part of what was made": (lambda x: x * A.aminmax()[1], lambda a: a.max().reshape(1)),
    "at strides": (lambda x: x[:, :2] * A[::2], lambda a: a[::2]),
    "of a given memory format": (
        lambda x: x * A.clone(memory_format=torch.contiguous_format).exp(),
        lambda a: a.exp(),
    ),
}


@pytest.mark.parametrize("name", STEPS)
def test_another_process_finds_the_numbers_that_follow_from_its_own_tensors(
    name: str, tmp_path: Path
) -> None:
    step, wanted = STEPS[name]
    assert again(step, [A], [A], tmp_path / "trace") == wanted(A).tolist()
    assert again(step, [A], [B], tmp_path / "trace") == wanted(B).tolist()


def test_tensors_are_told_apart_by_the_order_in_which_they_were_given(tmp_path: Path) -> None:
    step, path = lambda x: x * (A - 2 * B), tmp_path / "trace"
    assert again(step, [A, B], [A, B], path) == (A - 2 * B).tolist()
    assert again(step, [B, A], [A, B], path) == (B - 2 * A).tolist()
    assert again(step, [A, B, A], [A, B, A], path) == (A - 2 * B).tolist()


def test_all_that_was_written_comes_back_and_no_number_of_a_tensor_is_in_the_file(tmp_path: Path) -> None:
    one = traced(lambda x: x * (A + 1))
    save(tmp_path / "one", one, [A])
    found = load(tmp_path / "one", [A])
    assert found is not None
    assert found.text == one.text
    assert (found.real, found.outputs, found.structure) == (one.real, one.outputs, one.structure)
    assert [at.tolist() for _, at in found.recipe.reads] == [at.tolist() for _, at in one.recipe.reads]
    other = traced(lambda x: x * (B + 1))
    save(tmp_path / "other", other, [B])
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "other"]  # no scratch is left


def test_where_numbers_follow_from_more_nothing_is_written(tmp_path: Path) -> None:
    save(tmp_path / "trace", traced(lambda x: x * (A + B)), [A])
    assert not list(tmp_path.iterdir())
    assert load(tmp_path / "trace", [A]) is None
    save(tmp_path / "no folder" / "trace", traced(lambda x: x * A), [A])  # and nobody hears of it


def test_a_trace_is_written_beside_its_place_and_noted_as_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "no folder"))
    path = tmp_path / "trace"
    save(path, traced(lambda x: x * A), [A])
    os.utime(path, (1e9, 1e9))
    assert load(path, [A]) is not None
    assert path.stat().st_mtime > 1e9 + 1


def test_a_number_that_the_step_read_decides(tmp_path: Path) -> None:
    gain = torch.tensor(2.0, dtype=torch.float64)
    save(tmp_path / "trace", traced(lambda x: x * A if bool(gain > 1) else x), [gain, A])
    assert load(tmp_path / "trace", [gain + 1, B]) is not None
    assert load(tmp_path / "trace", [gain - 2, B]) is None


def test_a_file_without_its_digest_is_no_trace(tmp_path: Path) -> None:
    path = tmp_path / "trace"
    save(path, traced(lambda x: x * A), [A])
    content = path.read_bytes()
    assert content[-32:] == hashlib.sha256(content[:-32]).digest()
    for damaged in (content[:-1], content[1:], content + b"0", content[:40] + b"0" + content[41:], b"", b"0"):
        path.write_bytes(damaged)
        assert load(path, [A]) is None
    other = zlib.compress(pickle.dumps((1, 2)))  # whole, of something else
    path.write_bytes(other[:9] + hashlib.sha256(other[:9]).digest())
    assert load(path, [A]) is None


class Mine(NamedTuple):
    """Of a user."""

    x: int


def read(*name: Any, given: tuple[Tensor, ...] = ()) -> Any:
    """What a reader finds behind the name of something that is not in the file."""
    return trace_cache._Reader(io.BytesIO(), given).persistent_load(name)


def test_a_reader_knows_operations_dtypes_and_tensors_alone() -> None:
    aten = torch.ops.aten
    assert read("operation", "aten::add", "Tensor") is aten.add.Tensor
    assert read("operation", "aten::exp", "") is aten.exp.default
    assert read("operation", "prims::convert_element_type", "") is (
        torch.ops.prims.convert_element_type.default
    )
    for value in (torch.float32, torch.int64, torch.bool, torch.contiguous_format, torch.strided):
        assert read("named", str(value).removeprefix("torch.")) is value
    assert read("given", 1, given=(A, B)) is B
    assert torch.equal(read("value", A.numpy()), A)
    reader = trace_cache._Reader(io.BytesIO(), ())
    one, other = (reader.persistent_load(("made", k)) for k in (0, 1))
    assert one is reader.persistent_load(("made", 0))
    assert one is not other
    for name in (
        ("operation", "inductor::_alloc_from_pool", ""),
        ("operation", "profiler::_record_function_enter", ""),
        ("named", "load"),
        ("named", "nn"),
        ("named", "no such name"),
    ):
        with pytest.raises(pickle.UnpicklingError, match="not belong into a trace"):
            read(*name)


def test_a_reader_knows_the_named_tuples_of_this_package_alone() -> None:
    reader = trace_cache._Reader(io.BytesIO(), ())
    assert reader.find_class("staf_torch.lanes.emission", "Text") is Text
    assert reader.find_class("torch", "Size") is torch.Size
    assert reader.find_class("builtins", "slice") is slice
    for module, name in (
        (__name__, "Mine"),  # a named tuple of somebody else
        ("staf_torch.lanes.graph", "Graph"),  # a class that is none
        ("staf_torch.lanes.trace_cache", "load"),
        ("staf_torch.lanes.trace_cache", "pickle.loads"),
        ("staf_torch.lanes.trace_cache", "no such name"),
        ("staf_torch.no_such_module", "Text"),
        ("torch", "Tensor"),
        ("builtins", "eval"),
        ("os", "stat_result"),
    ):
        with pytest.raises(pickle.UnpicklingError, match="does not belong into a trace"):
            reader.find_class(module, name)


def test_a_place_follows_from_all_that_a_trace_depends_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trace_cache, "_cache", lambda: tmp_path)
    first = place(b"step", 1)
    assert first == place(b"step", 1)
    assert first.parent == tmp_path
    assert first.name.startswith("trace-")
    assert len(first.name) == len("trace-") + 24
    found = {first, place(b"step", 2), place(b"step"), place(b"other", 1)}
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32 if before == torch.float64 else torch.float64)
    try:
        found.add(place(b"step", 1))
    finally:
        torch.set_default_dtype(before)
    monkeypatch.setattr(torch, "__version__", "0.0")
    found.add(place(b"step", 1))
    monkeypatch.setattr(trace_cache, "_package", lambda: "another version")
    found.add(place(b"step", 1))
    assert len(found) == 7


def test_the_digest_of_a_package_follows_from_every_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trace_cache, "_PACKAGE", tmp_path)
    found = set()
    (tmp_path / "inner").mkdir()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("inner/b.py", "1"), ("inner/b.py", "2")):
        (tmp_path / name).write_text(text)
        found.add(trace_cache._package.__wrapped__())
    (tmp_path / "note.txt").write_text("no code")
    found.add(trace_cache._package.__wrapped__())
    assert len(found) == 4
