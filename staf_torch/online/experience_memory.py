"""Local models kept along the way, blended into a global approximation."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

import torch
from torch import Tensor, nn

from ..approximation.basis import StaFBasis
from ..lanes.gradients import grad, refuse_gradient
from ..lanes.threads import ReadWriteLock
from ..numerics.checks import hold, integer, positive_real, trailing

_DRIFT = 4.0  # usual distances between a model and the average of those before it
_NEAREST = 1e-4  # of the reach, squared: closer than that a model counts alone, and the weights stay smooth


class ExperienceMemory(nn.Module):
    """V^(y) = sum_j omega_j(y) V^_j(y), a partition of unity over the states x_j at which models were stored.

    With t_j = |y - x_j|^2 / (reach nu(x_j))^2 the weights are omega_j ~ (1 - t_j)_+^3 / (t_j + 1e-4)^2:
    compact, twice continuously differentiable, and nearest first, as the error of a local model grows like a
    power of the distance. Where no support reaches, V^ is NaN: `covered` says where.

    A model within spacing nu(x_j) of a stored state joins that one. On a first revisit it takes the place,
    being fresher, and its distance to the old one is noted; later ones are averaged at the centers of x_j, so
    that noise goes down as 1/sqrt(visits), up to ``visits`` of them, beyond which the old ones fade. Where
    one is further from the average than `_DRIFT` times the usual distance, the function has drifted there,
    and the average begins anew. The one stored last is replaced while the state is within half the spacing
    of where it was first stored, as a chase refines it, and then left alone until the state is further
    away: models do not travel with the state. Elsewhere, once the memory is full, a new model takes the
    place of the most redundant one: of the closest pair of states the one whose second neighbour is closer
    too, so that no gap opens while another one is twice covered.

    Threads may share one: any number of them ask at once, and a model is stored while nobody does.

    Every batch entry has a memory of its own. To share one among trajectories, leave ``batch_shape``
    empty and add their models one after the other.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(6), radius=0.2))
        >>> x = torch.tensor([1.0, 0.5]).double()
        >>> memory = ExperienceMemory(basis, capacity=64)
        >>> written = memory.add(x, basis.local(x).fit(basis.values(x, targets.Paper())))
        >>> memory.query(x.unsqueeze(-2)).shape
        torch.Size([1])

        Shown by `staf experiment=memory`.

    Args:
        basis: kernel and centers; models are coefficients in ``basis.local(x)``.
        capacity: N, models kept, at least 1.
        batch_shape: leading dimensions (...), independent memories side by side.
        reach: of a model, in radii nu(x_j) of its centers, positive.
        spacing: least distance between stored states, in the same radii, positive.
        visits: that an average is over, at most, at least 1; 1 keeps the latest model.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: the paper names a memory as future work (conclusion). Modified Shepard weights: Franke and
    Nielson, Int. J. Numer. Meth. Eng. 15 (1980).
    """

    def __init__(
        self,
        basis: StaFBasis,
        capacity: int,
        batch_shape: tuple[int, ...] = (),
        *,
        reach: float = 2.0,
        spacing: float = 0.5,
        visits: int = 64,
    ) -> None:
        super().__init__()
        if not isinstance(basis, StaFBasis):
            raise ValueError(f"`ExperienceMemory(basis=...)` must be a StaFBasis; got {basis!r}.")
        self.basis = basis
        self.capacity = integer("ExperienceMemory", "capacity", capacity, least=1)
        self.reach = positive_real("ExperienceMemory", "reach", reach)
        self.spacing = positive_real("ExperienceMemory", "spacing", spacing)
        self.visits = integer("ExperienceMemory", "visits", visits, least=1)
        self._lock = ReadWriteLock()
        like, batch = basis.centers.directions, (*batch_shape,)
        self.states = hold(self, "states", like.new_zeros(*batch, capacity, basis.dim))
        self.coefficients = hold(self, "coefficients", like.new_zeros(*batch, capacity, basis.count))
        self.stored = hold(self, "stored", like.new_zeros(*batch, capacity, dtype=torch.bool))
        self.latest = hold(self, "latest", like.new_full(batch, -1, dtype=torch.int64))  # written last
        self.origin = hold(self, "origin", like.new_zeros(*batch, basis.dim))  # where it was first stored
        self.averaged = hold(self, "averaged", like.new_zeros(*batch, capacity, dtype=torch.int64))
        self.scatter = hold(self, "scatter", like.new_zeros(*batch, capacity))  # usual distance

    @property
    def count(self) -> Tensor:
        """Models stored, (...)."""
        return self.stored.sum(-1)

    def add(self, x: Tensor, coefficients: Tensor) -> ExperienceMemory:
        """Store the models at the states x (..., n) with the coefficients (..., M), one a batch entry.

        An entry whose state or coefficients are not finite stores nothing. The first ones take the memory to
        where they are.

        Raises:
            ValueError: if a shape is not (*batch_shape, n) or (*batch_shape, M), a gradient is required, or
                models are on another device than those that are stored.
        """
        batch = self.stored.shape[:-1]
        for name, value, last in (("x", x, self.basis.dim), ("coefficients", coefficients, self.basis.count)):
            if trailing("ExperienceMemory.add", name, value, 1, last, meta=False).shape[:-1] != batch:
                raise ValueError(
                    f"`ExperienceMemory.add({name}=...)` must have the shape {(*batch, last)}; "
                    f"got {tuple(value.shape)}."
                )
        refuse_gradient("ExperienceMemory.add", x=x, coefficients=coefficients)
        if x.device != self.states.device:
            if bool((self.latest >= 0).any()):
                self._refuse_elsewhere("add", "x", x)
            for name, held in self.named_buffers(recurse=False):
                setattr(self, name, held.to(x.device))
        self._lock.write(self._add, x, coefficients)
        return self

    def _add(self, x: Tensor, coefficients: Tensor) -> None:
        with torch.no_grad():
            fine = torch.isfinite(x).all(-1) & torch.isfinite(coefficients).all(-1)
            here = torch.where(fine.unsqueeze(-1), x, 0.0).to(self.states)
            slot, keeps, joins = self._slot(here)
            fine = fine & keeps
            place = nn.functional.one_hot(slot, self.capacity).bool() & fine.unsqueeze(-1)
            at, model = self._averaged(here, coefficients.to(self.states), place, joins & fine)
            mark = place.unsqueeze(-1)
            self.states.copy_(torch.where(mark, at.unsqueeze(-2), self.states))
            self.coefficients.copy_(torch.where(mark, model.unsqueeze(-2), self.coefficients))
            self.stored.copy_(self.stored | place)
            another = (fine & (slot != self.latest)).unsqueeze(-1)
            self.origin.copy_(torch.where(another, x.to(self.states), self.origin))
            self.latest.copy_(torch.where(fine, slot, self.latest))

    def query(self, y: Tensor) -> Tensor:
        """V^(y): (..., P, n) -> (..., P); NaN where no stored model reaches."""
        return self._asked(self._query, y)

    def _query(self, y: Tensor) -> Tensor:
        weights = self._weights(y)
        return (weights * self._local(y)).sum(-1) / weights.sum(-1)  # 0 / 0 where none reaches

    forward = query

    def gradient(self, y: Tensor) -> Tensor:
        """Gradient of the blend at y: (..., P, n) -> (..., P, n)."""
        return self._asked(grad(lambda point: self._query(point).sum()), y)

    def covered(self, y: Tensor) -> Tensor:
        """Return whether a stored model reaches y: (..., P, n) -> (..., P) bool."""
        return (self._asked(self._weights, y) > 0).any(-1)

    def start(self, x: Tensor) -> Tensor:
        """Coefficients (..., M) or (..., P, M) in ``basis.local(x)`` to start from at x (..., n), one state
        a memory, or (..., P, n).

        The blend at the centers of x, and where it does not reach one of them the nearest stored model,
        fitted as if they were values of V. NaN at a state that is not covered itself.
        """
        trailing("ExperienceMemory.start", "x", x, dims=1, last=self.basis.dim)
        return self._asked(self._start, x)

    def _start(self, x: Tensor) -> Tensor:
        if x.dim() == self.stored.dim():
            return self._start(x.unsqueeze(-2)).squeeze(-2)
        several = (x.shape[-2], self.basis.count)
        centers = self.basis.centers(x).flatten(-3, -2)  # (..., P M, n)
        nearest = self._relative(x).argmin(-1, keepdim=True).repeat_interleave(self.basis.count, dim=-2)
        single = self._local(centers).gather(-1, nearest).squeeze(-1)
        blend = self._query(centers)
        values = torch.where(torch.isnan(blend), single, blend).unflatten(-1, several)
        found = self.basis.local(x).fit(values)
        return torch.where(self.covered(x).unsqueeze(-1), found, torch.nan)

    def _refuse_elsewhere(self, call: str, name: str, value: Tensor) -> NoReturn:
        rule = f"must be on {self.states.device}, where the memory is: move one of them by `.to`"
        raise ValueError(f"`ExperienceMemory.{call}({name}=...)` {rule}; got one on {value.device}.")

    def _asked(self, function: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
        """Return function(y) while no model is stored."""
        if y.device != self.states.device:
            self._refuse_elsewhere("query", "y", y)
        return function(y) if torch.compiler.is_compiling() else self._lock.read(function, y)

    def _relative(self, y: Tensor) -> Tensor:
        """t_j, (..., P, n) -> (..., P, N); inf where nothing is stored."""
        trailing("ExperienceMemory", "y", y, dims=2, last=self.basis.dim)
        z = y.unsqueeze(-2) - self.states.unsqueeze(-3)
        support = self.reach * self.basis.centers.radius(self.states)
        t = z.square().sum(-1) / support.square().expand(self.stored.shape).unsqueeze(-2)
        return torch.where(self.stored.unsqueeze(-2), t, torch.inf)

    def _weights(self, y: Tensor) -> Tensor:
        """Not normalised: (..., P, n) -> (..., P, N)."""
        t = self._relative(y)
        inside = t < 1
        near = torch.where(inside, t, 1.0)
        return (1 - near) ** 3 / (near + _NEAREST) ** 2

    def _local(self, y: Tensor) -> Tensor:
        """V^_j(y) where model j reaches at all, else 0: (..., P, n) -> (..., P, N)."""
        z = (y.unsqueeze(-3) - self.states.unsqueeze(-2)).expand(*self.stored.shape, *y.shape[-2:])
        # Beyond this not even `start` asks, and a kernel that grows would overflow.
        far = self._relative(y).mT > (1 + 1 / self.reach) ** 2
        near = torch.where(far.unsqueeze(-1), 0.0, z)
        values = self.basis.local(self.states).evaluate(near, self.coefficients)
        return torch.where(far, 0.0, values).mT

    def _averaged(self, x: Tensor, model: Tensor, place: Tensor, joins: Tensor) -> tuple[Tensor, Tensor]:
        """Return state and coefficients to store in a place (..., N) bool, one at most: the model (...,
        M) at x (..., n), or where it joins (...) its average with what is there."""
        pick = place.unsqueeze(-1).to(self.states)
        there, old = (pick * self.states).sum(-2), (pick * self.coefficients).sum(-2)
        there = torch.where(joins.unsqueeze(-1), there, x)
        offsets = self.basis.centers(there) - x.unsqueeze(-2)
        space = self.basis.local(there)
        fresh = space.fit(self.basis.local(x).evaluate(offsets, model))
        inside = self.basis.centers(there) - there.unsqueeze(-2)
        distance = (space.evaluate(inside, fresh) - space.evaluate(inside, old)).square().mean(-1).sqrt()
        usual, count = (place * self.scatter).sum(-1), (place * self.averaged).sum(-1)
        drifted = (count >= 2) & (distance > _DRIFT * usual)
        again = joins & (usual > 0) & (distance <= _DRIFT * usual)  # one more of the same function
        weight = torch.where(again, (count + 1).clamp(max=self.visits), 1)
        mean = old + (fresh - old) / weight.unsqueeze(-1)
        found = torch.where(again.unsqueeze(-1), mean, torch.where(joins.unsqueeze(-1), fresh, model))
        noted = torch.where(again, usual + (distance - usual) / weight.clamp(min=2), distance)
        noted = torch.where(drifted, usual, noted) * joins
        self.averaged.copy_(torch.where(place, weight.unsqueeze(-1), self.averaged))
        self.scatter.copy_(torch.where(place, noted.unsqueeze(-1), self.scatter))
        return there, found

    def _slot(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the place of a model at x (..., n), int64; whether it is kept; whether it is a revisit."""
        closest, nearest = self._relative(x.unsqueeze(-2)).squeeze(-2).min(-1)
        near = closest < (self.spacing / self.reach) ** 2
        free = self.stored.logical_not()
        some = free.any(-1)
        elsewhere = free.to(torch.int8).argmax(-1)
        if not bool(some.all()):  # saves work, and decides nothing: rows with room take no part in it
            elsewhere = torch.where(some, elsewhere, self._redundant())
        limit = self.spacing * self.basis.centers.radius(self.origin) / 2
        still = (x - self.origin).square().sum(-1) < limit.square()
        other = nearest != self.latest
        return torch.where(near, nearest, elsewhere), ~near | other | still, near & other

    def _redundant(self) -> Tensor:
        """Return which one of the closest pair of states has the closer second neighbour: (...) int64."""
        own = torch.eye(self.capacity, dtype=torch.bool, device=self.states.device)
        apart = torch.where(own, torch.inf, self._relative(self.states))
        # Symmetric, so that both of a pair are found: t is in units of the one's radius, or the other's.
        apart = torch.minimum(apart, apart.mT)
        ordered = apart.sort(-1).values
        closest = ordered[..., 0] <= ordered[..., :1].amin(-2)
        return torch.where(closest, ordered[..., min(1, self.capacity - 1)], torch.inf).argmin(-1)
