"""A filter that keeps h(x, t) >= 0 whatever the policy behind it wants: control barrier functions, held."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ...lanes import compiled, repeat, where_rows
from ...lanes.gradients import gradients_of, marked
from ...lanes.per_row.decisions import DecidedByRows, of_first
from ...lanes.per_row.kinds import kinds_of_rows, of_kinds, whichever
from ...lanes.threads import small
from ...numerics.checks import fail, one_or_each, positive, positive_real, trailing
from ...numerics.default_device import beside, device_of
from ...numerics.repr_text import limits, shown
from ...systems import Bounds, Plant
from ...systems.base import Limit
from ..loop.controller import Carried, Controller, Feedback, Policy
from ..loop.result import LoopResult
from ..problem.rules import check_plant
from .conditions import Conditions, Constraint, Lean, check_traceable, listed
from .look_ahead import LookAhead
from .quadratic_program import cases, nearest_admissible, sides_of

_log = logging.getLogger(__name__)
INFEASIBLE = 1e-6  # slack, in units of the input, from which on a row counts as infeasible
_PASSES, _MOST = 2, 8  # linearisations at least, the first at the wanted control; at most, until all is met
_SOLVED = 1e-6  # of what a wanted control misses, at which it is
_UNKNOWN = (
    "`SafetyFilter`: constraint %s is NaN at some of the states around the equilibrium that were tried."
)
_OPPOSED = (
    "`SafetyFilter`: this filter may fail to keep constraint %s: %s. To keep it, plan instead: "
    "`AvoidanceCost` with `RecedingHorizon`, see adp/safety/README.md. Why: braking along constraint %s "
    "drives the rest of the plant away, at %s 1/s near its equilibrium (a coordinate that must first move "
    "the wrong way)."
)
_FOLLOWS = (
    "the policy is left alone wherever it stays inside by itself, and what it cannot keep is `infeasible`"
)
_TOPPLES = "the filter acts all the same: where a policy with a memory would lead is not known"
_FOLLOWING, _BRAKING = 1000.0, 50.0  # steps of a feedback law that a control takes with such a look ahead
_SLACK = 1e-9  # in units of the input, from which on the brakes are asked whether they do


class Filtered(NamedTuple):
    """Result of a filter at states x."""

    control: Tensor  # (..., m)
    margin: Tensor  # h of every constraint now, (..., k)
    slack: Tensor  # (...) how much further u would have to reach, in its (weighted) units; 0: all is kept
    astray: Tensor  # (...) 1 where braking along the edge is no way, and the policy was followed ahead


class Watched(NamedTuple):
    """Carried state of a `SafetyFilter`; all but the first are recorded by these names."""

    inner: Carried  # of the controller behind it
    filtered_steps: Tensor  # (B,)
    least_margin: Tensor  # smallest h so far, (B,)
    largest_slack: Tensor  # (B,)
    acted: Tensor  # steps with another control than the wanted one, (B,)
    astray: Tensor  # steps in which the barrier's condition was no guide, (B,)


class SafetyFilter(Controller, DecidedByRows):
    """The control nearest to what a policy wants that keeps h_i(x, t) >= 0:

        min |u - policy(x)|^2 over low <= u <= high with
        phi_i(x(t + dt; u), t + dt) >= e^(-decay_i dt) phi_i(x, t),
        phi = h (relative degree one),  phi = h' + decay h (relative degree two, h' along the plant).

    That is the exponential control barrier function of a control that is held: x(t + dt; u) is the plant
    itself, by Runge-Kutta steps, linearised in u where it was found, until what u must satisfy it satisfies.
    What phi dips between the samples is kept as a margin, so that h stays positive in between too. In the
    limit of a short hold the condition is phi' >= -decay phi. The quadratic program is solved exactly.

    Where phi < 0 <= h the condition promises nothing: the constant deceleration that stops at the edge,
    h'^2 / 2h, is asked for as well. Where bounds limit the inputs, the speed at the end of the hold must be
    one that they can stop: h'^2 <= 2 a h where the largest h'' = a is one number; else, from where it matters
    on, the hardest brake is followed until nothing comes nearer. What cannot be kept gets the control of the
    smallest violation.

    Where braking along an edge drives the rest of the plant away (an unstable zero: the coordinate must first
    move the wrong way) that is logged at construction with its rate. The policy is then followed ahead for up
    to 300 periods in place of the brakes: it is left alone where it comes back inside, and else the control
    is chosen after which it does with the least time integral of h < 0; `astray` marks these rows. A
    controller that remembers is not followed. To plan with `AvoidanceCost` is better there.

    A wanted control that satisfies everything is applied bit for bit. Bounds are hard; where they and the
    constraints contradict each other, the bounds hold, the squares of what is missing are least, and `slack`
    says how much is missing: positive wherever h < 0 or will be.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
        >>> wall = adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] + 0.1, dt=0.01, low=-3.0, high=3.0)
        >>> x0 = torch.tensor([[2.0, -1.0]]).double()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> run = adp.simulate(wall, plant, cost, x0, steps=60)
        >>> wall.report(run)["constraint_violations"], wall.report(run)["infeasible"]
        (0, [])

        Shown by `staf experiment=avoidance`.

    Args:
        policy: u from x, (..., n) -> (..., m), or a controller, also one that learns.
        plant: in continuous time, torch all through: the model that the filter believes.
        constraints: h, or a list of them, twice differentiable. h sees states (B, n) and one time as a
            tensor (), and returns (B,); it runs under `torch.func.vmap`.
        dt: s, for which a control is held; `simulate` takes it over.
        low, high: of the inputs, as in `systems.Bounds`; both None for those of the plant.
        decay: 1/s, one number or one a constraint: how fast h may fall. Large ones let the policy come nearer
            to the edge, and need larger controls there. At most 1/dt where the relative degree is two. None:
            1/(5 dt), or less where the relative degree is two and bounds limit the brakes: sqrt(2 a / h) at
            a usual h > 0 around the equilibrium, from where what is admitted can just be stopped.
        degree: 1 or 2 a constraint, or None: found by trying states around the equilibrium.
        margin: in units of h, one number or one a constraint: h >= margin is kept.
        weight: of the squares of u - policy(x), positive, one an input; all 1 by default.

    Raises:
        ValueError: if an argument breaks its rule, a constraint returns another shape, or u moves neither its
            first nor its second derivative.

    Source: Ames et al., "Control barrier functions: theory and applications", ECC (2019); Nguyen and
    Sreenath, "Exponential control barrier functions", ACC (2016), for degree two; Gurriet et al., IEEE Access
    (2020), for what a backup law keeps.
    """

    rowwise: ClassVar = {
        "forward": (1, 0),
        "restrain": (1, 1, 0),
        "margins": (1, 0),
        "inequalities": (1, 1, 0),
    }

    @beside
    @small
    def __init__(
        self,
        policy: Policy | Controller,
        plant: Plant,
        constraints: Constraint | Sequence[Constraint],
        *,
        dt: float,
        low: Limit = None,
        high: Limit = None,
        decay: float | Sequence[float] | None = None,
        degree: int | Sequence[int] | None = None,
        margin: float | Sequence[float] = 0.0,
        weight: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        check_traceable("SafetyFilter", plant)
        check_plant(plant)
        own = Bounds(low, high, plant.inputs)
        self.bounds = plant.bounds if not own.present and plant.bounds is not None else own
        given = {"plant": plant, "constraints": constraints} if self.bounds.present else {}
        self.layers = gradients_of("SafetyFilter", **given)  # what brakes can do is a number
        with torch.no_grad():
            self.controller = policy if isinstance(policy, Controller) else Feedback(policy)
            self.plant, self.draws = plant, self.controller.draws
            self.hold = positive_real("SafetyFilter", "dt", dt)
            self.period = self.hold
            self.constraints = listed("SafetyFilter", constraints, plant)
            count = len(self.constraints)
            self.conditions = Conditions(
                plant, self.constraints, self.bounds, self.hold, decay, degree, margin
            )
            if self.conditions.unknown:
                _log.warning(_UNKNOWN, ", ".join(map(str, self.conditions.unknown)))
            self.degree, self.moving = self.conditions.degree, self.conditions.moving
            heavy = one_or_each("SafetyFilter", "weight", 1.0 if weight is None else weight, plant.inputs)
            positive("SafetyFilter", "weight", heavy)
            device = device_of(plant)
            self.register_buffer("unit", heavy.rsqrt().to(device))
            self.unit: Tensor  # (m,) of an input, in which distances are measured
            self.register_buffer("table", cases(count, *sides_of(self.bounds)).to(device))
            self.table: Tensor
            self.ahead = LookAhead(self.conditions, self._policy)
            if self.ahead.acts:
                self.work = (
                    _FOLLOWING if self.ahead.by_policy else (1.0 if self.conditions.apart else _BRAKING)
                )
            self.follows, self.opposed = self.ahead.by_policy, self.ahead.opposed
            self.kinds = nn.ModuleList()
            away = {k: float(of_first(rate)) for k, rate in enumerate(self.ahead.against) if bool(rate > 0)}
            if away:
                which, rates = ", ".join(map(str, away)), ", ".join(f"{rate:.3g}" for rate in away.values())
                _log.warning(_OPPOSED, which, _FOLLOWS if self.follows else _TOPPLES, which, rates)

    @classmethod
    def of_kinds(cls, filters: Sequence[SafetyFilter], rows: Sequence[Tensor], count: int) -> SafetyFilter:
        """Return the filter of B rows that are of several kinds, as their constraints and brakes are:
        ``filters`` of some rows (R,) each."""
        kinds = kinds_of_rows(filters, rows, count)
        made: SafetyFilter = of_kinds(kinds)
        for name in ("moving", "follows", "opposed"):
            setattr(made, name, any(getattr(each, name) for each in made.kinds))
        made.work = max(float(kind.object.work) for kind in kinds)
        return made

    def decide_alone(self) -> None:
        """Decide what rows had as numbers of their own, of a copy that has those of one row."""
        of, ahead = self.conditions, self.ahead
        if of.frail is None or ahead.frail is None:
            return
        of.weak, ahead.weak = tuple((of.frail > 0).tolist()), bool(ahead.frail > 0)
        of.frail = ahead.frail = None
        self.follows = ahead.by_policy = ahead.by_policy and ahead.weak
        if not self.follows:
            self.work = _BRAKING

    @property
    def decay(self) -> Tensor:
        """1/s, one a constraint."""
        return self.conditions.decay

    @property
    def _policy(self) -> Policy | None:
        """The policy, where it remembers nothing."""
        return self.controller.policy if isinstance(self.controller, Feedback) else None

    def __repr__(self) -> str:
        count = len(self.constraints)
        about = [f"around {self.controller.label}", repr(self.plant), f"held for {self.hold:g} s"]
        about += [f"{count} constraint{'s' if count != 1 else ''}", f"decay={shown(self.decay)} 1/s"]
        about += limits(self.bounds if self.bounds.present else None)
        return f"SafetyFilter({', '.join(about)})"

    @property
    def label(self) -> str:
        return f"filtered {self.controller.label}"

    def forward(self, x: Tensor, t: float | Tensor | None = None) -> Tensor:
        """u: (..., n) -> (..., m), of a policy without a state of its own.

        Args:
            x: (..., n).
            t: s, a number or (...); needed where a constraint depends on it.

        Raises:
            ValueError: if the time is missing, or the policy is a controller that remembers.
        """
        if not isinstance(self.controller, Feedback):
            raise fail(
                "SafetyFilter",
                "policy",
                "must be a function of x alone, to be evaluated at x",
                self.controller,
            )
        try:
            u = self.controller.policy(x)
        except Exception:
            trailing("SafetyFilter", "x", x, 1, self.plant.dim)
            raise
        return self.restrain(x, u, t).control

    @beside
    def restrain(self, x: Tensor, u: Tensor, t: float | Tensor | None = None) -> Filtered:
        """Return the control to apply in place of u: (..., n), (..., m).

        Args:
            x: (..., n).
            u: what the policy wants, (..., m).
            t: s, a number or (...).

        Raises:
            ValueError: if a constraint depends on the time, which is missing, or a shape is wrong.
        """
        plant = self.plant
        trailing("SafetyFilter", "x", x, 1, plant.dim)
        trailing("SafetyFilter", "u", u, 1, plant.inputs)
        if t is None and self.moving:
            raise fail("SafetyFilter", "t", "must be given: a constraint depends on the time", t)
        time = torch.as_tensor(0.0 if t is None else t, device=x.device).to(x).expand(x.shape[:-1])
        if self.follows:
            self._nearest.hasten()  # hundreds of periods are followed: seconds in plain torch
        try:
            z = torch.cat((x, u, time.unsqueeze(-1)), dim=-1)
        except RuntimeError as error:
            rule = f"must be of the rows of x, {tuple(x.shape[:-1])}"
            raise fail("SafetyFilter", "u", rule, tuple(u.shape[:-1])) from error
        found, k = self._nearest(z), len(self.constraints)
        control, margin, more = found.split((m := u.shape[-1], k, found.shape[-1] - m - k), dim=-1)
        astray = more[..., 1] if self.opposed else torch.zeros_like(time)
        return marked("SafetyFilter", self.layers, Filtered(control, margin, more[..., 0], astray))

    def init(self, x0: Tensor) -> Watched:
        trailing(type(self).__name__, "x0", x0, 2)
        none = x0.new_zeros(len(x0))
        return Watched(self.controller.init(x0), none, none + math.inf, *(none.clone() for _ in range(3)))

    def recorded(self, carried: Watched) -> dict[str, Tensor]:
        inner, *own = carried
        return {**self.controller.recorded(inner), **dict(zip(Watched._fields[1:], own, strict=True))}

    def step(self, x: Tensor, carried: Watched, uniform: Tensor, dt: float) -> tuple[Tensor, Watched]:
        if dt != self.hold:
            raise fail("SafetyFilter", "dt", f"must be that of the loop, {dt:g} s", self.hold)
        inner, steps, least, most, acted, astray = carried
        u, inner = self.controller.step(x, inner, uniform, dt)
        found = self.restrain(x, u, steps * self.hold)
        least, most = torch.minimum(least, found.margin.amin(-1)), torch.maximum(most, found.slack)
        acted = acted + (found.control != self.bounds.clip(u)).any(-1)
        return found.control, Watched(inner, steps + 1, least, most, acted, astray + found.astray)

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor | None:
        return self.controller.value(x, recorded)

    def margins(self, x: Tensor, t: float | Tensor = 0.0) -> Tensor:
        """h of every constraint: (..., n) and a number or (...) -> (..., k)."""
        return self.conditions.margins(x, t)

    def report(self, result: LoopResult) -> dict[str, Any]:
        """Report the constraints in a closed loop of this filter, over all of its steps.

        Returns:
            ``minimum_margin``, the smallest h over rows and times; ``constraint_violations``, the number of
            rows with h < 0 at a time; ``violated``, these rows; ``infeasible``, the rows for which at some
            time no admissible control was found that meets the conditions, which may still have kept h >= 0,
            and those outside; ``largest_slack``; ``slack``, the largest of each row; ``acted``,
            the share of the steps in which the control was another than the wanted one within the bounds;
            ``astray``, the rows in which the policy was followed ahead, as braking along the edge drives the
            plant away.
        """
        steps, least, most, acted, astray = (result[name][:, -1].detach() for name in Watched._fields[1:])
        last = self.margins(result.state[:, -1].detach(), steps * self.hold).amin(-1).detach()
        least = torch.minimum(least, last)
        return {
            "minimum_margin": float(least.min()),
            "constraint_violations": int((least < 0).sum()),
            "violated": (least < 0).nonzero().flatten().tolist(),
            "infeasible": ((most > INFEASIBLE) | (least < 0)).nonzero().flatten().tolist(),
            "largest_slack": float(most.max()),
            "slack": most.tolist(),
            "acted": float(acted.sum() / steps.sum()),
            "astray": (astray > 0).nonzero().flatten().tolist(),
        }

    def inequalities(self, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """a_i, c_i and h_i of the condition a_i'u >= c_i, linearised at u: (B, n), (B, m), (B,) ->
        (B, k, m), (B, k), (B, k)."""
        normal, least, margin = self.conditions.every(self.conditions.inequality, x, u, t)
        return normal[:, :, 0], least, margin

    @compiled("a safety filter")
    def _nearest(self, z: Tensor) -> Tensor:
        """u, margins, slack and astray of rows of (x, u, t): (..., n + m + 1) -> (..., m + k + 2)."""
        if z.dtype != self.unit.dtype:  # what is missing is a difference that float32 does not hold
            exact: Tensor = self._nearest.definition(z.to(self.unit.dtype))
            return exact.to(z.dtype)
        n, m = self.plant.equilibrium().numel(), self.plant.inputs
        if not z.numel():
            return z.new_zeros(*z.shape[:-1], m + len(self.constraints) + 1 + self.opposed)
        flat = z.reshape(-1, z.shape[-1])
        if len(self.kinds):
            none = flat.new_zeros(len(flat), m + len(self.constraints) + 2)
            kinds: list[Any] = list(self.kinds)
            found: Tensor = whichever(self.get_buffer("kind"), [each.nearest for each in kinds], flat, none)
            return found.reshape(*z.shape[:-1], -1)[..., : none.shape[-1] - 1 + self.opposed]
        x, wanted, t = flat[:, :n], flat[:, n : n + m], flat[:, n + m]
        low, high = self.bounds.low.to(x), self.bounds.high.to(x)
        unit, of = self.unit.to(x), self.conditions
        first = torch.minimum(torch.maximum(wanted / unit, low / unit), high / unit)
        at = torch.where((wanted >= low) & (wanted <= high), wanted, first * unit)
        shortfall, margin, strain = of.every(of.shortfall, x, at, t)
        asked = shortfall.amax(-1)
        u, slack = self._linearised(x, at, first, t, asked)
        astray, short = torch.zeros_like(slack), -margin.amin(-1)  # h < 0 is never well
        if self.ahead.acts:
            look = slack > _SLACK
            if not of.apart:
                look = look | self.ahead.asked(x, u, t, strain.amax(-1))
            if self.ahead.opposed:
                look = look | (asked > 0)
                astray = look.to(x)
            elif self.ahead.weak:
                look = t == t if self.ahead.frail is None else look | (self.ahead.frail > 0)
            chosen, left = self.ahead.choose(self._policy, (at, u, x, t), look)
            u = torch.where(look.unsqueeze(-1), chosen, u)
            # A barrier of degree two that the bounds cannot meet is no loss where the brakes do.
            forgiven = slack if 1 in self.degree and not self.ahead.opposed else torch.zeros_like(slack)
            slack = torch.where(look & (left == 0), forgiven, slack)
            short = torch.where(look, torch.maximum(short, -left), short)
        missing = where_rows(short > 0, self._lacking, (x, t, short), slack)
        slack = torch.where(short > 0, torch.maximum(slack, missing), slack)
        more = (slack, astray) if self.ahead.opposed else (slack,)
        found = torch.cat((u, margin, torch.stack(more, dim=-1)), dim=-1)
        return found.reshape(*z.shape[:-1], -1)

    def nearest(self, z: Tensor) -> Tensor:
        """`_nearest` in plain torch, of rows of this kind among others: (B, n + m + 1) -> (B, m + k + 2)."""
        found: Tensor = self._nearest.definition(z)
        return found if self.opposed else torch.cat((found, torch.zeros_like(found[:, :1])), dim=-1)

    def _linearised(
        self, x: Tensor, at: Tensor, first: Tensor, t: Tensor, asked: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The nearest u that meets the conditions, by lines at the u before, and what it misses."""
        unit, none, of = self.unit.to(x), torch.zeros_like(t), self.conditions
        low, high = self.bounds.low.to(x) / unit, self.bounds.high.to(x) / unit

        def linearise(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            u, best, slack, least, passes, _ = now
            normal, required, _ = self.inequalities(x, u, t)
            found = nearest_admissible(first, normal * unit, required, low, high, self.table)
            u, passes = found.point * unit, passes + 1
            missing, *_ = of.every(of.shortfall, x, u, t)
            left = missing.amax(-1)
            unmet = left > _SOLVED * asked
            # Where a line is a poor likeness: what is still missing, along its slope.
            length = self.hold * (normal * unit).square().sum(-1).sqrt()
            short = torch.where((missing > 0) & (length > 0), missing / length, torch.zeros_like(missing))
            reach = torch.maximum(found.shortfall, torch.where(unmet, short.amax(-1), none))
            better = (passes <= _PASSES) | (left < least)
            best = torch.where(better.unsqueeze(-1), u, best)
            slack, least = torch.where(better, reach, slack), torch.where(better, left, least)
            again = (passes < _PASSES) | (unmet & (passes < _MOST))
            return u, best, slack, least, passes, again

        start = at, at, none, none, none, asked > 0
        _, u, slack, *_ = repeat(_MOST, linearise, start, where=lambda now: now[5])
        return u, slack

    def _lacking(self, given: tuple[Tensor, ...]) -> Tensor:
        """Return what u lacks to win so much of h within the hold, more than `INFEASIBLE`."""
        x, t, short = given
        lean = Lean(*self.conditions.every(self.conditions.lean, x, t))
        second = torch.as_tensor(self.degree, dtype=torch.int64, device=x.device) == 2
        effect = (lean.slope * self.unit.to(x)).square().sum(-1).sqrt()
        effect = torch.where(second, 0.5 * self.hold * effect, effect).amax(-1) * self.hold
        further = short / torch.where(effect > 0, effect, 1.0)
        return torch.where(further > 2 * INFEASIBLE, further, 2 * INFEASIBLE)
