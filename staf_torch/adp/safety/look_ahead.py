"""A state after a hold: can the brakes stop it inside, or the policy bring it back inside?

A condition of one hold says nothing of the next ones where bounds limit the inputs. Here the hardest brake is
followed until nothing comes nearer to its edge; of double integrators that is v^2 <= 2 a h. Where braking
along an edge would drive the rest of the plant away (a coordinate that must first move the wrong way) the
brakes keep nothing, and the policy itself is followed.

Source: Gurriet, Mote, Singletary, Nilsson, Feron, Ames, "A scalable safety critical control framework for
nonlinear systems", IEEE Access (2020): a set that a backup law keeps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ...lanes import repeat, where_rows
from ...lanes.gradients import grad, jacrev
from ...lanes.per_row.decisions import in_any_row, is_of_rows
from ...lanes.trace.loops import repeat_counted
from ..loop.controller import Policy
from .conditions import Conditions, Ends, Lean, speed_of

_BRAKING, _SHARE = 48, 8.0  # steps of the hardest brake; each at least a period and 1/8 of what is left
_FEWEST, _FOLLOWED, _CONSTANTS = 20, 300, 4.0  # periods of the policy; time constants of its slowest mode
_SPARE = 0.01  # of the brakes, that a control must leave which is not the hardest
_URGENT = 0.5  # share of the brakes at a state, from which on they are followed
_BACK = 0.5  # of x'Px, to which the policy must have brought the state
_ROUNDED = 1e-9  # of h, by which an edge may be missed
_UNSTABLE = 0.01  # of the fastest mode, from which on one that grows counts
_NEVER = 1e6  # s, for which what no brake slows goes on


class LookAhead(nn.Module):
    """Choose between controls by what follows them; a policy that remembers, None here, is not followed.

    Attributes:
        periods: for which the policy is followed at most; a row with numbers of its own has its ``count``.
    """

    largest = ("periods",)

    def __init__(self, conditions: Conditions, policy: Policy | None) -> None:
        super().__init__()
        self.conditions = conditions
        self.against, alone, bowl = opposition(conditions, policy)
        self.opposed = bool((self.against > 0).any())
        self.weak = any(conditions.weak)
        frail = conditions.frail
        if self.opposed and frail is not None:  # what is followed differs too: rows part
            self.weak, frail = bool((frail > 0).any()), None
        self.register_buffer("frail", None if frail is None else frail.amax())
        self.frail: Tensor | None  # () 1 where a row's own brakes are weak; None where rows are alike
        self.acts = any(conditions.limited) or self.opposed
        self.by_policy = policy is not None and (self.weak or (self.opposed and alone is not None))
        self.by_brakes = not (self.opposed and self.by_policy)
        if self.opposed and not self.by_policy:
            self.acts = False  # nothing tells what becomes of a state
        self.periods, self.counted, count = _FEWEST, False, conditions.decay.new_tensor(float(_FEWEST))
        if self.by_policy:
            slow = (-(torch.zeros_like(count) if alone is None else alone)).clamp(min=1e-9)
            periods = (_CONSTANTS / slow / conditions.hold).ceil().clamp(max=_FOLLOWED)
            count = torch.maximum(count, periods)
            if self.frail is not None:
                count = count * self.frail  # what no weak brakes ask for is not followed
            self.counted = is_of_rows(count)
            while in_any_row(count > self.periods):
                self.periods += 1
        self.register_buffer("count", count)
        self.count: Tensor  # () periods that are followed
        hold = conditions.decay.new_tensor(conditions.hold)
        if conditions.holding.classical:
            hold = torch.maximum(hold, 0.5 / _fastest(conditions).clamp(min=1e-9))
        self.register_buffer("longest", hold)
        self.longest: Tensor  # ()
        self.register_buffer("bowl", bowl if self.opposed and self.by_policy else None)
        self.bowl: Tensor | None

    def asked(self, x: Tensor, u: Tensor, t: Tensor, strain: Tensor) -> Tensor:
        """The rows whose brakes may not do: (B, n), (B, m), (B,), (B,) -> (B,) bool."""
        of = self.conditions
        second = torch.as_tensor(of.degree, dtype=torch.int64, device=x.device) == 2

        def urgent(given: tuple[Tensor, ...]) -> Tensor:
            x, u, t = given
            end = of.halfway(of.halfway(x, u), u)
            lean = Lean(*of.every(of.lean, end, t + of.hold))
            need = speed_of(lean.rate).square() > 2 * _URGENT * lean.ability * lean.value
            return (second & (lean.rate < 0) & (lean.value > 0) & need).any(-1).to(x)

        return where_rows(strain > 0, urgent, (x, u, t), torch.zeros_like(t)) > 0

    def choose(
        self, policy: Policy | None, given: tuple[Tensor, ...], where: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the first control (B, m) whose consequences are fine, else the one of the best, in the rows
        ``where`` (B,), and by how much h - margin stays above min(0, its value now), at most 0."""
        wanted, found, x, t = given
        none = torch.zeros_like(t)
        start = wanted, found, x, t, found, none - math.inf, none, where

        def further(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            wanted, found, x, t, best, left, count, _ = now
            hardest = self.hardest(Lean(*self.conditions.every(self.conditions.lean, x, t)))
            first, second = found, found + 0.25 * (hardest - found)
            if self.opposed:
                first, second = wanted, found
            elif self.weak:
                second = wanted if self.frail is None else torch.where(self.frail > 0, wanted, second)
            turn = count.unsqueeze(-1)
            tried = torch.where(turn == 2, 0.5 * (found + hardest), hardest)
            tried = torch.where(turn == 0, first, torch.where(turn == 1, second, tried))
            # What is not the hardest brake leaves a little of it for the next holds.
            strength = torch.where(turn < 3, 1 - _SPARE, torch.ones_like(turn))
            now_left = self.left_after(policy, x, tried, t, strength)
            better = now_left > left
            best = torch.where(better.unsqueeze(-1), tried, best)
            left, count = torch.where(better, now_left, left), count + 1
            return wanted, found, x, t, best, left, count, (left < -_ROUNDED) & (count < 4)

        _, _, _, _, control, left, _, _ = repeat(4, further, start, where=lambda now: now[7])
        return control, torch.where(left < -_ROUNDED, left, 0.0)

    def hardest(self, lean: Lean) -> Tensor:
        """The control that brakes as hard as can be, for what is most urgent: (B, m)."""
        of, like = self.conditions, lean.value
        second = torch.as_tensor(of.degree, dtype=torch.int64, device=like.device) == 2
        room = torch.where(lean.value > _ROUNDED, lean.value, _ROUNDED)
        able = torch.where(lean.ability > _ROUNDED, lean.ability, _ROUNDED)
        away = torch.where(lean.drift < 0, -lean.drift, 0.0)
        urgency = torch.where(
            second, 0.5 * speed_of(lean.rate).square() / (room * able), of.hold * away / room
        )
        most = urgency.amax(-1, keepdim=True)
        weight = (urgency / torch.where(most > 0, most, 1.0)) ** 4
        length = lean.slope.square().sum(-1).sqrt()
        share = torch.where(length > 0, weight / torch.where(length > 0, length, 1.0), 0.0)
        push = (share.unsqueeze(-1) * lean.slope).sum(-2)
        rest = of.plant.resting_input().to(like)
        low, high = of.low.to(like), of.high.to(like)
        idle = torch.minimum(torch.maximum(rest, low), high)
        return torch.where(push > 0, high, torch.where(push < 0, low, idle))

    def left_after(self, policy: Policy | None, x: Tensor, u: Tensor, t: Tensor, strength: Tensor) -> Tensor:
        """By how much every h - margin stays above min(0, its value now) in the hold and after it, under such
        a share of the brakes, (B, 1): (B,)."""
        of = self.conditions
        ends = Ends(*of.every(of.over, x, u, t))
        end = of.halfway(of.halfway(x, u), u)
        later, time = torch.full_like(t, -math.inf), t + of.hold
        least = torch.where(ends.value < 0, ends.value, 0.0)
        if self.by_brakes and of.apart:
            stopped = ends.last_value - 0.5 * speed_of(ends.last_rate).square() / of.brakes.to(
                ends.value
            )  # by constant brakes
            later = (stopped - least).amin(-1)
        elif self.by_brakes:
            later = (self._braked(end, time, strength) - least).amin(-1)
        spent = None
        if self.by_policy and policy is not None:
            followed, spent = self._followed(policy, end, time)
            back = (followed - least).amin(-1)
            if self.frail is not None:
                back = torch.where(self.frail > 0, back, later)
            later = torch.maximum(later, back)
        left = torch.minimum((ends.least(of.hold) - least).amin(-1), later)
        if not self.opposed or spent is None:
            return left
        # What cannot be kept is to be over soon: the deepest point alone would let it wait outside for ever.
        return torch.where(left < -_ROUNDED, -spent - 2 * _ROUNDED, left)

    def _braked(self, x: Tensor, t: Tensor, strength: Tensor) -> Tensor:
        """The smallest h - margin under the hardest brake until nothing comes nearer: (B, k)."""
        of = self.conditions
        second = torch.as_tensor(of.degree, dtype=torch.int64, device=x.device) == 2
        weak = torch.as_tensor(of.weak, dtype=torch.bool, device=x.device)
        if of.frail is not None:
            weak = of.frail > 0
        value, rate, _ = of.every(of.level, x, t)
        start = x, t, value, rate, value, value, strength, t == t
        rest, longest = of.plant.resting_input().to(x), self.longest.to(x)

        def brake(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, t, value, rate, _, least, strength, _ = now
            lean = Lean(*of.every(of.lean, x, t))
            able = torch.where(lean.ability > 0, lean.ability, 1.0)
            left = torch.where(second & (lean.ability > 0), speed_of(lean.rate) / able, 0.0).amax(-1) / _SHARE
            length = torch.where(left > of.hold, torch.where(left < longest, left, longest), of.hold)
            u = rest + strength * (self.hardest(lean) - rest)
            x, t, ends = self._moved(x, u, t, value, rate, length)
            going = (ends.last_rate < 0) | ((weak | ~second) & (lean.ability < 0))
            least = torch.minimum(least, ends.least(length.unsqueeze(-1)))
            return x, t, ends.last_value, ends.last_rate, lean.ability, least, strength, going.any(-1)

        done = repeat(_BRAKING, brake, start, where=lambda now: now[7])
        _, _, value, rate, ability, least, _, going = done
        speed = speed_of(rate)
        able = torch.where(ability > 0, ability, 1.0)
        far = torch.where(ability > 0, 0.5 * speed.square() / able, _NEVER * speed)
        far = torch.where(second, far, torch.where(ability < 0, -_NEVER * ability, 0.0))
        return torch.where(going.unsqueeze(-1), torch.minimum(least, value - far), least)

    def _followed(self, policy: Policy, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """The smallest h - margin under the policy, (B, k), and the integral of what is missing, (B,); far
        below, and far above, where it does not come back."""
        of = self.conditions
        value, rate, _ = of.every(of.level, x, t)
        length = torch.full_like(t, of.hold)

        def follow(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, t, value, rate, least, spent = now
            x, t, ends = self._moved(x, of.bounds.clip(policy(x)), t, value, rate, length)
            short = torch.where(ends.last_value < 0, -ends.last_value, 0.0).sum(-1)
            least, spent = torch.minimum(least, ends.least(of.hold)), spent + of.hold * short
            return x, t, ends.last_value, ends.last_rate, least, spent

        start = x, t, value, rate, value, torch.zeros_like(t)
        if self.counted:  # rows have periods of their own
            last, _, _, _, least, spent = repeat_counted(self.periods, self.count, follow, start)
        else:
            last, _, _, _, least, spent = repeat(self.periods, follow, start)
        back = torch.isfinite(last).all(-1)
        if self.bowl is not None:
            back = back & (self._height(last) <= _BACK * self._height(x) + _ROUNDED)
        least = torch.where(torch.isfinite(least), least, -_NEVER)
        spent = torch.where(torch.isfinite(spent), spent, _NEVER)
        return torch.where(back.unsqueeze(-1), least, least - _NEVER), torch.where(
            back, spent, spent + _NEVER
        )

    def _height(self, x: Tensor) -> Tensor:
        assert self.bowl is not None
        off = x - self.conditions.plant.equilibrium().to(x)
        return (off * (off @ self.bowl.to(x))).sum(-1)

    def _moved(
        self, x: Tensor, u: Tensor, t: Tensor, value: Tensor, rate: Tensor, length: Tensor
    ) -> tuple[Tensor, Tensor, Ends]:
        of, half = self.conditions, 0.5 * length
        middle = of.advance(x, u, length.unsqueeze(-1))
        between, *_ = of.every(of.level, middle, t + half)
        x, t = of.advance(middle, u, length.unsqueeze(-1)), t + length
        return x, t, Ends(value, rate, between, *of.every(of.level, x, t))


def opposition(of: Conditions, policy: Policy | None) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Find what braking along every edge does to the rest of the plant: the modes of

        x' = (A - B K) x - B s'/(s s') phi (A - B K + decay) x,

    in which the barrier's condition holds with equality, phi the row of the constraint's last derivative
    (plus decay times h) and s = its product with B. A mode that grows there, faster than under the policy
    alone, is an unstable zero: the constraint's coordinate must first move the wrong way.

    Returns:
        The rate of its growth, (k,) 1/s, at most 0 where nothing runs away; that of the slowest mode under
        the policy alone, (), None where it is not known; and P of x'Px, which falls under the policy.
    """
    plant = of.plant
    rest, at = plant.resting_input().double(), plant.equilibrium().double()
    try:
        a, b = jacrev(plant.motion, argnums=(0, 1))(at, rest)
        gain = torch.zeros_like(b.mT) if policy is None else -jacrev(policy)(at).reshape(b.mT.shape)
    except Exception:  # a policy that no derivative passes through is not linearised
        a, b = jacrev(plant.motion, argnums=(0, 1))(at, rest)
        gain, policy = torch.zeros_like(b.mT), None
    a, b, gain = a.detach(), b.detach(), gain.detach().to(a)
    closed = a - b @ gain
    if not bool(torch.isfinite(closed).all()):
        return torch.zeros_like(of.decay), None, None
    modes = torch.linalg.eigvals(closed)
    alone, fast = None if policy is None else modes.real.max(), modes.abs().max()
    lost = torch.zeros_like(fast > 0) if alone is None else alone > _UNSTABLE * fast  # nothing comes back
    rates = list[Tensor]()
    x, _ = of._around()
    normals = [torch.func.vmap(grad(lambda x, h=h: h(x.unsqueeze(0), x.new_zeros(()))[0]))
               for h in of.constraints]  # fmt: skip
    for k, normal in enumerate(normals):
        along = [(c, a, b, closed, of.decay[k], of.degree[k], modes.real.max()) for c in normal(x[:8])]
        grown = torch.stack([_growth(*each) for each in along])
        known = grown == grown
        middle = grown.sort().values.gather(0, known.sum().unsqueeze(0) // 2 % len(grown))[0]
        rates.append(torch.where(known.any() & (middle > 0) & ~lost, middle, 0.0))
    rate = torch.stack(rates)
    bowl = None
    if alone is not None and bool((rate > 0).any()) and bool(alone < 0):
        eye, turned = (
            torch.eye(len(a), dtype=a.dtype, device=a.device),
            closed.mT.contiguous(),
        )  # A'P + PA = -1
        bowl = torch.linalg.solve(torch.kron(eye, turned) + torch.kron(turned, eye), -eye.flatten())
        bowl = bowl.unflatten(0, eye.shape)
    return rate, alone, bowl


def _growth(
    c: Tensor, a: Tensor, b: Tensor, closed: Tensor, decay: Tensor, degree: int, before: Tensor
) -> Tensor:
    """Return the growth of the fastest mode along an edge of normal c, faster than ``before``, 0 for none;
    NaN without an effect."""
    phi, push = (c, c @ b) if degree == 1 else (c @ a + decay * c, c @ a @ b)
    size = push.square().sum()
    effect = size > 1e-12 * (c.square().sum() * b.square().sum()).clamp(min=1e-300)
    eye = torch.eye(len(a), dtype=a.dtype, device=a.device)
    along = closed - torch.outer(b @ push, phi @ (closed + decay * eye)) / torch.where(effect, size, 1.0)
    known = effect & torch.isfinite(along).all()
    modes = torch.linalg.eigvals(torch.where(known, along, 0.0))
    growth = modes.real.max()
    grows = growth > torch.maximum(_UNSTABLE * modes.abs().max(), before)
    return torch.where(known, torch.where(grows, growth, 0.0), torch.nan)


def _fastest(of: Conditions) -> Tensor:
    """Return the fastest rate of the plant at its equilibrium, 1/s: below it lie steps of the brakes."""
    at, rest = of.plant.equilibrium().double(), of.plant.resting_input().double()
    a = jacrev(of.plant.motion)(at, rest).detach()
    finite = torch.isfinite(a).all()
    return torch.where(finite, torch.linalg.matrix_norm(torch.where(finite, a, 0.0)), torch.inf)
