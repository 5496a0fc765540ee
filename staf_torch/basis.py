"""A kernel and its state-following centers: what is needed at a state to approximate around it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ._checks import sampled, trailing
from ._convention import FORMAT, compare, decode, described, encode
from .centers import StateFollowingCenters
from .kernels import Kernel, PolynomialKernel
from .local import (
    SERIES_BELOW,
    Degrees,
    GradedBasis,
    GradedSpace,
    LocalSpace,
    choose,
    graded_basis,
    newton_space,
    polynomial_space,
)

Target = Callable[[Tensor], Tensor]
"""A function V to approximate: points (..., n) to values (...)."""


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
        scale = self.scale
        return self.core if scale is None else scale.unsqueeze(-1) * self.core * scale.unsqueeze(-2)

    def quadratic(self, v: Tensor) -> Tensor:
        """v'S K0 S v without S K0 S: (..., M) -> (...)."""
        u = v if self.log_scale is None else self.log_scale.exp() * v
        product = self.core[..., 0] * u[..., :1]
        for j in range(1, u.shape[-1]):  # a column at a time: no (..., M, M), no bits from other rows
            product = torch.addcmul(product, self.core[..., j], u[..., j : j + 1])
        quadratic: Tensor = torch.linalg.vecdot(u, product)
        return quadratic


