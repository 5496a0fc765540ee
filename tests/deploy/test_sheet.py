"""The data sheet of an exported function."""

from __future__ import annotations

import dataclasses
import itertools
import time

import pytest
import torch

from staf_torch.deploy import sheet


def test_latency_is_in_microseconds_of_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    spent = itertools.chain.from_iterable((0, 1000 * k) for k in range(1, 102))  # 1 to 101 us
    now = itertools.accumulate(spent)
    monkeypatch.setattr(time, "perf_counter_ns", lambda: next(now))
    found = sheet.latency(lambda x: x, torch.zeros(1, 2), calls=101)
    assert dataclasses.astuple(found) == (101, 51.0, 100.0, 101.0)
