"""`MujocoPlant` beside a small MuJoCo written here: what the simulator is asked, what is made of it."""

from __future__ import annotations

import enum
import sys
import types
from typing import Any

import numpy as np
import pytest
import torch
from helpers import uniform

from staf_torch import systems

Joint = enum.IntEnum("Joint", ["mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE"], start=0)
Integrator = enum.IntEnum("Integrator", ["mjINT_EULER", "mjINT_RK4"], start=0)
State = enum.IntEnum("State", {"mjSTATE_QPOS": 2, "mjSTATE_FULLPHYSICS": 15})


class Made:
    """An object with these attributes."""

    def __init__(self, **given: Any) -> None:
        vars(self).update(given)


class Model(Made):
    """A slide and a hinge around (0.5, -1), and an activation that follows the first of two inputs."""

    nq, nv, na, nu, more, warm, names = 2, 2, 1, 2, 0, 0.3, ("slide", "hinge")
    opt, qpos0 = Made(timestep=0.25, integrator=0), np.array([0.5, -1.0])
    jnt_type, jnt_limited, actuator_ctrllimited = np.array([2, 3]), np.array([0, 0]), np.array([1, 0])
    actuator_ctrlrange = np.array([[-1.0, 2.0], [0.0, 0.0]])

    def joint(self, index: int) -> Any:
        return Made(name=self.names[index])


class Data:
    """Time and state in one array, of which the parts of the state are views."""

    def __init__(self, model: Model) -> None:
        self.all = np.array([0.0, *model.qpos0, 0.0, 0.0, 0.0])
        self.qpos, self.qvel, self.act = np.split(self.all[1:], (2, 4))
        self.ctrl, self.qacc_warmstart = np.full(2, 5.0), np.full(2, 9.0)  # left from another run


def reset(model: Model, data: Data) -> None:
    data.all[:], data.ctrl[:], data.qacc_warmstart[:] = Data(model).all, 0.0, 0.0


def step(model: Model, data: Data, nstep: int = 1) -> None:
    for _ in range(nstep):
        if np.abs(data.qvel).max() > 1e6:  # numbers explode: the clock begins anew
            data.all[:], data.qacc_warmstart[:] = Data(model).all, 0.0
            continue
        pull = -2.0 * np.sin(data.qpos - model.qpos0) - 0.4 * data.qvel + 0.5 * data.act
        pull += np.array([[1.0, 0.2], [0.0, 0.7]]) @ data.ctrl + model.warm * data.qacc_warmstart
        rates = np.concatenate(([1.0], data.qvel, pull, data.ctrl[:1] - data.act))
        data.all += model.opt.timestep * rates
        data.qacc_warmstart[:] = pull


def transition(model: Model, data: Data, eps: float, centered: bool, a: Any, b: Any, *other: Any) -> None:
    assert (eps, centered, other) == (1e-6, True, (None, None))

    def after(move: np.ndarray) -> np.ndarray:
        probe = Data(model)
        probe.all[1:], probe.ctrl[:] = data.all[1:] + move[:5], data.ctrl + move[5:]
        probe.qacc_warmstart[:] = data.qacc_warmstart
        step(model, probe)
        return probe.all[1:]

    slopes = np.stack([(after(move) - after(-move)) / 2e-6 for move in 1e-6 * np.eye(7)], axis=1)
    a[:], b[:] = slopes[:, :5], slopes[:, 5:]


def rollout(models: list[Model], data: list[Data], initial: Any, control: Any, **given: Any) -> None:
    for k, model in enumerate(models):
        each = data[k % len(data)]
        each.all[:], each.qacc_warmstart[:] = initial[k], given["initial_warmstart"][k]
        for j in range(given["nstep"]):
            each.ctrl[:] = control[k, j]
            step(model, each)
            given["state"][k, j] = each.all


def copied(kind: int, to: np.ndarray, what: np.ndarray) -> None:
    assert kind == State.mjSTATE_FULLPHYSICS
    to[:] = what


@pytest.fixture(autouse=True)
def _stub(monkeypatch: pytest.MonkeyPatch) -> None:
    stub: Any = types.ModuleType("mujoco")
    stub.MjModel, stub.MjData, stub.mjtJoint, stub.mjtIntegrator = Model, Data, Joint, Integrator
    stub.mjtState, stub.rollout = State, Made(rollout=rollout)
    stub.mj_step, stub.mj_resetData, stub.mjd_transitionFD = step, reset, transition
    stub.mj_setState = lambda model, data, state, kind: copied(kind, data.all, state)
    stub.mj_getState = lambda model, data, state, kind: copied(kind, state, data.all)
    stub.mj_stateSize = lambda model, kind: 1 + model.nq + model.nv + model.na + model.more
    monkeypatch.setitem(sys.modules, "mujoco", stub)


