"""Models of MuJoCo as plants."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
import torch

from staf_torch import adp, systems

mujoco = pytest.importorskip("mujoco", reason="needs the extra mujoco")

POLE = """
<mujoco><option timestep="0.01" integrator="{integrator}" gravity="1e-5 0 -9.81"/>
<worldbody><body><joint name="slide" type="slide" axis="1 0 0" damping="0.1"/><geom size="0.1" mass="1"/>
<body><joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.03" mass="0.2"/></body></body></worldbody>
<actuator><motor joint="slide" gear="20" ctrllimited="true" ctrlrange="-1 2"/></actuator></mujoco>
"""

FLOATING = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"


def pole(integrator: str = "implicitfast", **more: object) -> systems.MujocoPlant:
    return systems.MujocoPlant(POLE.format(integrator=integrator), **more)


def test_rows_are_the_simulations_of_mujoco_itself() -> None:
    plant = pole(dt=0.04, threads=2)
    assert (plant.dim, plant.inputs, plant.period, plant.periodic) == (4, 1, 0.04, (1,))
    assert (plant.bounds.low.tolist(), plant.bounds.high.tolist()) == ([-1.0], [2.0])
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    u = torch.rand(5, 1, generator=generator, dtype=torch.float64)
    after = plant.step(x, u)
    data = mujoco.MjData(plant.model)
    for row in range(5):
        mujoco.mj_resetData(plant.model, data)
        data.qpos[:], data.qvel[:] = x[row, :2].numpy(), x[row, 2:].numpy()
        data.ctrl[:] = u[row].numpy()
        for _ in range(4):
            mujoco.mj_step(plant.model, data)
        np.testing.assert_array_equal(after[row].numpy(), np.concatenate((data.qpos, data.qvel)))
    assert torch.equal(plant.step(x.flip(0), u.flip(0)).flip(0), after)
    for other in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        assert torch.equal(other.step(x, u), after)


def test_simulation_that_goes_on_under_a_feedback_has_the_bits_of_single_periods(
    tmp_path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the working directory
    plant = pole(dt=0.02)
    x = 0.3 * torch.randn(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64).numpy()
    x[2, 3] = 1e12  # MuJoCo resets this row
    feedback = lambda x: np.clip(-x[:, :1] - 5 * x[:, 1:2], -1.0, 2.0)  # noqa: E731
    for simulator in (plant, pole(dt=0.02, threads=2)):
        states, controls = simulator.function.follow(x, feedback, 5)
        assert (states.shape, controls.shape) == ((3, 6, 4), (3, 5, 1))
        for k in range(5):
            after = plant.step(torch.from_numpy(states[:, k].copy()), torch.from_numpy(controls[:, k].copy()))
            np.testing.assert_array_equal(after[:2].numpy(), states[:2, k + 1])
        assert np.isnan(states[2, 1:]).all()


def test_slopes_of_mujoco_are_those_of_differences() -> None:
    known, by_differences = pole(dt=0.03), pole("RK4", dt=0.03)
    at = known.linearisation()
    black_box = systems.StepPlant(
        lambda x, u: known.step(torch.from_numpy(x), torch.from_numpy(u)).numpy(), dim=4, inputs=1, dt=0.03
    ).linearisation()
    torch.testing.assert_close(at.matrix, black_box.matrix, rtol=0, atol=1e-7)
    torch.testing.assert_close(at.input_matrix, black_box.input_matrix, rtol=0, atol=1e-7)
    # Another integrator: near, of the order of the timestep.
    torch.testing.assert_close(at.matrix, by_differences.linearisation().matrix, rtol=0, atol=1e-2)


def test_pole_on_a_cart_rests_in_spite_of_a_leaning_gravity_and_is_held_for_its_period() -> None:
    for integrator in ("implicitfast", "RK4"):
        plant = pole(integrator, dt=0.05)
        lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=1))
        assert adp.held_stability(lqr, plant, 0.05, at=plant.equilibrium()).spectral_radius < 1
        x0 = torch.tensor([[0.1, 0.15, 0.0, 0.0], [0.0, 2 * math.pi - 0.1, 0.0, 0.0]], dtype=torch.float64)
        run = adp.simulate(adp.Feedback(lqr), plant, lqr.cost, x0, steps=300, compile=False)
        assert float(lqr.cost.deviation(run.state[:, -1]).abs().max()) < 1e-3


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("nowhere.xml", r"`MujocoPlant\(model=...\)` cannot be read \(.*nowhere.xml"),
        (FLOATING, r"must have hinges and slides alone.*mjJNT_FREE"),
    ],
)
def test_models_that_are_no_plant_are_refused(model: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        systems.MujocoPlant(model)


SOLVED = {
    "InvertedPendulum-v5": ("inverted_pendulum.xml", 0.04),
    "InvertedDoublePendulum-v5": ("inverted_double_pendulum.xml", 0.05),
}


@pytest.mark.parametrize("name", list(SOLVED))
def test_pendulums_of_gymnasium_stand_for_a_whole_episode(name: str) -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
    pytest.importorskip("gymnasium.envs.mujoco", reason="needs gymnasium[mujoco]")
    from gymnasium.envs import mujoco as folder

    file, dt = SOLVED[name]
    plant = systems.MujocoPlant(f"{folder.__path__[0]}/assets/{file}", dt=dt)
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=plant.dim, inputs=1))
    env = gymnasium.make(name)
    env.reset(seed=0)
    data, over, steps = env.unwrapped.data, False, 0
    while not over:
        x = torch.from_numpy(np.concatenate((data.qpos, data.qvel)))
        _, _, terminated, truncated, _ = env.step(lqr(x).numpy())
        steps, over = steps + 1, terminated or truncated
    assert (steps, terminated) == (1000, False)
