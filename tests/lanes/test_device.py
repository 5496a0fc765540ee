"""What a device does otherwise than the processor, on the host in its place: graphs, what is compiled."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

import staf_torch as st
from staf_torch import adp, lanes, optim, systems, targets
from staf_torch.lanes.tree import flatten

pytestmark = pytest.mark.needs_compiler
X0 = torch.tensor([[0.3, 0.1], [-0.2, 0.5], [1.0, -1.0]], dtype=torch.float64)


class Graph(TorchFunctionMode):
    """What `torch.cuda.graph` records, on the host: kernels and operations of torch; nothing can be read."""

    reads = ("item", "tolist", "__bool__", "__float__", "__int__", "nonzero", "cpu", "numpy", "unique")

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[Callable[[], None]] = []
        self.pool: list[Any] = []  # a graph has memory of its own
        self.captured = lanes.device.captured()

    def __enter__(self) -> Graph:
        self.launches = self.captured.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self.kernels()
        self.captured.__exit__(*error)

    def kernels(self) -> None:
        self.steps += self.launches
        self.launches.clear()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, given = getattr(func, "__name__", ""), kwargs or {}
        assert name not in self.reads, f"{name} reads a number while a graph is recorded"
        self.kernels()
        found = func(*args, **given)
        self.pool.append(found)
        made = [each for each in flatten(found)[0] if isinstance(each, Tensor)]

        def again() -> None:
            for old, new in zip(made, flatten(func(*args, **given))[0], strict=True):
                if old.data_ptr() != new.data_ptr():
                    old.copy_(new)

        if made and "empty" not in name:
            self.steps.append(again)
        return found

    def replay(self) -> None:
        for step in self.steps:
            step()


@pytest.mark.parametrize("when", ["auto", "never"])
def test_a_graph_of_simulate_has_the_numbers_of_a_call_and_marks_rows_that_need_shorter_steps(
    when: str,
) -> None:
    plant, x = systems.VanDerPol(), X0.repeat(20, 1) * torch.linspace(0.1, 1, 60).unsqueeze(1)
    with lanes.compiling(when), lanes.device.host():
        systems.simulate(plant, x, dt=0.01, steps=12)
        with Graph() as graph:
            found = systems.simulate(plant, x, dt=0.01, steps=12)
        for scale in (0.5, 100.0):
            x.mul_(scale)
            graph.replay()
            good = found.isfinite().flatten(1).all(1)
            assert torch.equal(found[good], systems.simulate(plant, x, dt=0.01, steps=12)[good])
            assert bool(good.all()) is (scale < 1)


def sums_of_sines(numbers: Tensor) -> lanes.Program:
    return lanes.Program(lambda x, now, row: (0.5 * x + (x.unsqueeze(-1) * numbers).sin().sum(-1), x))


def test_a_graph_outlives_the_program_that_was_recorded() -> None:
    """A table too long for a kernel's arguments is read where it was."""
    program = sums_of_sines(torch.linspace(0, 1, 1600, dtype=torch.float64))
    x = X0[:, 0].clone()
    with lanes.device.host():
        program(x, steps=3)
        with Graph() as graph:
            found = program(x, steps=3)[1]
    wanted = program.definition(2 * x, steps=3)[1]
    del program
    gc.collect()
    others = [torch.full((1600,), torch.nan, dtype=torch.float64) for _ in range(50)]
    x.mul_(2)
    graph.replay()
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    del others


def kernels_of(call: Callable[[], Any]) -> int:
    with lanes.device.recorded() as texts:
        call()
    return len(texts)


def test_on_a_device_a_loop_of_few_steps_is_a_kernel() -> None:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.3)).double()
    calls: list[Callable[[], Any]] = [
        lambda: systems.simulate(systems.VanDerPol(), X0, dt=0.01, steps=3),
        lambda: adp.simulate(lambda x: -x[..., 1:], plant, cost, X0, dt=0.01, steps=3),
        lambda: st.chase_weights(X0.unsqueeze(1), basis, targets.Paper(), optim.SteepestDescent()),
    ]
    for call in calls:
        assert kernels_of(call) == 1
        with lanes.compiling("never"):
            assert kernels_of(call) == 0


def test_a_history_without_room_on_a_device_comes_to_the_processor_with_the_same_bits(
    caplog: pytest.LogCaptureFixture,
) -> None:
    x, plant = X0.repeat(5, 1), systems.VanDerPol()
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.3)).double()
    given = x[:, None] * torch.linspace(1, 0.5, 41, dtype=x.dtype)[:, None], lanes.Shared(torch.ones(41))

    def step(carry: Any, now: Any, gain: Tensor) -> Any:
        held, count = carry
        held = held + gain.unsqueeze(-1) * now[0] * now[1]
        return (held, count + 1), (held.sum(-1), count)

    program = lanes.Program(step)
    start = x, torch.zeros(len(x), dtype=torch.long)
    law, paper = optim.SteepestDescent(), targets.Paper()
    calls: dict[str, tuple[int, Callable[[], Any]]] = {
        "program": (2600, lambda: program(start, given, x[:, 0], every=3)),
        "a fast plant": (2600, lambda: systems.simulate(plant, 20 * x, dt=0.05, steps=40)),
        "weights": (9000, lambda: vars(st.chase_weights(given[0], basis, paper, law))),
    }
    for name, (memory, call) in calls.items():
        with lanes.device.host():
            wanted = flatten(call())[0]
        for _ in range(2):
            with lanes.device.host(memory=memory):
                found = flatten(call())[0]
            for one, other in zip(found, wanted, strict=True):
                assert torch.equal(one.nan_to_num(7.0), other.nan_to_num(7.0)), name
    assert caplog.text.count("brought there in 7 chunks") == 1