class StaFBasis(nn.Module):
    """The StaF basis sigma_i(y; x) = k(y, c_i(x)), i = 1..M.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> x = torch.tensor([1.0, 0.0], dtype=torch.float64)
        >>> basis.ideal_weights(x, targets.Paper()).shape
        torch.Size([3])

    Hyperparameters that kernel, centers and radius were given as `nn.Parameter` are learned, others fixed.
    The buffer `convention` says in a state_dict what coefficients beside it mean: `check_convention`.

    Args:
        kernel: the kernel k.
        centers: the state-following centers c_i.

    Raises:
        ValueError: if an argument is of another type, or there are more centers than the kernel's
            function space has dimensions (polynomial kernels).

    Source: Rosenfeld et al., section 2.
    """

    _choose_again = False  # whether directions came without what fixes their local basis

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
        self.kernel = kernel
        self.centers = centers
        self._kind, self._degrees = choose(kernel, centers.directions)
        self.register_buffer("convention", encode(self._record()))
        self.convention: Tensor
        self._prepare()
        self.register_load_state_dict_post_hook(StaFBasis._after_loading)  # type: ignore[no-untyped-call]

    def _prepare(self) -> None:
        """Set up what depends on fixed directions alone, again whenever others are loaded."""
        directions, degrees = self.centers.directions, self._degrees
        self._graded: GradedBasis | None = None
        self._prepared_for: Tensor | None = None
        self._narrow: tuple[Tensor, Tensor] | None = None
        self._analytic = self._kind == "graded" and self._series_serves()
        if self._kind == "graded" and not isinstance(directions, nn.Parameter) and not directions.is_meta:
            self._graded = graded_basis(directions, degrees)
            self._narrow = self._graded.narrow(directions)
            self._prepared_for = directions

    def _series_serves(self) -> bool:
        """Whether one series in the squared radius serves the fits at all states, see `Interpolation`."""
        rate, bound = self.kernel.exponent_rate(), self.centers.radius.bound()
        if rate is None or bound is None or self._degrees is None or bound.is_meta:
            return False
        if any(True for part in (self.kernel, self.centers.radius) for _ in part.parameters()):
            return False  # what is learned may grow, and has derivatives that the series' setup has not
        return bool((rate * (bound * self._degrees.reach).square()).amax() <= SERIES_BELOW)

    def _bound(self) -> Tensor | None:
        """sup nu over all states where one series serves; as prepared where a compiler is tracing."""
        serves = self._analytic if torch.compiler.is_compiling() else self._series_serves()
        return self.centers.radius.bound() if serves else None

    def _basis_of(self, directions: Tensor) -> tuple[GradedBasis, Tensor, Tensor]:
        """The graded basis of the directions, with what an evaluation needs in their dtype."""
        # Directions that were swapped in from outside (functional_call, a parametrization) are other ones.
        exporting = torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
        if self._graded is not None and self._narrow is not None:
            ours = "directions" in self.centers._buffers if exporting else directions is self._prepared_for
            if ours:
                return self._graded, *self._narrow
        graded = graded_basis(directions, self._degrees)
        return graded, *graded.narrow(directions)

    def _record(self) -> dict[str, Any]:
        """What coefficients mean, beside the tensors of the state_dict."""
        record = {"format": FORMAT, "kernel": described(self.kernel), "basis": self._kind}
        record |= {"radius": described(self.centers.radius), "centers": [self.count, self.dim]}
        return record if self._degrees is None else record | {"degrees": self._degrees._asdict()}

    def check_convention(self, call: str, stored: Tensor) -> None:
        """Whether coefficients that were saved with this `convention` mean the same function here.

        Raises:
            ValueError: if they do not, and why.
        """
        compare(call, decode(call, stored), self._record())

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any, **keywords: Any
    ) -> None:
        key = f"{prefix}convention"
        self._choose_again = key not in state_dict and f"{prefix}centers.directions" in state_dict
        if key in state_dict:
            self.check_convention("StaFBasis.load_state_dict", state_dict[key])
            record = decode("StaFBasis.load_state_dict", state_dict[key])
            if self._degrees is not None:
                self._degrees = Degrees.of(record["degrees"])
            state_dict[key] = self.convention = encode(record).to(self.convention.device)
        super()._load_from_state_dict(state_dict, prefix, *arguments, **keywords)

    @staticmethod
    def _after_loading(module: nn.Module, _: object) -> None:
        assert isinstance(module, StaFBasis)
        if module._choose_again:
            module._kind, module._degrees = choose(module.kernel, module.centers.directions)
            module.convention = encode(module._record()).to(module.convention.device)
        module._prepare()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> StaFBasis:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._prepare()  # in the new dtype, on the new device
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "convention" not in state.get("_buffers", {}):
            raise ValueError(
                "`StaFBasis` was pickled by an earlier version of staf_torch, whose coefficients mean "
                "another function here: sample it with that version, and fit the samples anew."
            )
        super().__setstate__(state)  # type: ignore[no-untyped-call]

    @property
    def count(self) -> int:
        """M, the number of basis functions."""
        return self.centers.count

    @property
    def dim(self) -> int:
        """n, the dimension of the state."""
        return self.centers.dim

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        """sigma(y; x): (..., P, n), (..., n) -> (..., P, M)."""
        trailing("StaFBasis", "y", y, dims=2, last=self.dim)
        sigma: Tensor = self.kernel(y, self.centers(x))
        return sigma

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
        centers, degrees = self.centers, self._degrees
        if self._kind == "newton" or degrees is None:
            return newton_space(self.kernel, x, centers.offsets(x))
        directions = centers.directions
        if self._kind == "polynomial":
            assert isinstance(self.kernel, PolynomialKernel)
            return polynomial_space(self.kernel, x, centers.radius(x), directions.to(x), degrees)
        rate = self.kernel.exponent_rate()
        assert rate is not None
        graded, units, spread = self._basis_of(directions)
        return GradedSpace(
            kernel=self.kernel,
            state=x,
            nu=centers.radius(x),
            directions=directions.to(x),
            units=units.to(x),
            spread=spread.to(x),
            basis=graded,
            rate=rate.to(x),
            bound=self._bound,
            meeting=not centers.radius.constant,
        )

    def check_reach(self, x: Tensor, stacklevel: int = 3) -> bool:
        """Warn, and say so, where the exponential kernel is a poor choice: |x| nu(x) > 1 at a state (..., n).

        exp(y'c) then changes by more than e over the ball, with the state and not with V.
        """
        if self.kernel.log_gain(x) is None:
            return False
        reach = (x.norm(dim=-1) * self.centers.radius(x)).detach()
        return self.warn_reach(float(torch.where(torch.isfinite(reach), reach, 0.0).max()), stacklevel + 1)

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

    def values(self, x: Tensor, target: Target, outputs: int | None = None) -> Tensor:
        """V(c(x)): (..., n) -> (..., M); of a target with k outputs (k, ..., M)."""
        centers = self.centers(x)
        values = sampled(target, target(centers), centers, outputs)
        return values if outputs is None else values.movedim(-1, 0)

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
        difference = weights - self.ideal_weights(x, target)
        product = (self.gram(x) @ difference.unsqueeze(-1)).squeeze(-1)
        excess: Tensor = torch.linalg.vecdot(difference, product)
        return excess
