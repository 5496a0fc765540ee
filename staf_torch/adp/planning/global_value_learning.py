"""Fill the memory of a global value: optimal trajectories from everywhere, each helping the others."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.gradients import without_gradient
from ...lanes.per_row.decisions import numbers_of_rows
from ...lanes.per_row.objects import refuse_rows
from ...lanes.row_numbers import some_rows
from ...lanes.torch_compile.operators import opaque
from ...numerics.checks import fail, integer, real
from ...signs import Sign
from ...systems import Plant
from ...systems.base import spread_of
from ..problem.sampled import SampledProblem
from .ddp import BoxDDP
from .global_value import GlobalValue, check_memorable, half_widths
from .trajectories import Reference, Trajectories, chosen, held_controls, rows_of

_log = logging.getLogger(__name__)
_HELD = 10  # steps for which a random first control is held
_PREFIXES = (2, 4, 7, 11, 16, 22, 30)  # steps for which a corner of the bounds is held before a plan
_WORTH = 0.01  # relative gain of cost for which a state's trajectory is kept
_BEST = 3  # guesses of a state from which it is optimised
_STEPS = (60, 480)  # of a trajectory, at least and at most
_PROBED, _LATE = 24, 0.1  # states from which plans are tried, and the share of them that may be late
_ARRIVED = 1e-2  # share of a trajectory's cost that may be left at its end
_ENOUGH = 0.97  # share of fresh states known to 1 %
_SEED = 7


class Guesses(NamedTuple):
    """First controls for trajectories."""

    owner: Tensor  # index of the state that each is for, (G,)
    control: Tensor  # (G, T, m)
    reference: Reference


@opaque
@without_gradient("learn_global_value", "problem")
@Sign("learn_global_value")
def learn_global_value(
    problem: SampledProblem,
    region: Sequence[float] | Tensor,
    *,
    steps: int,
    trajectories: int = 150,
    rounds: int = 4,
    states: int = 400,
    seed: int = 0,
    candidates: int = 48,
    lookahead: int = 60,
    enough: float = 1.0,
) -> GlobalValue:
    """Fill a memory with optimal trajectories until it knows the box goal +- region.

    1. Trajectories from uniform states, optimised from no control and from two random ones.
    2. A sweep: each is optimised again from the plans that the memory finds for it in the others, followed
       by their feedback, also after holding a corner of the bounds for a while; the better one is kept.
    3. Rounds: at fresh states the memory's own cost is compared with what such a sweep finds, and where the
       optimum is more than 1 % lower the trajectory joins the library. Then another sweep.

    Every round says in the log what share of the fresh states was known to 1 %. At the end the log warns with
    the share of trajectories that do not arrive at the goal within ``steps``: the memory leaves them out, and
    where no other covers the states that they begin from, ``value`` is inf there.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> memory = adp.learn_global_value(problem, [1.5, 1.0], steps=80)  # doctest: +SKIP
        >>> memory(torch.tensor([[0.9, 0.0]]).double()).shape  # doctest: +SKIP
        torch.Size([1, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps.
        region: half the width of the box of states, (n,).
        steps: T of a trajectory: enough to reach the goal from everywhere.
        trajectories: of the first library.
        rounds: of fresh states.
        states: of a round.
        seed: of the states and the random controls.
        candidates: as in `GlobalValue`, and so is ``lookahead``.
        enough: share of fresh states known to 1 % at which no further round begins, in (0, 1].

    Raises:
        ValueError: if an argument breaks its rule, or no trajectory arrives at the goal.
    """
    if not 0 < real("learn_global_value", "enough", enough) <= 1:
        raise fail("learn_global_value", "enough", "must be in (0, 1]", enough)
    refuse_rows("learn_global_value", problem=problem)
    check_memorable("learn_global_value", problem)
    integer("learn_global_value", "trajectories", trajectories, least=2)
    integer("learn_global_value", "rounds", rounds, least=0)
    integer("learn_global_value", "states", states, least=1)
    generator = torch.Generator().manual_seed(integer("learn_global_value", "seed", seed, least=0))
    width = half_widths("learn_global_value", region, problem.dim)
    search = BoxDDP(problem, steps=steps, iterations=40, tolerance=1e-5)

    def memory(library: Trajectories) -> GlobalValue:
        return GlobalValue(problem, library, width, candidates=candidates, lookahead=lookahead)

    def drawn(count: int) -> Tensor:
        uniform = torch.rand(count, problem.dim, generator=generator, dtype=torch.float64, device="cpu")
        return problem.goal + width.to(problem.goal) * (2 * uniform.to(problem.goal) - 1)

    library = swept(memory(_first(search, drawn(trajectories), generator)), search)
    with Sign("", rounds, "rounds") as sign:
        for round_ in range(rounds):
            known = memory(library)
            x = drawn(states)
            before = known.choose(x).value
            found = best_from(known, search, x)
            better = before - found.cost > _WORTH * found.cost
            share = float((~better).double().mean())
            _log.info("round %d: %.1f %% of %d fresh states known to 1 %%", round_ + 1, 100 * share, states)
            both = (torch.cat((old, new[better])) for old, new in zip(library, found, strict=True))
            library = swept(memory(Trajectories(*both)), search)
            sign.advance()
            if share >= enough:
                break
    known = memory(library)
    late = int((~known.arrives).sum())
    if late:
        _log.warning(
            "learn_global_value: %d of %d trajectories do not arrive at the goal within %d steps and are "
            "left out. Give more `steps`, or a smaller `region` if the bounds allow no more.",
            *(late, len(known.arrives), steps),
        )
    return known


def swept(memory: GlobalValue, search: BoxDDP) -> Trajectories:
    """The library of a memory, each trajectory optimised again from what the others know."""
    library = memory.library
    own = torch.arange(len(library.cost), device="cpu")
    found = best_from(memory, search, library.state[:, 0], own)
    return chosen(found.cost < library.cost, found, library)


def best_from(memory: GlobalValue, search: BoxDDP, x: Tensor, own: Tensor | None = None) -> Trajectories:
    """Return the best trajectories from x (B, n) that the search reaches from plans of the memory;
    ``own`` (B,) is a trajectory for each state that must not help it."""
    guesses = _guesses(memory, search.steps, x, own)
    with some_rows(guesses.owner):
        found = search.solve(x[guesses.owner], guesses.control, guesses.reference)
    order = found.cost.argsort(descending=True, stable=True)
    best = torch.empty(len(x), dtype=torch.int64, device=x.device)
    best[guesses.owner[order]] = order  # the last one written is the cheapest
    return rows_of(found, best)


def _first(search: BoxDDP, x: Tensor, generator: torch.Generator) -> Trajectories:
    """Optimised from the control at rest, and from two that jump between the bounds."""
    problem, steps = search.problem, search.steps
    levels, shape = problem.levels(), (2 * len(x), -(-steps // _HELD))
    random = levels[torch.randint(len(levels), shape, generator=generator, device="cpu")].repeat_interleave(
        _HELD, 1
    )
    still = problem.rest.expand(len(x), steps, -1)
    found = search.solve(x.repeat(3, 1), torch.cat((still, random[:, :steps])))
    best = found.cost.unflatten(0, (3, -1)).argmin(0)
    return rows_of(found, best * len(x) + torch.arange(len(x), device=x.device))


def _guesses(memory: GlobalValue, steps: int, x: Tensor, own: Tensor | None) -> Guesses:
    """The cheapest plans, `_BEST` a state: followed at once, or after a control was held for a while."""
    problem = memory.problem
    entries = memory.nearest(x, own)
    cost, _, _ = memory.follow(x, entries)
    count = min(_BEST, cost.shape[1])
    least, at = cost.topk(count, 1, largest=False)
    plans = [
        (least[:, k], 0, problem.rest, entries.gather(1, at[:, k : k + 1]).squeeze(1), x)
        for k in range(count)
    ]
    for length in (length for length in _PREFIXES if length < steps):
        for u in problem.levels():
            after, paid = x, torch.zeros_like(x[:, 0])
            for _ in range(length):
                after, now = problem.advance(after, u.expand(len(x), -1))
                paid = paid + now
            then = memory.choose(after, own)
            plans.append((paid + then.value, length, u, then.entry, after))
    chosen = torch.stack([plan[0] for plan in plans], dim=1).topk(count, 1, largest=False).indices
    parts = []
    for k, (_, length, u, entry, after) in enumerate(plans):
        rows = (chosen == k).any(1).nonzero().squeeze(1)
        control, reference = memory.replay(after[rows], entry[rows], steps - length)
        held = u.expand(len(rows), length, -1)
        state = torch.cat((reference.state[:, :1].expand(-1, length, -1), reference.state), dim=1)
        none = torch.zeros_like(reference.feedback[:, :1]).expand(-1, length, -1, -1)
        feedback = torch.cat((none, reference.feedback), dim=1)
        parts.append((rows, torch.cat((held, control), dim=1), state, feedback))
    owner, control, state, feedback = (torch.cat(part) for part in zip(*parts, strict=True))
    return Guesses(owner, control, Reference(state, feedback))


def best_held(search: BoxDDP, x: Tensor) -> Trajectories:
    """The cheapest trajectories from x (B, n) that a search reaches from the linear feedback of the goal, and
    from each corner of the bounds, held for 2 to 30 periods before it."""
    return held_plans(search, x, 1)[0]


def held_plans(search: BoxDDP, x: Tensor, best: int) -> list[Trajectories]:
    """The cheapest of these trajectories, the next ones, ...: so many."""
    if search.problem.unregulated:  # which has several of its own
        return [search.solve(x)]
    begun = numbers_of_rows(lambda: held_controls(search.problem, search.steps)).numbers  # (B or 1, G, ...)
    count, b = begun[0].shape[1], len(x)
    control, feedback = (each.expand(b, *each.shape[1:]).transpose(0, 1).flatten(0, 1) for each in begun)
    goal = search.problem.goals(x, search.steps)[:, :-1]
    with some_rows(torch.arange(b, device="cpu").repeat(count)):
        found = search.solve(x.repeat(count, 1), control, Reference(goal.repeat(count, 1, 1), feedback))
    cost = torch.where(torch.isfinite(found.cost), found.cost, torch.inf).view(count, b)
    order = cost.argsort(dim=0, stable=True)[:best]
    return [rows_of(found, first * b + torch.arange(b, device="cpu")) for first in order]


def box_of(plant: Plant, dim: int) -> Tensor:
    """Half the width of a plant's box: its ``spread``, and of its angles all of them: (n,)."""
    width = torch.ones(dim, dtype=torch.float64, device="cpu")
    spread = spread_of(plant, width)
    width *= spread if isinstance(spread, Tensor) and spread.dim() else float(spread)
    width[list(plant.periodic)] = math.pi
    return width


def global_value_of(problem: SampledProblem, width: Tensor, steps: int) -> GlobalValue:
    """Return the global value of the box of half widths (n,), in seconds for two states and up to some
    minutes for four; trajectories have twice as many steps where fewer than nine of ten arrive.

    Raises:
        ValueError: if no trajectory arrives.
    """
    count = _enough_steps(problem, width, min(max(steps, _STEPS[0]), _STEPS[1] // 2))
    if problem.dim > 2:
        trajectories, rounds, candidates, lookahead = 120, 4, 48, 60
    else:
        trajectories, rounds, candidates, lookahead = 80, 3, 24, 40
    return learn_global_value(
        problem,
        width,
        steps=count,
        trajectories=trajectories,
        rounds=rounds,
        states=100,
        seed=_SEED,
        candidates=candidates,
        lookahead=lookahead,
        enough=_ENOUGH,
    )


def _enough_steps(problem: SampledProblem, width: Tensor, steps: int) -> int:
    """Steps in which nine of ten plans arrive at the goal; else the most."""
    generator = torch.Generator().manual_seed(_SEED)
    uniform = torch.rand(_PROBED, problem.dim, dtype=torch.float64, generator=generator, device="cpu")
    x0 = problem.goal + width * (2 * uniform - 1)
    while steps < _STEPS[1]:
        found = best_held(BoxDDP(problem, steps=steps, iterations=40, tolerance=1e-5), x0)
        late = found.value[:, -1] > _ARRIVED * found.cost
        if float(late.double().mean()) <= _LATE:
            break
        steps = min(2 * steps, _STEPS[1])
    return steps
