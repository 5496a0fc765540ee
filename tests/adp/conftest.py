"""A small memory of the pendulum's swing-up, learned once for all tests."""

from __future__ import annotations

import pytest
from helpers_swingup import REGION, pendulum

from staf_torch import adp


@pytest.fixture(scope="session")
def memory() -> adp.GlobalValue:
    return adp.learn_global_value(pendulum(), REGION, steps=120, trajectories=40, rounds=1, states=30)
