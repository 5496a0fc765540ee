"""A controller for a device: u from x, with what was learned held fixed; and names in its files."""

from __future__ import annotations

import copy
import gc
import re
from collections.abc import Sequence
from types import FunctionType, ModuleType
from typing import Any, TypeGuard, TypeVar

import torch
from torch import Tensor, nn

from ..adp import (
    ActorCritic,
    Controller,
    Feedback,
    GlobalValue,
    PathIntegral,
    RecedingHorizon,
    RolloutPolicy,
    SafetyFilter,
    Supervised,
)
from ..adp.near_optimal_policy import NearOptimal
from ..adp.planning.receding_horizon import StrainedPlans
from ..adp.planning.shooting.starts import PlanReplay
from ..lanes.emit.c import checked_names, refused
from ..lanes.gradients import grad
from ..lanes.per_row.objects import refuse_rows, row_of
from ..local_basis.graded import GradedBasis
from ..numerics.checks import fail, hold, trailing
from .remembered_policy import RememberedPolicy

Some = TypeVar("Some")
_LONGEST = 48  # characters of a name that nobody gave


class ActorPolicy(nn.Module):
    """u = -1/2 R^-1 g' Ds(x; x)' Wa of an `ActorCritic`, without the learning; weights Wa (M,).

    Source: MATH.md section 4.
    """

    def __init__(self, learner: ActorCritic, weights: Tensor) -> None:
        super().__init__()
        trailing("ActorPolicy", "weights", weights, dims=1, last=learner.basis.count)
        if weights.dim() != 1 or not bool(torch.isfinite(weights).all()):
            raise fail("ActorPolicy", "weights", f"must be {learner.basis.count} finite numbers", weights)
        self.basis, self.model, self.cost = copy.deepcopy((learner.basis, learner.model, learner.cost))
        self.weights = hold(self, "weights", weights.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        slopes = self.basis.gradient(x, x)  # (..., M, n)
        gradient = (slopes * self.weights.to(x).unsqueeze(-1)).sum(-2)
        return self.cost.policy(self.model.effectiveness(x), gradient)


class GuardedPolicy(nn.Module):
    """A policy (..., n) -> (..., m) drawn towards the LQR by `Supervised`, or behind a `SafetyFilter`.

    Where a constraint depends on the time, t is the last entry of x."""

    def __init__(self, policy: nn.Module, guard: Supervised | SafetyFilter) -> None:
        super().__init__()
        self.policy = policy
        self.guard = copy.deepcopy(guard)
        self.guard.controller = Feedback(policy)

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n), or (..., n + 1) with the time, -> (..., m)."""
        return self.restrained(x, self.policy(self.plant_state(x)))

    def plant_state(self, x: Tensor) -> Tensor:
        """Return x without the time: (..., n)."""
        if isinstance(self.guard, Supervised):
            return x
        return x[..., : self.guard.plant.equilibrium().numel()]

    def restrained(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the control in place of u: (..., n), or (..., n + 1) with the time, and (..., m)."""
        if isinstance(self.guard, Supervised):
            return self.guard.restrain(x, u)
        moving = (x[..., :-1], u, x[..., -1]) if self.guard.moving else (x, u)
        return self.guard.restrain(*moving).control


class FoldedRollout(nn.Module):
    """u = policy(grad V^(x)) as in `RolloutPolicy`, for centers at constant offsets d_i and a kernel whose
    core does not depend on the state. The fit and its gradient at the state are then one matrix H for all
    states, and for the exponential kernel

        (v, g) = H (e^{-x'd_i} V_i),   grad V^(x) = g + x v;

    for a translation-invariant kernel grad V^(x) = g, without the factor. Nothing is factored at run time.

    Its radius is constant, and its kernel `foldable`.
    """

    def __init__(self, policy: RolloutPolicy) -> None:
        super().__init__()
        basis = policy.basis
        zero = torch.zeros(basis.dim, dtype=torch.float64, device="cpu")
        space = copy.deepcopy(basis).double().local(zero)
        unit = space.fit(torch.eye(basis.count, dtype=torch.float64, device="cpu"))  # a row a center
        at = zero.expand(basis.count, 1, -1)
        value = space.evaluate(at, unit).squeeze(-1)
        slope = grad(lambda z: space.evaluate(z, unit).sum())(at).squeeze(-2)  # (M, n)
        self.moving = basis.kernel.scale_slope == 1.0
        self.policy = copy.deepcopy(policy)
        if isinstance(policy.base, RolloutPolicy) and foldable(policy.base):
            self.policy.base = FoldedRollout(policy.base)
        self.offsets = hold(self, "offsets", basis.centers.offsets(zero).detach().clone())  # (M, n)
        self.fit = hold(self, "fit", torch.cat((value.unsqueeze(-1), slope), dim=-1).detach())  # (M, 1 + n)

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        values = self.policy.rollout(x.unsqueeze(-2) + self.offsets)
        if self.moving:
            values = values * (-(x.unsqueeze(-2) * self.offsets).sum(-1)).exp()
        both = values @ self.fit
        gradient = both[..., 1:]
        if self.moving:
            gradient = gradient + x * both[..., :1]
        return self.policy.cost.policy(self.policy.model.effectiveness(x), gradient)


