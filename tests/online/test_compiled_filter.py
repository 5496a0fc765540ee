"""The compiled filter is its definition, sample by sample, wherever a rule decides."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from helpers import tensor
from torch import Tensor

import staf_torch as st
from staf_torch import lanes
from staf_torch.online.compiled_filter import CompiledFilter, KernelFilter
from staf_torch.online.kalman_filter import LocalFilter
from staf_torch.online.local_functions import LocalFunctions, OwnFunctions
from staf_torch.online.stream_state import StateParts, StreamState

INF, NAN = math.inf, math.nan


def path(steps: int) -> Tensor:
    time = 0.21 * torch.arange(steps, dtype=torch.float64)
    return torch.stack((time.sin(), (1.4 * time).cos()), -1)


def targets(tiny: float) -> dict[str, list[float]]:
    """Streams of values, each of which meets a rule of what is believed; ``tiny`` is the least share."""
    usual = [0.4, -0.2, 0.5, 0.3, -0.1]
    most = 0.5 / tiny
    return {
        "out of proportion": [*usual, most * 1.01, 0.4, most, 0.1, *[-1.1 * most] * 3, 0, *[2 * most] * 6],
        "small": [*usual, 0.5 * tiny, 0.2, *[0.4 * tiny] * 3, 0.0, *[-0.3 * tiny] * 6, *usual],
        "both": [*usual, *[2 * most, 0.3 * tiny] * 5, *usual],
        "at once": [0.3, 3 / tiny, 0.2, 3 / tiny],
        "zeros at first": [0.0] * 5 + [4.0 / tiny, 0.1, 2.0],
        "zeros alone": [0.0] * 45,
        "outliers": [*usual, 9.0, *usual, *usual, -9.0, *usual, 9.0, *usual, *usual, 30.0, *usual],
        "gaps": [NAN, NAN, 0.3, 0.2, NAN, INF, 0.1, -INF, 0.3, *usual],
        "huge at first": [0.0, 0.0, 1e150 if tiny < 1e-5 else 1e15, 0.0, 0.1],
    }


def states(steps: int) -> dict[str, Tensor]:
    """Paths: smooth; at exactly the distance at which centers follow; jumps; what was not measured."""
    smooth = path(steps)
    edge = torch.zeros(steps, 2, dtype=torch.float64)
    edge[1::4, 0], edge[2::4, 1] = 0.5, -0.5
    jumps = smooth.clone()
    jumps[3::7] += 20.0
    jumps[5::11] += 1e9
    holes = smooth.clone()
    holes[::5, 0], holes[2::6, 1], holes[7::8] = NAN, NAN, NAN
    holes[9::10, 1] = INF
    return {"smooth": smooth, "edge": edge, "jumps": jumps, "holes": holes}


@pytest.mark.needs_compiler
@pytest.mark.parametrize(
    ("robust", "own", "dtype"),
    [(INF, False, torch.float64), (2.0, False, torch.float64), (2.0, True, torch.float32)],
)
def test_compiled_filter_is_its_definition(robust: float, own: bool, dtype: torch.dtype) -> None:
    follow(CompiledFilter, robust, own, dtype, 3)  # built as users have it


@pytest.mark.needs_compiler
@pytest.mark.parametrize(("own", "dtype", "count"), [(False, torch.float64, 3), (True, torch.float32, 1)])
def test_filter_on_a_device_is_its_definition(own: bool, dtype: torch.dtype, count: int) -> None:
    with lanes.device.host():
        follow(KernelFilter, 2.0, own, dtype, count)


def follow(kind: type, robust: float, own: bool, dtype: torch.dtype, count: int) -> None:
    """Compare a filter of some centers with its definition, step by step."""
    toward = st.rings(max(count, 3))[:count]
    lists = targets(float(torch.finfo(dtype).eps) ** 0.5)
    steps = max(map(len, lists.values()))
    paths = states(steps)
    rows = [(x, y) for x in paths.values() for y in lists.values()]
    streams = len(rows)
    x = torch.stack([path for path, _ in rows], 1).to(dtype)
    y = torch.stack([tensor([*one, *[0.3] * (steps - len(one))]) for _, one in rows], 1).to(dtype)
    ratio = torch.linspace(1e-3, 0.1, streams, dtype=torch.float64)
    forgetting = torch.linspace(0.9, 1.0, streams, dtype=torch.float64)
    functions: LocalFunctions | OwnFunctions = LocalFunctions.of(st.GaussianKernel(0.8), 0.5 * toward)
    definition = LocalFilter(functions, ratio, forgetting, 0.5, robust, 0.25)
    if own:  # a kernel, a radius, a slack of every stream's
        spread = torch.linspace(0.9, 1.1, streams, dtype=torch.float64)
        functions = OwnFunctions.of(spread / 0.64, spread[:, None, None] * 0.5 * toward)
        definition = LocalFilter(functions, ratio, forgetting, 0.5 * spread, robust * spread, 0.25 * spread)
    like = torch.zeros(0, dtype=dtype)
    fast, slow = (StreamState.empty(like, streams, 2, count, 1) for _ in range(2))
    compiled = CompiledFilter.build(definition, fast)
    assert isinstance(compiled, kind)
    near = {
        "rtol": 1e-4 if dtype == torch.float32 else 1e-6,
        "atol": 1e-6 if dtype == torch.float32 else 1e-9,
    }
    for k in range(steps):
        at = x[k].contiguous()
        lapse = None if k % 3 else torch.linspace(0.0, 3.0, streams, dtype=torch.float64)
        for found, expected in zip(compiled.predict(fast, at), definition.predict(slow, at), strict=True):
            torch.testing.assert_close(found, expected, equal_nan=True, **near)
        told = y[k].unsqueeze(-1).contiguous()
        compiled.learn(fast, at, told, lapse)
        definition.learn(slow, at, told, lapse)
        assert torch.equal(fast.counts, slow.counts)
        for name, found, expected in zip(
            StateParts.__annotations__,
            fast.parts(fast.table),
            slow.parts(slow.table),
            strict=True,
        ):
            size = expected.nan_to_num().abs().flatten(0, -2).amax(0).clamp(min=1e-30)
            torch.testing.assert_close(
                found / size,
                expected / size,
                equal_nan=True,
                msg=lambda told, name=name, k=k: f"{name} {k}: {told}",
                **near,
            )
        slow.blocks.copy_(fast.blocks)  # a step from equal states: rounding does not add up
    assert int(fast.counts[1].min()) == 0
    assert int(fast.counts[1].max()) > 10
    assert bool((fast.counts[3] < fast.counts[0]).any())  # some began afresh


@pytest.mark.needs_compiler
def test_a_stretch_is_learned_on_a_device_in_one_call_and_its_state_goes_on_there() -> None:
    x = path(12).unsqueeze(1) + torch.linspace(0, 1, 5, dtype=torch.float64).view(5, 1)
    y, time = (2 * x).sin().sum(-1), torch.cumsum(path(12)[:, 0].abs(), 0)
    x[3, 2], y[5, 1] = NAN, NAN

    def fitted(rows: slice) -> st.StaFRegressor:
        model = st.StaFRegressor(st.GaussianKernel(0.8), 0.4, 3, noise=0.05, robust=2.0)
        return model.fit(x[:, rows], y[:, rows], time)

    wanted = fitted(slice(None)).predict(x[-1], return_std=True)
    with lanes.device.host():
        model, alone = fitted(slice(None)), fitted(slice(2, 3))
        found = model.predict(x[-1], return_std=True)
        assert torch.equal(alone.predict(x[-1, 2:3]), found[0][2:3])
        again = copy.deepcopy(model).partial_fit(x[0], y[0])
        step_by_step = fitted(slice(None)).partial_fit(x[0], y[0])
        assert torch.equal(again.predict(x[1]), step_by_step.predict(x[1]))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)
