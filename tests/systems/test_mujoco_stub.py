"""`MujocoPlant` beside a small MuJoCo written here: what the simulator is asked, what is made of it."""

from __future__ import annotations

import enum
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import uniform
from torch import Tensor

from staf_torch import systems

Joint = enum.IntEnum("Joint", ["mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE"], start=0)
Integrator = enum.IntEnum("Integrator", ["mjINT_EULER", "mjINT_RK4"], start=0)
State = enum.IntEnum("State", {"mjSTATE_QPOS": 2, "mjSTATE_FULLPHYSICS": 15})


class Made:
    """An object with these attributes."""

    def __init__(self, **given: Any) -> None:
        vars(self).update(given)


class Model:
    """A slide and a hinge around (0.5, -1), and an activation that follows the first of two inputs."""

    nq, nv, na, nu, more = 2, 2, 1, 2, 0

    def __init__(self) -> None:
        self.qpos0 = np.array([0.5, -1.0])
        self.jnt_type, self.jnt_limited = np.array([2, 3]), np.array([0, 0], dtype=np.uint8)
        self.actuator_ctrllimited = np.array([1, 0], dtype=np.uint8)
        self.actuator_ctrlrange = np.array([[-1.0, 2.0], [0.0, 0.0]])
        self.opt = Made(timestep=0.25, integrator=0)
        self.names, self.warm = ["slide", "hinge"], 0.3

    def joint(self, index: int) -> Any:
        return Made(name=self.names[index])


class Data:
    def __init__(self, model: Model) -> None:
        self.time, self.qpos, self.qvel, self.act = 0.0, model.qpos0.copy(), np.zeros(2), np.zeros(1)
        self.ctrl, self.qacc_warmstart = np.full(2, 5.0), np.full(2, 9.0)  # left from another run


def reset(model: Model, data: Data) -> None:
    data.time = 0.0
    data.qpos[:], data.qvel[:], data.act[:] = model.qpos0, 0.0, 0.0
    data.ctrl[:], data.qacc_warmstart[:] = 0.0, 0.0


def step(model: Model, data: Data, nstep: int = 1) -> None:
    h = model.opt.timestep
    for _ in range(nstep):
        if np.abs(data.qvel).max() > 1e6:
            control = data.ctrl.copy()
            reset(model, data)
            data.ctrl[:] = control
            continue
        gear = np.array([[1.0, 0.2], [0.0, 0.7]])
        pull = -2.0 * np.sin(data.qpos - model.qpos0) - 0.4 * data.qvel + gear @ data.ctrl + 0.5 * data.act
        pull = pull + model.warm * data.qacc_warmstart
        data.qpos += h * data.qvel
        data.qvel += h * pull
        data.act += h * (data.ctrl[:1] - data.act)
        data.qacc_warmstart[:] = pull
        data.time += h


def set_state(model: Model, data: Data, state: np.ndarray, kind: int) -> None:
    assert kind == 15
    data.time = state[0]
    data.qpos[:], data.qvel[:], data.act[:] = np.split(state[1:], (2, 4))


def get_state(model: Model, data: Data, state: np.ndarray, kind: int) -> None:
    assert kind == 15
    state[:] = [data.time, *data.qpos, *data.qvel, *data.act]


def transition(model: Model, data: Data, eps: float, centered: bool, a: Any, b: Any, c: Any, d: Any) -> None:
    assert (eps, centered, c, d) == (1e-6, True, None, None)
    at = np.concatenate((data.qpos, data.qvel, data.act, data.ctrl))

    def after(z: np.ndarray) -> np.ndarray:
        other, out = Data(model), np.empty(6)
        set_state(model, other, np.concatenate(([0.0], z[:5])), 15)
        other.ctrl[:], other.qacc_warmstart[:] = z[5:], data.qacc_warmstart
        step(model, other)
        get_state(model, other, out, 15)
        return out[1:]

    moves = 1e-6 * np.eye(7)
    slopes = np.stack([(after(at + move) - after(at - move)) / 2e-6 for move in moves], axis=1)
    a[:], b[:] = slopes[:, :5], slopes[:, 5:]


def rollout(
    models: list[Model], data: list[Data], initial: np.ndarray, control: np.ndarray, **given: Any
) -> None:
    for k, model in enumerate(models):
        each = data[k % len(data)]
        set_state(model, each, initial[k], 15)
        each.qacc_warmstart[:] = given["initial_warmstart"][k]
        for j in range(given["nstep"]):
            each.ctrl[:] = control[k, j]
            step(model, each)
            get_state(model, each, given["state"][k, j], 15)


