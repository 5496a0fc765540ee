"""Metrics of whole experiments, a few texts and facts of laws, compared with what was recorded of them.

    pytest tests/experiments/test_reference_metrics.py --record  # writes them anew

A change that is meant is seen in the difference of `tests/recorded/`. Numbers that the last bits decide are
no records: the next processor, compiler or version rounds otherwise.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

FOLDER = Path(__file__).with_name("recorded")
_FEW = 4  # numbers that are kept as they are; of more, two sums with weights, that of sizes, and how many
_NOISE = 1e-9  # what a number may differ by, whatever its size
_DEEP = 4  # objects in objects
_MEASURED = ("seconds", "microseconds", "digests")  # of a run: no two are alike

Numbers = dict[str, "list[float] | str"]


def numbers(value: Any) -> Numbers:
    """What is recorded of a value: numbers of every tensor, array, number and text in it, by its path."""
    parts = leaves(value)
    return {
        path: part if isinstance(part, str) else _sums(torch.as_tensor(part).detach()) for path, part in parts
    }


def leaves(value: Any, path: str = "", deep: int = _DEEP) -> Iterator[tuple[str, Any]]:
    """Paths and values of all tensors, arrays, numbers and texts in an object."""
    if isinstance(value, str | Tensor | np.ndarray | int | float):
        yield path, value
    else:
        for name, part in _inside(value) if deep else ():
            if name not in _MEASURED:
                yield from leaves(part, f"{path}.{name}".strip("."), deep - 1)


def _inside(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, nn.Module):
        yield from value.state_dict().items()
    elif isinstance(value, Mapping):
        yield from ((str(name), part) for name, part in value.items())
    elif hasattr(value, "_fields"):
        yield from zip(type(value).__match_args__, value, strict=True)
    elif isinstance(value, list | tuple):
        yield from ((str(at), part) for at, part in enumerate(value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from ((each.name, getattr(value, each.name)) for each in dataclasses.fields(value))


def _sums(value: Tensor) -> list[float]:
    flat = value.to_dense().flatten()
    flat = flat.double() if not flat.is_complex() else torch.view_as_real(flat).double().flatten()
    if flat.numel() <= _FEW:
        return [_short(each) for each in flat.tolist()]
    finite = flat.isfinite()
    flat = torch.where(finite, flat, 0.0)
    at = torch.arange(len(flat), dtype=torch.float64)
    first, second = (float((flat * (rate * at + 0.4).cos()).sum()) for rate in (1.0, 1.7))
    return [*map(_short, (first, second, float(flat.abs().sum()))), len(flat), int((~finite).sum())]


def _short(value: float) -> float:
    return float(f"{value:.9g}")


def differences(found: Numbers, kept: Mapping[str, Any], rtol: float) -> list[str]:
    """What of it is not as it was, a sentence each."""
    said = [f"{path} is {'new' if path in found else 'gone'}" for path in found.keys() ^ kept.keys()]
    for path in found.keys() & kept.keys():
        one, other = found[path], kept[path]
        if isinstance(one, str) or isinstance(other, str):
            same = one == other
        else:
            sizes = [abs(each) for each in other if math.isfinite(each)]
            slack = _NOISE + rtol * max(sizes[:_FEW], default=0.0)
            same = len(one) == len(other) and all(
                a == b or abs(a - b) <= slack or a != a != b != b for a, b in zip(one, other, strict=True)
            )
        if not same:
            said.append(f"{path} is {one}, was {other}")
    return sorted(said)


@functools.cache
def _kept(path: Path) -> dict[str, Any]:
    """What is recorded in a file, which is read once."""
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


class Record:
    """Compares what a test found with what is recorded under its name, or records it."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        """For one test."""
        self.path = FOLDER / f"{request.path.stem.removeprefix('test_')}.json"
        self.name = request.node.name
        self.writes = request.config.getoption("--record")

    def known(self) -> dict[str, Any]:
        """What is recorded of this test."""
        found: dict[str, Any] = {} if self.writes else _kept(self.path).get(self.name, {})
        return found

    def __call__(self, value: Any, *, rtol: float = 1e-6, without: str = "\n") -> None:
        """Fail where numbers of the value differ by more than a share of their size, or its texts differ.

        Parts whose path begins with ``without`` are not asked here, as those of another version are not.
        """
        found = numbers(value)
        if self.writes:
            known = json.loads(self.path.read_text()) if self.path.exists() else {}
            known[self.name] = found
            FOLDER.mkdir(exist_ok=True)
            lines = [f" {json.dumps(name)}: {json.dumps(known[name])}" for name in sorted(known)]
            self.path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
            return
        known = _kept(self.path)
        assert self.name in known, f"nothing is recorded of {self.name}: run it with --record"
        kept = {path: part for path, part in known[self.name].items() if not path.startswith(without)}
        found = {path: part for path, part in found.items() if not path.startswith(without)}
        said = differences(found, kept, rtol)
        assert not said, "\n".join(said)