def searches(module: nn.Module) -> TypeGuard[GuardedPolicy]:
    """Return whether a policy is around one that searches a memory, which no program of a row does."""
    if not isinstance(module, GuardedPolicy):
        return False
    return isinstance(module.policy, RememberedPolicy) or searches(module.policy)


def foldable(policy: RolloutPolicy) -> bool:
    """Return whether `FoldedRollout` takes a policy: one scalar radius, a state-free core, a known factor."""
    kernel, radius = policy.basis.kernel, policy.basis.centers.radius
    bound = radius.bound()
    known = kernel.state_free and kernel.scale_slope in (0.0, 1.0)
    return radius.constant and bound is not None and bound.dim() == 0 and known


def policy_of(
    controller: Controller | nn.Module,
    weights: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
    row: int | None = None,
) -> nn.Module:
    """The feedback law u(x) of a controller, as a module with its constants folded where it can be.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> deploy.policy_of(adp.LQR(plant, cost))(torch.ones(1, 2, dtype=torch.float64)).shape
        torch.Size([1, 1])

        Shown by `staf-export RUN --to c`.

    Args:
        controller: `Feedback`, `ActorCritic`, `Supervised`, `SafetyFilter`, `LQR`, `RolloutPolicy`,
            `GlobalValue`, or any module (..., n) -> (..., m).
        weights: Wa of an actor-critic, (M,); its initial ones by default.
        dtype: of the arithmetic.
        row: which one, of a controller with numbers of rows (`staf_torch.rows`).

    Raises:
        ValueError: if the controller is none of these, has numbers of rows and no row is named, plans on the
            way, or carries a state.
    """
    controller = controller if row is None else row_of(controller, row)
    refuse_rows("policy_of", "name its `row`", controller=controller)
    module = _policy_of(controller, weights).to(dtype)
    if dtype != torch.float64:
        module = in_dtype(module, dtype)  # also of policies that keep their precision
    return module.eval().requires_grad_(False)


def _policy_of(controller: Controller | nn.Module, weights: Tensor | None) -> nn.Module:
    if isinstance(controller, Supervised | SafetyFilter):
        return GuardedPolicy(_policy_of(controller.controller, weights), controller)
    if isinstance(controller, ActorCritic):
        return ActorPolicy(controller, controller.actor if weights is None else weights)
    if weights is not None:
        raise fail("policy_of", "weights", f"must be None for {type(controller).__name__}", weights)
    if isinstance(controller, Feedback):
        controller = controller.policy  # type: ignore[assignment]
    if isinstance(controller, RolloutPolicy) and foldable(controller):
        return FoldedRollout(controller)
    if isinstance(controller, NearOptimal) and controller.memory is not None:
        return RememberedPolicy(controller.memory)
    if isinstance(controller, NearOptimal) and controller.planner is not None:
        rule = "must not plan anew in every state: `export_learning_c` writes its `controller()`"
        raise fail("policy_of", "controller", rule, "a policy that plans where a bound is met")
    if isinstance(controller, GlobalValue):
        return RememberedPolicy(controller)
    if isinstance(controller, RecedingHorizon | PathIntegral | PlanReplay | StrainedPlans):
        check_bounded("policy_of", controller)
        rule = "carries its plan from control to control: `deploy.export_learning_c` writes it with its state"
        raise fail("policy_of", "controller", rule, type(controller).__name__)
    if isinstance(controller, Controller) or not isinstance(controller, nn.Module):
        raise fail("policy_of", "controller", "must be a feedback law without memory or an actor", controller)
    return copy.deepcopy(controller)


