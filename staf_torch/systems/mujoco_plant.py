"""A model of MuJoCo as a plant: many rows a call, linearised by MuJoCo where it can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from ..numerics.checks import fail, integer, positive_real
from .base import Limit
from .black_box import Numbers
from .user_plants import Guess, StepPlant

_SLOPE = 1e-6  # by which `mjd_transitionFD` moves states and inputs, as its documentation advises


class MujocoPlant(StepPlant):
    """x+ after ``dt`` seconds of a MuJoCo model under a control that is held, x = (qpos, qvel, act).

    All rows of a batch are one call of `mujoco.rollout`. A row is a function of x and u alone: the solver of
    contacts begins cold. A row that MuJoCo had to reset (it does so where numbers explode) is NaN.

    Example:
        >>> plant = systems.MujocoPlant("cart_pole.xml", dt=0.02)  # doctest: +SKIP
        >>> adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=1)).k.shape  # doctest: +SKIP
        torch.Size([1, 4])

        Shown by `staf experiment=adp system=mujoco system.model=x.xml adp/policy=lqr`.

    The linearisation is that of `mjd_transitionFD`, chained over the steps of a period; with the integrator
    RK4, for which MuJoCo has none, central differences of the period, all probes in one call.

    Args:
        model: path of an XML file, XML text, or a `mujoco.MjModel`. Its joints must be hinges and slides.
        dt: s, for which a control is held, a multiple of the model's timestep; None for one timestep.
        equilibrium: as in `StepPlant`; by default a guess at the model's `qpos0`, at rest.
        periodic: coordinates that are angles; by default the hinges without limits.
        low, high: of the inputs; by default the ranges of the actuators that are limited.
        threads: on which the rows of a call are simulated; the result is the same for any number.

    Raises:
        ValueError: if the model cannot be read, has a free or ball joint, no actuator or a state beyond
            (qpos, qvel, act), or as in `StepPlant`.
        ImportError: if MuJoCo is not installed (the extra ``mujoco``).
    """

    def __init__(
        self,
        model: object,
        *,
        dt: float | None = None,
        equilibrium: Guess = None,
        periodic: Sequence[int] | None = None,
        low: Limit = None,
        high: Limit = None,
        threads: int = 1,
    ) -> None:
        mujoco = _mujoco()
        read = _read(mujoco, model)
        _check(mujoco, read)
        simulation = _Simulation(read, _frames(read, dt), integer("MujocoPlant", "threads", threads, least=1))
        limited = read.actuator_ctrllimited.astype(bool)
        if low is None and high is None and limited.any():
            low = np.where(limited, read.actuator_ctrlrange[:, 0], -np.inf).tolist()
            high = np.where(limited, read.actuator_ctrlrange[:, 1], np.inf).tolist()
        free = (read.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)) & ~read.jnt_limited.astype(bool)
        at_rest = [*read.qpos0.tolist(), *[0.0] * (read.nv + read.na)]
        super().__init__(
            simulation,
            dim=read.nq + read.nv + read.na,
            inputs=read.nu,
            dt=simulation.frames * float(read.opt.timestep),
            periodic=np.flatnonzero(free).tolist() if periodic is None else periodic,
            equilibrium=at_rest if equilibrium is None else equilibrium,
            low=low,
            high=high,
            slopes=None if read.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4) else simulation.slopes,
        )
        self.model = read


class _Simulation:
    """Simulate a period of the model for rows of states and controls."""

    def __init__(self, model: Any, frames: int, threads: int) -> None:
        from mujoco import MjData, rollout

        self.model, self.frames, self._rollout = model, frames, rollout.rollout
        self.data = [MjData(model) for _ in range(threads)]
        self._followers: list[Any] = []  # for each row a simulation, its inputs and its warm start

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_followers": []}

    def __call__(self, x: Numbers, u: Numbers) -> Numbers:
        """x+: (B, n), (B, m) -> (B, n)."""
        if isinstance(x, torch.Tensor):
            raise TypeError("MuJoCo takes NumPy arrays")
        rows = len(x)
        began = np.ones((rows, 1 + x.shape[1]))  # the time, 1 s, and then the state
        began[:, 1:] = x
        control = np.empty((rows, self.frames, u.shape[1]))
        control[:] = u[:, None]
        found = np.empty((rows, self.frames, began.shape[1]))
        self._rollout(
            [self.model] * rows,
            self.data,
            began,
            control,
            skip_checks=True,  # of shapes, which are right: they took as long as a simulation
            nstep=self.frames,
            initial_warmstart=np.zeros((rows, self.model.nv)),
            state=found,
            persistent_pool=len(self.data) > 1,
        )
        after: Numbers = found[:, -1, 1:].copy()
        after[found[:, -1, 0] <= 1] = np.nan  # a reset begins the clock anew at 0
        return after

    def follow_feedback(
        self, x: Numbers, feedback: Callable[[Numbers], Numbers], steps: int
    ) -> tuple[Numbers, Numbers] | None:
        """`BlackBox.follow`: a simulation a row that goes on, which no period sets up anew. The same bits."""
        if len(self.data) > 1:
            return None  # rows of a period side by side
        mujoco, model = _mujoco(), self.model
        kind, rows = int(mujoco.mjtState.mjSTATE_FULLPHYSICS), len(x)
        while len(self._followers) < rows:
            data = mujoco.MjData(model)
            self._followers.append((data, data.ctrl, data.qacc_warmstart))
        followers = self._followers[:rows]
        found = np.empty((steps + 1, rows, 1 + x.shape[1]))
        found[0, :, 0], found[0, :, 1:] = 1.0, x  # the time, 1 s, and then the state
        applied = np.empty((steps, rows, model.nu))
        for (data, _, _), began in zip(followers, found[0], strict=True):
            mujoco.mj_resetData(model, data)
            mujoco.mj_setState(model, data, began, kind)
        step, read, frames = mujoco.mj_step, mujoco.mj_getState, self.frames
        for k in range(steps):
            applied[k] = feedback(found[k, :, 1:])
            for (data, control, warm), u, after in zip(followers, applied[k], found[k + 1], strict=True):
                control[:], warm[:] = u, 0.0
                step(model, data, frames)
                read(model, data, after, kind)
        # A reset begins the clock anew at 0: from there on a row is lost.
        lost = np.logical_or.accumulate(~(found[1:, :, 0] > found[:-1, :, 0]), axis=0)
        found[1:][lost] = np.nan
        return found[:, :, 1:].swapaxes(0, 1), applied.swapaxes(0, 1)

    def slopes(self, x: Numbers, u: Numbers) -> tuple[Numbers, Numbers]:
        """dx+/dx and dx+/du at one point (n,), (m,)."""
        mujoco, model, data = _mujoco(), self.model, self.data[0]
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.act[:] = np.split(x, (model.nq, model.nq + model.nv))
        data.ctrl[:] = u
        n, m = len(x), len(u)
        whole, pushed = np.eye(n), np.zeros((n, m))
        for _ in range(self.frames):
            a, b = np.zeros((n, n)), np.zeros((n, m))
            mujoco.mjd_transitionFD(model, data, _SLOPE, True, a, b, None, None)
            mujoco.mj_step(model, data)
            whole, pushed = a @ whole, a @ pushed + b
        return whole, pushed


def _mujoco() -> ModuleType:
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("MujocoPlant needs MuJoCo: pip install 'staf_torch[mujoco]'.") from error
    return mujoco  # type: ignore[no-any-return]


def _read(mujoco: ModuleType, model: object) -> Any:
    if isinstance(model, mujoco.MjModel):
        return model
    if not isinstance(model, str | Path):
        raise fail("MujocoPlant", "model", "must be the path of an XML file, XML text or an MjModel", model)
    text = str(model)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjModel.from_xml_string(text)
        return mujoco.MjModel.from_xml_path(text)
    except ValueError as error:
        said = " ".join(str(error).split())
        raise fail("MujocoPlant", "model", f"cannot be read ({said})", text[:80]) from error


def _check(mujoco: ModuleType, model: Any) -> None:
    turning = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    for index, kind in enumerate(model.jnt_type):
        if int(kind) not in turning:
            name = model.joint(index).name or index
            rule = "must have hinges and slides alone: quaternions are no coordinates of a regulator"
            raise fail("MujocoPlant", "model", rule, f"the joint {name}, {mujoco.mjtJoint(int(kind)).name}")
    if not model.nu:
        raise fail("MujocoPlant", "model", "must have an actuator", "none")
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    if size != 1 + model.nq + model.nv + model.na:
        rule = "must have no state beyond (qpos, qvel, act), as delays and plugins have"
        raise fail("MujocoPlant", "model", rule, f"{size - 1 - model.nq - model.nv - model.na} more numbers")


def _frames(model: Any, dt: float | None) -> int:
    if dt is None:
        return 1
    step = float(model.opt.timestep)
    count = round(positive_real("MujocoPlant", "dt", dt) / step)
    if count < 1 or abs(count * step - dt) > 1e-9 * dt:
        raise fail("MujocoPlant", "dt", f"must be a multiple of the model's timestep of {step:g} s", dt)
    return count
