"""Objects that threads share, and threads that begin at the same time: for the suite and `sanitized.py`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

import staf_torch as st
from staf_torch import adp, lanes, systems
from staf_torch.online import MixtureRegressor

PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
TIME = 0.05 * torch.arange(40, dtype=torch.float64)
X = torch.stack((TIME.cos(), (1.3 * TIME).sin()), -1)
Y = X[:, 0] * X[:, 1]


class Crowded(NamedTuple):
    """An object, a question with a number, and a lesson with one, where there are lessons."""

    make: Callable[[], Any]
    ask: Callable[[Any, int], Tensor]
    learn: Callable[[Any, int], object] | None = None


def _fitted(model: Any) -> Any:
    return model.fit(X, Y)


def _told(model: Any, k: int) -> Tensor:
    return torch.stack(model.predict(X[k % 40], return_std=True))


def _taught(model: Any, k: int) -> object:
    return model.partial_fit(X[k % 40], Y[k % 40])


def _stored(memory: st.ExperienceMemory, k: int) -> object:
    x, basis = X[k % 40], memory.basis
    return memory.add(x, basis.local(x).fit(basis.values(x, lambda y: y.square().sum(-1))))


def _memory() -> st.ExperienceMemory:
    directions = st.StateFollowingCenters(st.rings(3), radius=0.2)
    memory = st.ExperienceMemory(st.StaFBasis(st.GaussianKernel(), directions), capacity=16)
    _stored(memory, 0)
    return memory


def _damped(x: Tensor, u: Tensor, row: Any) -> tuple[Tensor, Tensor]:
    x = x + 0.01 * (u - 2.0 * x.sin())
    return x, x


def _ready(policy: Any) -> Any:
    lanes.ready(policy, X[0])
    return policy


OBJECTS = {
    "filter": Crowded(lambda: _fitted(st.StaFRegressor(radius=0.3)), _told, _taught),
    "filter of an angle": Crowded(lambda: _fitted(st.StaFRegressor(periodic=[0])), _told, _taught),
    "mixture": Crowded(lambda: _fitted(MixtureRegressor(128, 8)), _told, _taught),
    "memory": Crowded(_memory, lambda memory, k: memory.query(X[:3]), _stored),
    "program": Crowded(
        lambda: lanes.Program(_damped), lambda program, k: program(X[k % 40], X[: 1 + k % 2].mT.clone())[1]
    ),
    "policy": Crowded(
        lambda: _ready(adp.RolloutPolicy.of_lqr(PLANT, COST)), lambda policy, k: policy(X[k % 40])
    ),
    "loop": Crowded(
        lambda: adp.Feedback(adp.LQR(PLANT, COST)),
        lambda loop, k: adp.simulate(loop, PLANT, COST, X[k % 2 :][:2], dt=0.05, steps=4).cost,
    ),
}


def together(count: int, work: Callable[[int], object]) -> None:
    """Let threads begin work(0), work(1), ... at the same time; raise the first error of one."""
    start, errors = threading.Barrier(count), list[BaseException]()

    def run(number: int) -> None:
        try:
            start.wait()
            work(number)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def crowd(shared: Crowded, times: int) -> None:
    """Ask from four threads what one was told before; then ask and learn, losing nothing."""
    made = shared.make()
    told = [shared.ask(made, k) for k in range(8)]

    def ask(number: int) -> None:
        for k in range(times):
            assert torch.equal(shared.ask(made, (k + number) % 8), told[(k + number) % 8]), k

    together(4, ask)
    if (learn := shared.learn) is None:
        return
    before = _samples(made)

    def both(number: int) -> None:
        for k in range(times):
            found = shared.ask(made, k) if number % 2 else learn(made, k)
            assert not isinstance(found, Tensor) or bool(found.isfinite().all())

    together(4, both)
    assert before is None or _samples(made) == before + 2 * times


def _samples(model: Any) -> int | None:
    """What it has learned from or left out; None of what does not count."""
    return int(model.n_samples_seen_ + model.n_skipped_) if hasattr(model, "n_skipped_") else None
