"""The data sheet of an exported function."""

from __future__ import annotations

import dataclasses
import itertools
import time

import pytest
import torch

from staf_torch import deploy
from staf_torch.deploy import sheet


def test_latency_is_in_microseconds_of_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    spent = itertools.chain.from_iterable((0, 1000 * k) for k in range(1, 102))  # 1 to 101 us
    now = itertools.accumulate(spent)
    monkeypatch.setattr(time, "perf_counter_ns", lambda: next(now))
    found = sheet.latency(lambda x: x, torch.zeros(1, 2), calls=101)
    assert dataclasses.astuple(found) == (101, 51.0, 100.0, 101.0)


def test_products_of_matrices_count_their_inner_dimension() -> None:
    class Products(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            left, right = torch.ones(7, 5, dtype=x.dtype), torch.ones(5, 3, dtype=x.dtype)
            return (x.sum() * left @ right).sum().reshape(1, 1)

    counted = sheet.work(deploy.trace(Products(), torch.ones(1, 2, dtype=torch.float64), batch=1))
    # sum of 2, the product with 35 entries, 21 entries of 5 products and 4 sums, the sum of 21
    assert counted.flops == 1 + 35 + 21 * 9 + 20
