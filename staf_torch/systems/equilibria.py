"""Equilibria of a plant: the input that holds it at a state, and the equilibrium nearest to a guess."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes.gradients import refuse_gradient
from ..lanes.per_row.decisions import in_any_row
from ..lanes.per_row.objects import by_rows
from ..numerics.checks import number, object_of
from ..numerics.derivatives import central_slopes
from ..signs import Sign
from .base import Plant

_REST = 1e-6  # of the fastest rate of the linearisation, below which a plant counts as resting
_STEPS = 50


def check_rest(plant: Plant, x: Tensor, u: Tensor) -> None:
    """Refuse a state (n,) and an input (m,) at which the plant moves, by more than 1e-6 of its rates
    there, with its value and the nearest equilibrium."""
    if _rests(plant, x, u):
        return
    moves = _motion(plant, x, u)
    name, nearest = type(plant).__name__, _nearest(plant, x, u)
    if not bool((x != 0).any() or (u != 0).any()) and hasattr(plant, "drift"):
        raise ValueError(
            f"`{name}.drift` must be 0 at the origin, the state to regulate to; got {moves.tolist()}. "
            "Say where the plant rests by `equilibrium` and `resting_input`, or by a set-point of the cost. "
            f"{nearest}"
        )
    raise ValueError(
        f"{name} does not rest at the state {x.tolist()} under the input {u.tolist()}: it moves by "
        f"{moves.tolist()}. Choose a set-point at which an admissible input holds it. {nearest}"
    )


def _nearest(plant: Plant, x: Tensor, u: Tensor) -> str:
    """A sentence on the nearest equilibrium, with numbers and the call that returns it."""
    try:
        rest = find_equilibrium(plant, x, u)
    except ValueError:
        return "None is near it."
    away = float((rest.state - x).norm())
    return (
        f"The nearest one is {away:.3g} away, the state {rest.state.tolist()} under the input "
        f"{rest.input.tolist()}: `rest = systems.find_equilibrium(plant, {x.tolist()})`, then "
        "`target=rest.state, target_input=rest.input` of the cost."
    )


def resting_input_at(plant: Plant, x: Tensor, guess: Tensor | None = None) -> Tensor:
    """Return the input (m,) that comes nearest to holding the plant at x (n,), by Gauss-Newton steps from
    a guess, by default the plant's resting input."""
    u = plant.resting_input() if guess is None else guess
    return _gauss_newton(lambda v: _motions(plant, x.expand(len(v), -1), v), u)


class Equilibrium(NamedTuple):
    """A state and an input that holds a plant there.

    Example:
        >>> systems.find_equilibrium(systems.Pendulum(), [0.0, 0.0]).input
        tensor([0.], dtype=torch.float64)

        Shown by `staf_torch/adp/README.md`.
    """

    state: Tensor  # (n,)
    input: Tensor  # (m,)


@Sign("find_equilibrium")
@by_rows
def find_equilibrium(
    plant: Plant, x: Sequence[float] | Tensor, u: Sequence[float] | Tensor | None = None
) -> Equilibrium:
    """A state and an input at which the plant rests, near a guess: a set-point of a plant that was learnt,
    which never rests exactly where it should.

    The input alone moves first, as far as that serves; then state and input together, by the smallest
    Gauss-Newton steps, so that a plant with many equilibria keeps to the one nearby.

    Example:
        >>> learnt = systems.RatePlant(lambda x, u: 1e-3 - x.sin() + 0.1 * u, dim=1, inputs=1)
        >>> rest = systems.find_equilibrium(learnt, [0.1])
        >>> cost = adp.QuadraticCost(1.0, 1.0, 1, 1, target=rest.state, target_input=rest.input)

        Shown by `staf_torch/adp/README.md`.

    Args:
        plant: the plant.
        x: the guess of the state, (n,).
        u: the guess of the input, (m,); by default the resting input of the plant.

    Raises:
        ValueError: if there is none near the guess; the message says which coordinate keeps moving.
    """
    object_of("find_equilibrium", Plant, plant=plant)
    refuse_gradient("find_equilibrium", plant=plant, x=x, u=u)
    x = _guess("x", x)
    u = plant.resting_input() if u is None else _guess("u", u)
    held = resting_input_at(plant, x, u)
    if bool(torch.isfinite(held).all()) and _rests(plant, x, held):
        return Equilibrium(x, held)
    size = len(x)
    z = _gauss_newton(lambda v: _motions(plant, v[:, :size], v[:, size:]), torch.cat((x, u)))
    if bool(torch.isfinite(z).all()) and _rests(plant, z[:size], z[size:]):
        return Equilibrium(z[:size], z[size:])
    moves = _motion(plant, x, u)
    worst = int(moves.abs().argmax())
    raise ValueError(
        f"{type(plant).__name__} has no equilibrium near the guess, the state {x.tolist()} and the input "
        f"{u.tolist()}: state {worst} keeps moving, by {float(moves[worst]):.6g}. Give a better "
        "`equilibrium=(state, input)`."
    )


def _guess(name: str, value: Sequence[float] | Tensor) -> Tensor:
    guess = torch.as_tensor(value, dtype=torch.float64, device=getattr(value, "device", "cpu"))
    number("find_equilibrium", name, guess)
    return guess


def _gauss_newton(motions: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """Solve motion = 0 by the smallest Gauss-Newton steps from z (k,): rows (B, k) -> (B, n)."""
    going = torch.ones_like(z[:1], dtype=torch.bool)  # of a row of `torch.func.vmap` its own
    for _ in range(_STEPS):
        slopes, moves = central_slopes(motions, z), motions(z.unsqueeze(0))[0]
        step = torch.linalg.lstsq(slopes, -moves.unsqueeze(-1), driver="gelsd").solution[:, 0]
        z = torch.where(going, z + step, z)
        going = going & torch.isfinite(z).all() & (step.norm() > 1e-14 * (1 + z.norm()))
        if not in_any_row(going):
            break
    return z


def _rests(plant: Plant, x: Tensor, u: Tensor) -> bool:
    moves, size = _motion(plant, x, u), len(x)
    slopes = central_slopes(lambda v: _motions(plant, v[:, :size], v[:, size:]), torch.cat((x, u)))
    largest = slopes.abs().max().clamp(min=1e-3)  # change of the motion per unit of state or input
    return bool((moves.abs() <= _REST * largest).all())


def _motions(plant: Plant, x: Tensor, u: Tensor) -> Tensor:
    with torch.no_grad():
        try:
            return plant.motion(x, u)
        except RuntimeError as error:
            if "dtype" not in str(error) or x.dtype != torch.float64:
                raise
            raise ValueError(
                f"{type(plant).__name__} cannot be evaluated in float64, which designs and checks need: "
                f"{error}. Call `.double()` of the plant, or cast inside it."
            ) from error


def _motion(plant: Plant, x: Tensor, u: Tensor) -> Tensor:
    return _motions(plant, x.unsqueeze(0), u.unsqueeze(0))[0]
