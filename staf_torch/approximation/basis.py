"""A kernel and its state-following centers: what is needed at a state to approximate around it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from ..centers import StateFollowingCenters
from ..kernels import Kernel
from ..lanes.per_row.objects import Rowwise, beyond_rows
from ..lanes.row_numbers import over_rows
from ..lanes.threads import small
from ..local_basis import Degrees, LocalBasis, LocalSpace
from ..numerics.checks import beside_batch, fail, learns, sampled, trailing, values_of
from ..numerics.default_device import beside
from ..numerics.rows import check_kernel
from .coefficient_format import compare, decode, encode, record

Target = Callable[[Tensor], Tensor]
"""A function V to approximate: points (..., n) to values (...)."""


REACH = r"\|x\| r = "
"""Start of the warning of `StaFBasis.check_reach`, as a regular expression."""


class GramStructure(NamedTuple):
    """K(c(x)) = e^{log_gain} S K0 S with S = diag(scale), at the states x."""

    core: Tensor  # K0, (M, M) where one serves all states, else (..., M, M)
    log_scale: Tensor | None  # s(x, d_i), (..., M), (M,) where one serves all; None for zeros
    log_gain: Tensor | None  # g(x), (...); None for zeros

    @property
    def scale(self) -> Tensor | None:
        """e^{s(x, d_i)}, (..., M); None for ones."""
        return None if self.log_scale is None else self.log_scale.exp()

    def scaled(self) -> Tensor:
        """S K0 S = e^{-gain} K(c(x)): (..., M, M)."""
        if self.log_scale is None:
            return self.core
        scale = self.log_scale.exp()
        return scale.unsqueeze(-1) * self.core * scale.unsqueeze(-2)

    def quadratic(self, v: Tensor) -> Tensor:
        """v'S K0 S v without S K0 S: (..., M) -> (...)."""
        u = v if self.log_scale is None else self.log_scale.exp() * v
        product = self.core[..., 0] * u[..., :1]
        for j in range(1, u.shape[-1]):  # a column at a time: no (..., M, M), no bits from other rows
            product = torch.addcmul(product, self.core[..., j], u[..., j : j + 1])
        quadratic: Tensor = torch.linalg.vecdot(u, product)
        return quadratic