@pytest.fixture(autouse=True)
def _stub(monkeypatch: pytest.MonkeyPatch) -> None:
    stub: Any = types.ModuleType("mujoco")
    stub.MjModel, stub.MjData, stub.mjtJoint, stub.mjtIntegrator = Model, Data, Joint, Integrator
    stub.mjtState, stub.rollout = State, Made(rollout=rollout)
    stub.mj_step, stub.mj_resetData, stub.mj_setState, stub.mj_getState = step, reset, set_state, get_state
    stub.mjd_transitionFD = transition
    stub.mj_stateSize = lambda model, kind: 1 + model.nq + model.nv + model.na + model.more
    monkeypatch.setitem(sys.modules, "mujoco", stub)


def made(change: Callable[[Model], object] = lambda model: None, **given: Any) -> systems.MujocoPlant:
    model = Model()
    change(model)
    return systems.MujocoPlant(model, **given)


def after(x: Tensor, u: Tensor, frames: int) -> np.ndarray:
    model, rows = Model(), []
    for state, control in zip(x.numpy(), u.numpy(), strict=True):
        data, out = Data(model), np.empty(6)
        reset(model, data)
        set_state(model, data, np.concatenate(([1.0], state)), 15)
        data.ctrl[:] = control
        step(model, data, frames)
        get_state(model, data, out, 15)
        rows.append(out[1:] if out[0] > 1 else np.full(5, np.nan))
    return np.stack(rows)


def test_a_plant_is_of_the_size_and_of_the_limits_of_its_model() -> None:
    plant = made()
    assert (plant.dim, plant.inputs, plant.period, plant.periodic) == (5, 2, 0.25, (1,))
    assert plant.bounds is not None
    assert (plant.bounds.low.tolist(), plant.bounds.high.tolist()) == ([-1.0, -np.inf], [2.0, np.inf])
    assert plant.equilibrium().tolist() == [0.5, -1.0, 0.0, 0.0, 0.0]
    assert made(dt=1.0).period == 1.0
    assert made(periodic=(0,)).periodic == (0,)
    own = made(low=-3.0).bounds  # limits that are given take the place of those of the model
    assert own is not None
    assert (own.low.tolist(), own.high.tolist()) == ([-3.0] * 2, [np.inf] * 2)
    free = made(lambda model: vars(model).update(actuator_ctrllimited=np.zeros(2), jnt_limited=np.ones(2)))
    assert free.bounds is None
    assert free.periodic == ()  # a hinge with a limit does not turn around


@pytest.mark.parametrize(("threads", "frames"), [(2, 1), (1, 5)])
def test_rows_are_those_of_the_simulator_one_period_or_many(threads: int, frames: int) -> None:
    plant = made(dt=0.25 * frames, threads=threads)
    x, u = uniform(4, 5, seed=1), uniform(4, 2, seed=2)
    x[2, 3] = 1e7  # it explodes at once: the clock begins anew, and ends at 1 again after five steps
    found = plant.step(x, u)
    np.testing.assert_array_equal(found.numpy(), after(x, u, frames))
    assert bool(found[2].isnan().all())

    def feedback(z: np.ndarray) -> np.ndarray:
        return np.stack((-z[:, 0] - z[:, 3], 0.1 * z[:, 1]), axis=1)

    states, controls = plant.function.follow(x.numpy(), feedback, 4)
    assert (states.shape, controls.shape) == ((4, 5, 5), (4, 4, 2))
    for k in range(4):
        now, held = torch.from_numpy(states[:, k].copy()), torch.from_numpy(controls[:, k].copy())
        np.testing.assert_array_equal(states[[0, 1, 3], k + 1], after(now, held, frames)[[0, 1, 3]])
    assert np.isnan(states[2, 1:]).all()


def test_slopes_are_chained_over_the_steps_of_a_period_and_begin_cold() -> None:
    x, u = uniform(5, seed=3), uniform(2, seed=4)
    for frames in (1, 3):
        plant = made(lambda model: vars(model).update(warm=0.0), dt=0.25 * frames)
        known = plant.linearisation(x, u)
        plant.linearisation(-2 * x, u)
        assert torch.equal(plant.linearisation(x, u).matrix, known.matrix)  # whatever was simulated before
        rk4 = made(lambda model: (vars(model).update(warm=0.0), setattr(model.opt, "integrator", 1)),
                   dt=0.25 * frames)  # fmt: skip
        other = rk4.linearisation(x, u)  # MuJoCo has no slopes of it: by differences
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
    ],
)
def test_models_that_are_no_plant_are_refused(
    change: dict[str, Any], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        made(lambda model: vars(model).update(change), **given)