def check_bounded(call: str, controller: Controller) -> None:
    """Refuse what no device can run in a time that is known before.

    Raises:
        ValueError: that says why.
    """
    if isinstance(controller, RecedingHorizon) and controller.iterations and controller.memory is not None:
        rule = (
            "must not search a memory and then optimise: `GlobalValue` alone is exported, and "
            "`RecedingHorizon` without `memory` or with `iterations=0`"
        )
        raise fail(call, "controller", rule, f"iterations={controller.iterations}")
    if isinstance(controller, PlanReplay):
        rule = (
            "must be a feedback: a plan of direct shooting is no function of x; `RecedingHorizon` follows it"
        )
        raise fail(call, "controller", rule, "PlanReplay")


def in_dtype(thing: Some, dtype: torch.dtype) -> Some:
    """Return a copy in which every floating-point tensor has a dtype: those of plain objects and tuples,
    which `Module.to` leaves as they are, too. What a function of the user captured stays."""
    if dtype == torch.float64:
        return copy.deepcopy(thing)
    memo: dict[int, Any] = {}
    seen, waiting = {id(thing)}, [thing]
    while waiting:
        here = waiting.pop()
        if isinstance(here, Tensor):
            if here.is_floating_point():
                changed = here.detach().to(dtype)
                memo[id(here)] = nn.Parameter(changed) if isinstance(here, nn.Parameter) else changed
            continue
        if isinstance(here, type | ModuleType | FunctionType):
            continue
        if isinstance(here, GradedBasis):  # is in float64 whatever it is asked in
            memo[id(here)] = here
            continue
        for each in gc.get_referents(here):
            if id(each) not in seen:
                seen.add(id(each))
                waiting.append(each)
    return copy.deepcopy(thing, memo)


def function_name(
    call: str, name: str | None, thing: nn.Module | Controller | None, beside: Sequence[str] = ()
) -> str:
    """Return the name of what is exported, by default that of its class in small letters, "policy" of
    nothing.

    ``beside`` are names that its function has inside; ``call`` is the exporter, for messages. Raises
    ValueError if C or C++ has taken the name.
    """
    if name is None:
        found = made_name(_of(thing), "policy")
        return f"{found}_policy" if found in beside else found
    checked_names(call, "name", [name], beside)
    return name


def made_name(text: str, kind: str) -> str:
    """Return a name that C and C++ take, of any text: other characters become _; ``kind`` stands before a
    number, and behind a name that is taken."""
    found = re.sub(r"_{2,}", "_", re.sub(r"[^A-Za-z0-9]", "_", text)).strip("_")[:_LONGEST].rstrip("_")
    if not found or not found[0].isalpha():
        found = f"{kind}_{found}".rstrip("_")
    return found if refused(found) is None else f"{found}_{kind}"


def _of(thing: nn.Module | Controller | None) -> str:
    if thing is None:
        return "policy"
    if isinstance(thing, GuardedPolicy):
        return f"{'supervised' if isinstance(thing.guard, Supervised) else 'filtered'}_{_of(thing.policy)}"
    if isinstance(thing, Feedback) and isinstance(thing.policy, nn.Module):
        return _of(thing.policy)
    kind = type(thing).__name__.removesuffix("Policy").removeprefix("Folded")
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", kind).lower()


def listed_names(call: str, outputs: Sequence[str], argument: str = "outputs") -> list[str]:
    """Return names of outputs, or of another argument, as a list.

    Raises:
        ValueError: if they are one string, whose letters would be names.
    """
    if isinstance(outputs, str) or not all(isinstance(name, str) for name in outputs):
        raise fail(call, argument, 'must be a list of names, such as ["u"]', outputs)
    return list(outputs)


def check_count(call: str, outputs: Sequence[str], count: int) -> None:
    """Refuse another number of names than there are outputs.

    Raises:
        ValueError: that says how many there are.
    """
    if len(outputs) != count:
        rule = f"must be {count} name{'s' * (count > 1)}, one an output of the module"
        raise fail(call, "outputs", rule, list(outputs))


def check_dtype(call: str, module: nn.Module, example: Tensor) -> None:
    """Refuse an example of another dtype than the module computes in.

    Raises:
        ValueError: that says how to make the two alike.
    """
    held = {part.dtype for part in (*module.buffers(), *module.parameters()) if part.is_floating_point()}
    if held and example.dtype not in held:
        rule = (
            f"must be in the dtype of the module, {', '.join(map(str, held))} (`policy_of(..., dtype=...)`)"
        )
        raise fail(call, "example", rule, str(example.dtype))