class StaFBasis(nn.Module, metaclass=Rowwise):
    """The StaF basis sigma_i(y; x) = k(y, c_i(x)), i = 1..M.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> x = torch.tensor([1.0, 0.0], dtype=torch.float64)
        >>> basis.ideal_weights(x, targets.Paper()).shape
        torch.Size([3])

        Shown by `staf experiment=gradient_chase`.

    Hyperparameters that kernel, centers and radius were given as `nn.Parameter` are learned, others fixed.
    A buffer named convention says in a state_dict what coefficients beside it mean: one with a convention is
    loaded where it means the module's own functions; one without, of directions alone, makes the module
    choose its local basis anew.

    Args:
        kernel: the kernel k.
        centers: the state-following centers c_i.

    Raises:
        ValueError: if an argument is of another type, or there are more centers than the kernel's
            function space has dimensions (polynomial kernels).

    Source: Rosenfeld et al., section 2.
    """

    rowwise: ClassVar = {
        "forward": (2, 1),
        "gram": (1,),
        "ideal_weights": (1,),
        "excess": (1, 1),
        "values": (1,),
    }
    _unseen = True  # until the first evaluation at the own state, where a constant one is reported
    _choose_again = False  # whether directions came without what fixes their local basis
    convention: Tensor

    @small
    def __init__(self, kernel: Kernel, centers: StateFollowingCenters) -> None:
        super().__init__()
        if not isinstance(kernel, Kernel):
            raise ValueError(f"`StaFBasis(kernel=...)` must be a Kernel; got {kernel!r}.")
        if not isinstance(centers, StateFollowingCenters):
            raise ValueError(f"`StaFBasis(centers=...)` must be a StateFollowingCenters; got {centers!r}.")
        rank = kernel.rank(centers.dim)
        if rank is not None and centers.count > rank:
            raise ValueError(
                f"`StaFBasis(centers=...)` has {centers.count} centers, but the space of "
                f"{type(kernel).__name__}({kernel.extra_repr()}) over R^{centers.dim} has "
                f"{rank} dimensions: use at most {rank} centers, or a higher degree."
            )
        check_kernel(kernel, centers.directions)
        self.kernel = kernel
        self.centers = centers
        self._local_basis = LocalBasis(kernel, centers.directions)
        self.register_buffer("convention", encode(self._record()))
        self.register_load_state_dict_post_hook(StaFBasis._after_loading)  # type: ignore[no-untyped-call]
        self._prepare()

    @property
    def count(self) -> int:
        """M, the number of basis functions."""
        return self.centers.count

    @property
    def dim(self) -> int:
        """n, the dimension of the state."""
        return self.centers.dim

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        """sigma(y; x): (..., P, n), (..., n) -> (..., P, M), of the dtype of its arguments.

        The first evaluation at y = x warns where sigma(x; x) is the same at every state: `check_own_value`.
        """
        trailing("StaFBasis", "y", y, dims=2, last=self.dim)
        if y.dim() > 2:
            beside_batch("StaFBasis", "y", y, 2, x.shape[:-1], "x is")
        if self._unseen and _same(y, x):
            self.check_own_value(x.detach(), stacklevel=5)
        sigma: Tensor = self.kernel(y, self.centers(x))
        real = y.dtype if y.dtype is x.dtype else torch.promote_types(y.dtype, x.dtype)
        return sigma if sigma.dtype is real else sigma.to(real)

    def gram(self, x: Tensor) -> Tensor:
        """K(c(x)): (..., n) -> (..., M, M). Overflows with the kernel; see `gram_structure`."""
        centers = self.centers(x)
        gram: Tensor = self.kernel(centers, centers)
        return gram

    def gram_structure(self, x: Tensor) -> GramStructure:
        """The factors of K(c(x)), none of which overflows: (..., n) -> `GramStructure`."""
        d = self.centers.offsets(x)
        core = self.kernel.core(x, d, d)
        return GramStructure(core, self.kernel.log_scale(x, d), self.kernel.log_gain(x))

    def local(self, x: Tensor) -> LocalSpace:
        """The span of the basis at the states x (..., n), in a basis that can be computed with."""
        trailing("StaFBasis.local", "x", x, dims=1, last=self.dim)
        if x.dtype in (torch.float16, torch.bfloat16):
            raise ValueError(
                "`StaFBasis.local(x=...)` must be of float32 or float64, in which a Gram matrix can be "
                f"factored (`x.float()`; `StaF` does it by itself); got {x.dtype}."
            )
        return self._local_basis.space(self.kernel, self.centers, x)

    def check_reach(self, x: Tensor, stacklevel: int = 3) -> bool:
        """Warn, and say so, where the exponential kernel is a poor choice: |x| nu(x) > 1 at a state (..., n).

        exp(y'c) then changes by more than e over the ball, with the state and not with V.
        """
        return self.warn_reach(self.largest_reach(x), stacklevel + 1)

    def largest_reach(self, x: Tensor) -> float:
        """The largest finite |x| nu(x) over the states (..., n); 0 for a kernel that does not mind."""
        if x.is_meta or self.kernel.log_gain(x) is None:
            return 0.0
        reach = over_rows(lambda at: at.norm(dim=-1) * self.centers.radius(at), x).detach()
        known = torch.where(torch.isfinite(reach), reach, 0.0)
        return float(known.max()) if known.numel() else 0.0

    def warn_reach(self, worst: float, stacklevel: int = 2) -> bool:
        """`check_reach` where the largest |x| nu(x) is known."""
        if worst > 1:
            warnings.warn(
                f"|x| r = {worst:.3g} > 1: around such states {type(self.kernel).__name__} changes by more "
                "than a factor e within the ball, and the approximation degrades. Shrink the radius, or use "
                "GaussianKernel, whose accuracy does not depend on the state.",
                stacklevel=stacklevel,
            )
        return worst > 1

    def check_own_value(self, x: Tensor, stacklevel: int = 2) -> bool:
        """Warn, and say so, where sigma(x; x) is the same at every state: w'sigma(x; x) is then a constant.

        It is so for a kernel of y - c alone and offsets c - y that do not depend on the state, whatever they
        are called; found by evaluation at the states x (..., n), at four around each and at the origin.
        """
        self._unseen = False
        states = values_of(x)
        change = torch.inf if states is None else self._own_change(states)
        if change > 1e-7:
            return False
        kernel = type(self.kernel).__name__
        moving = "centers at a `StateRadius`, " if bool((self.centers.directions != 0).any()) else ""
        warnings.warn(
            f"StaFBasis of {kernel} has the same values at every state that it stands around (largest "
            f"relative change of basis(x, x) between states: {change:.2g}): V^(x) = basis(x, x) @ w is a "
            f"constant unless w depends on x. Take `AnchoredKernel({kernel}(...))`, `ExponentialKernel()`, "
            f"{moving}or such weights.",
            stacklevel=beyond_rows(stacklevel),
        )
        return True

    def check_learned(self) -> None:
        """Refuse learned hyperparameters that have left their rules, before a compiled program reads them.

        Raises:
            ValueError: by `numerics.checks.kept`, where kernel, radius or centers read one.
        """
        if learns(self):
            zero = self.centers.directions.new_zeros(1, self.dim)
            with torch.no_grad():
                self(zero.unsqueeze(-2) + 1, zero)

    @torch.no_grad()
    def _own_change(self, x: Tensor) -> float:
        """The largest change of sigma(x; x) between states, of its largest entry; inf where not finite."""
        at = x if x.shape[-1] == self.dim else x.new_zeros(self.dim)  # a batch of `vmap` may come last
        at = torch.where(torch.isfinite(at), at, 0.0).double()
        axis = torch.arange(1, self.dim + 1, dtype=at.dtype, device=at.device)
        size = 1 + at.norm(dim=-1, keepdim=True)
        around = [at + s * size * (s * axis).cos() for s in (0.1, 0.5, 1.0, 3.0)]
        found = torch.stack(
            [self.kernel(p.unsqueeze(-2), self.centers(p)) for p in (at, torch.zeros_like(at), *around)]
        )
        change = (found - found[:1]).abs().amax() / found.abs().amax().clamp(min=torch.finfo(at.dtype).tiny)
        seen = values_of(change)  # one each where `vmap` runs over hyperparameters
        return torch.inf if seen is None else float(torch.where(torch.isfinite(seen), seen, torch.inf).max())

    def values(self, x: Tensor, target: Target, outputs: int | None = None) -> Tensor:
        """V(c(x)): (..., n) -> (..., M); of a target with k outputs (k, ..., M).

        Raises:
            ValueError: if the target returns another shape, or is a network of another precision.
        """
        centers = self.centers(x)
        try:
            found = target(centers)
        except (RuntimeError, TypeError) as error:
            if not callable(target):
                raise fail("StaFBasis", "target", "must be a function of points (..., n)", target) from error
            if "dtype" not in str(error):
                raise
            raise ValueError(
                f"The target must take points of {centers.dtype}, in which this basis computes: write "
                f"`net.double()`, or `lambda x: net(x.float())` for 7 digits; torch's error: {error}"
            ) from error
        values = sampled(target, found, centers, outputs)
        return values if outputs is None else values.movedim(-1, 0)

    @beside
    def ideal_weights(self, x: Tensor, target: Target) -> Tensor:
        """w = K(c(x))^-1 V(c(x)), the minimiser of the native-space error: (..., n) -> (..., M).

        Differentiable: dw/dx = K^-1 (dV(c)/dx - (dK/dx) w). A row in which w cannot be represented
        (e^{-|x|^2} underflows, or the radius is too small) is NaN; `StaF` holds coefficients that never are.

        Source: Rosenfeld et al., eq. (5), and the normal equations of its quadratic.
        """
        space = self.local(x)
        return space.weights(space.fit(self.values(x, target)))

    def excess(self, weights: Tensor, x: Tensor, target: Target) -> Tensor:
        """F(a, c) - F(w, c) = (a - w)'K(a - w) for weights a at the states x: (..., M) -> (...).

        F itself is infinite where V is not in the kernel's space; its excess never is.
        """
        trailing("StaFBasis.excess", "weights", weights, dims=1, last=self.count)
        beside_batch("StaFBasis.excess", "weights", weights, 1, x.shape[:-1], "x is")
        difference = weights - self.ideal_weights(x, target)
        product = (self.gram(x) @ difference.unsqueeze(-1)).squeeze(-1)
        excess: Tensor = torch.linalg.vecdot(difference, product)
        return excess

    def check_convention(self, call: str, stored: Tensor) -> None:
        """Refuse coefficients that were saved with a `convention` in which they mean another function.

        Args:
            call: the function that was called, for the message.
            stored: the `convention` that was saved.

        Raises:
            ValueError: if they mean another function here, and why.
        """
        compare(call, decode(call, stored), self._record())

    def _record(self) -> dict[str, Any]:
        return record(self.kernel, self.centers, self._local_basis.kind, self._local_basis.degrees)

    def _prepare(self) -> None:
        """Set up what depends on fixed tensors alone, again whenever others are loaded."""
        self._local_basis.prepare(self.kernel, self.centers)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any, **keywords: Any
    ) -> None:
        key = f"{prefix}convention"
        self._choose_again = key not in state_dict and f"{prefix}centers.directions" in state_dict
        if key in state_dict:
            call, stored = f"{type(self).__name__}.load_state_dict", state_dict[key]
            self.check_convention(call, stored)
            saved = decode(call, stored)
            if "degrees" in saved:
                self._local_basis.degrees = Degrees.of(saved["degrees"])
            device = stored.device if self.convention.is_meta else self.convention.device
            state_dict[key] = self.convention = encode(saved).to(device)
        super()._load_from_state_dict(state_dict, prefix, *arguments, **keywords)

    @staticmethod
    def _after_loading(module: nn.Module, _: object) -> None:
        assert isinstance(module, StaFBasis)
        if module._choose_again:
            module._local_basis = LocalBasis(module.kernel, module.centers.directions)
            module.convention = encode(module._record()).to(module.convention.device)
        module._prepare()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._prepare()  # in the new dtype, on the new device
        return self


def _same(y: Tensor, x: Tensor) -> bool:
    """Return whether the points y (..., P, n) are the states x themselves, as far as values can be seen."""
    if y.shape not in (x.shape, x.unsqueeze(-2).shape) or y.numel() == 0:
        return False
    points, states = values_of(y), values_of(x)
    if points is None or states is None:
        return False
    return points.data_ptr() == states.data_ptr() or (
        points.is_cpu and torch.equal(points.flatten(), states.flatten())
    )