def test_a_plant_is_of_the_size_and_of_the_limits_of_its_model() -> None:
    plant = systems.MujocoPlant(Model())
    assert (plant.dim, plant.inputs, plant.period, plant.periodic) == (5, 2, 0.25, (1,))
    assert plant.bounds is not None
    assert (plant.bounds.low.tolist(), plant.bounds.high.tolist()) == ([-1.0, -np.inf], [2.0, np.inf])
    assert plant.equilibrium().tolist() == [0.5, -1.0, 0.0, 0.0, 0.0]
    other = systems.MujocoPlant(Model(), periodic=(0,), low=-3.0)
    assert other.bounds is not None  # limits that are given take the place of those of the model
    assert (other.bounds.low.tolist(), other.bounds.high.tolist()) == ([-3.0] * 2, [np.inf] * 2)
    assert other.periodic == (0,)
    free = systems.MujocoPlant(Model(actuator_ctrllimited=np.zeros(2), jnt_limited=np.ones(2)))
    assert free.bounds is None
    assert free.periodic == ()  # a hinge with a limit does not turn around


@pytest.mark.parametrize(("threads", "frames"), [(2, 1), (1, 5)])
def test_rows_are_those_of_the_simulator_one_period_or_many(threads: int, frames: int) -> None:
    plant = systems.MujocoPlant(Model(), dt=0.25 * frames, threads=threads)
    x, u = uniform(4, 5, seed=1), uniform(4, 2, seed=2)
    x[2, 3] = 1e7  # it explodes at once: the clock begins anew, and ends at 1 again after five steps
    wanted, data = np.full((4, 5), np.nan), Data(plant.model)
    for k in (0, 1, 3):
        reset(plant.model, data)
        data.all[1:], data.ctrl[:] = x[k], u[k]
        step(plant.model, data, frames)
        wanted[k] = data.all[1:]
    np.testing.assert_array_equal(plant.step(x, u).numpy(), wanted)
    feedback = lambda z: np.stack((-z[:, 0] - z[:, 3], 0.1 * z[:, 1]), axis=1)  # noqa: E731
    states, controls = plant.function.follow(x.numpy(), feedback, 4)
    assert (states.shape, controls.shape) == ((4, 5, 5), (4, 4, 2))
    for k in range(4):
        after = plant.step(torch.from_numpy(states[:, k].copy()), torch.from_numpy(controls[:, k].copy()))
        np.testing.assert_array_equal(states[:, k + 1], after.numpy())
    assert np.isnan(states[2, 1:]).all()


@pytest.mark.parametrize("frames", [1, 3])
def test_slopes_are_chained_over_the_steps_of_a_period_and_begin_cold(frames: int) -> None:
    x, u = uniform(5, seed=3), uniform(2, seed=4)
    plant = systems.MujocoPlant(Model(warm=0.0), dt=0.25 * frames)
    known = plant.linearisation(x, u)
    plant.linearisation(-2 * x, u)
    assert torch.equal(plant.linearisation(x, u).matrix, known.matrix)  # whatever was simulated before
    rk4 = Model(warm=0.0, opt=Made(timestep=0.25, integrator=1))  # without slopes in MuJoCo: by differences
    other = systems.MujocoPlant(rk4, dt=0.25 * frames).linearisation(x, u)
    torch.testing.assert_close(known.matrix, other.matrix, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(known.input_matrix, other.input_matrix, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "given", "message"),
    [
        ({"jnt_type": np.array([2, 0]), "names": ["a", "b"]}, {}, "the joint b, mjJNT_FREE"),
        ({"nu": 0}, {}, "must have an actuator; got 'none'"),
        ({"more": 3}, {}, r"no state beyond \(qpos, qvel, act\).*got '3 more numbers'"),
        ({}, {"dt": 0.1}, "must be a multiple of the model's timestep of 0.25 s; got 0.1"),
        ({}, {"dt": -0.25}, r"`MujocoPlant\(dt=...\)` must be positive"),
        ({}, {"threads": 0}, r"`MujocoPlant\(threads=...\)` must be at least 1"),
        ({}, {"model": 3}, "must be the path of an XML file, XML text or an MjModel; got 3"),
    ],
)
def test_models_that_are_no_plant_are_refused(
    change: dict[str, Any], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        systems.MujocoPlant(**({"model": Model(**change)} | given))
