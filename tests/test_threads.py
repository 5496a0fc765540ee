"""Objects that several threads, a fork or a copy have at once: what all of them see is whole."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import signal
import threading

import pytest
import torch
from helpers_threads import OBJECTS, X, Y, crowd, together
from variants import over

import staf_torch as st
from staf_torch import lanes
from staf_torch.online import MixtureRegressor

LEARNERS = {
    "filter": lambda: st.StaFRegressor(radius=0.3),
    "mixture": lambda: MixtureRegressor(128, 8),
}


@over(OBJECTS, "name")
def test_four_threads_get_the_bits_of_one_and_ask_beside_others_that_learn(name: str) -> None:
    crowd(OBJECTS[name], 24 if OBJECTS[name].learn else 8)


@over(LEARNERS, "kind")
def test_who_asks_beside_one_that_learns_sees_it_before_or_after_a_sample(kind: str) -> None:
    """And what was learned has the bits that it has without anybody who asks, also where x is learned."""
    alone, model = (LEARNERS[kind]().partial_fit(X[0], Y[0]) for _ in range(2))
    states = [float(alone.predict(X[7]))]
    states += [float(alone.partial_fit(X[k], Y[k]).predict(X[7])) for k in range(1, 40)]
    seen, done = set[float](), threading.Event()

    def work(number: int) -> None:
        if number:
            while not done.is_set():
                seen.add(float(model.predict(X[7])))
                model.predict(X[8])
            return
        for k in range(1, 40):
            model.partial_fit(X[k], Y[k])
        done.set()

    together(3, work)
    assert seen <= set(states)
    assert float(model.predict(X[7])) == states[-1]


def test_streams_come_and_go_beside_threads_that_learn_and_ask() -> None:
    model = st.StaFRegressor(radius=0.3)
    refused = list[str]()
    for k in range(5):
        model.partial_fit(X[k : k + 2], Y[k : k + 2])

    def work(number: int) -> None:
        for k in range(40):
            if number == 0:
                model.add(1).drop([2])
            elif number == 1:
                model.reset(streams=[1])
            else:
                try:
                    assert model.predict(X[k % 30 :][:2]).shape == (2,)
                    model.partial_fit(X[k % 30 :][:2], Y[k % 30 :][:2])
                except ValueError as error:  # there were three just then
                    refused.append(str(error))

    together(4, work)
    assert model.n_streams_ == 2
    assert all("must have the shape (3, 2) of the first sample" in told for told in refused)


def test_one_of_several_threads_compiles_and_all_are_right() -> None:
    gain = 0.1 + torch.rand(())

    def step(x: torch.Tensor, u: torch.Tensor, row: tuple[()]) -> tuple[torch.Tensor, torch.Tensor]:
        x = x + 0.01 * (u - gain * x.sin())
        return x, x

    program, inputs = lanes.Program(step), (X[0], X[:20].mT.clone())
    wanted, found = program.definition(*inputs)[1], {}
    together(4, lambda number: found.update({number: program(*inputs)[1]}))
    assert all(torch.equal(found[0], each) for each in found.values())
    torch.testing.assert_close(found[0], wanted)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
def test_copies_and_forks_beside_a_thread_that_learns_are_whole_and_free() -> None:
    model, done = st.StaFRegressor(radius=0.3).fit(X, Y), threading.Event()

    def learn() -> None:
        k = 0
        while not done.is_set():
            model.partial_fit(X[k % 40], Y[k % 40], lapse=1.0)
            k += 1

    def learn_once() -> None:
        signal.alarm(20)  # one that waits for a lock that nobody has ends so
        assert model.partial_fit(X[0], Y[0], lapse=2.0).predict(X[1]).isfinite()

    thread = threading.Thread(target=learn)
    thread.start()
    try:
        for _ in range(5):
            for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
                assert twin.partial_fit(X[0], Y[0]).predict(X[1]).isfinite()
            child = multiprocessing.get_context("fork").Process(target=learn_once)
            child.start()
            child.join()
            assert child.exitcode == 0
    finally:
        done.set()
        thread.join()
