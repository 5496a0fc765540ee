"""Which local basis a kernel and its centers get, and what of it is prepared once."""

from __future__ import annotations

import functools

import torch
from torch import Tensor, nn

from ..centers import StateFollowingCenters
from ..kernels import Kernel, PolynomialKernel
from ..lanes.per_row.objects import made_by_rows
from ..lanes.row_numbers import all_rows, resolving
from ..lanes.trace.loops import untraced
from .base import LocalSpace
from .elimination import Degrees, degrees_of
from .graded import SERIES_BELOW, GradedBasis, GradedSpace, graded_basis
from .newton import newton_space
from .polynomial import polynomial_space


class LocalBasis:
    """The kind of local basis of a kernel and its centers, with what depends on fixed directions alone.

    Kernel and centers come as arguments of every method: their tensors may be swapped from outside
    (`torch.func.functional_call`), and they are parts of one module alone.

    Args:
        kernel: the kernel.
        directions: of the centers, (M, n).

    Raises:
        ValueError: if directions coincide to rounding, for a graded basis.

    Attributes:
        kind: "graded", "polynomial" or "newton".
        degrees: what fixes the basis for these directions; None where nothing has to, and on the meta device,
            where there are no values to find it from: it then comes with a state_dict.
        graded: the graded basis of fixed directions; None for other kinds, and for learned directions.
    """

    def __init__(self, kernel: Kernel, directions: Tensor) -> None:
        self.kind, self.degrees = choose(kernel, directions)
        self.graded: GradedBasis | None = None
        self._prepared_for: Tensor | None = None
        self._narrow: tuple[Tensor, Tensor] | None = None
        self._analytic = False

    def prepare(self, kernel: Kernel, centers: StateFollowingCenters) -> None:
        """Set up what depends on fixed directions, again whenever they or their dtype change."""
        directions = centers.directions
        self.graded = self._prepared_for = self._narrow = None
        self._analytic = self.kind == "graded" and self._series_serves(kernel, centers)
        if self.degrees is None:
            return  # nothing has to, or it comes with a state_dict
        if self.kind == "graded" and not isinstance(directions, nn.Parameter) and not directions.is_meta:
            self.graded = made_by_rows(lambda: graded_basis(directions, self.degrees))
            self._narrow = self.graded.narrow(directions)
            self._prepared_for = directions

    def space(self, kernel: Kernel, centers: StateFollowingCenters, x: Tensor) -> LocalSpace:
        """Return the span of the kernels at the states x (..., n), in this basis."""
        degrees = self.degrees
        if self.kind != "newton" and degrees is None and not x.is_meta:
            raise ValueError(
                "`StaFBasis` built on the meta device must be given its values first: "
                "`to_empty(device=...)`, then `load_state_dict`."
            )
        if degrees is None or x.is_meta:  # where all kinds differ in nothing
            return newton_space(kernel, x, centers.offsets(x))
        directions = centers.directions
        if self.kind == "polynomial":
            assert isinstance(kernel, PolynomialKernel)
            return polynomial_space(kernel, x, centers.radius(x), directions.to(x), degrees)
        rate = kernel.exponent_rate()
        assert rate is not None
        graded, units, spread = self._of(centers)
        nu = centers.radius(x)
        return GradedSpace(
            kernel=kernel,
            state=x,
            nu=nu,
            radius=nu * graded.reach,
            directions=directions.to(x),
            units=units.to(x),
            spread=spread.to(x),
            basis=graded,
            rate=rate.to(x),
            bound=functools.partial(self._bound, kernel, centers),
            meeting=not centers.radius.constant,
        )

    def _series_serves(self, kernel: Kernel, centers: StateFollowingCenters) -> bool:
        """Return whether one series in the squared radius serves the fits at all states: `Interpolation`."""
        if any(True for part in (kernel, centers.radius) for _ in part.parameters()):
            return False  # what is learned may grow, and has derivatives that the series' setup has not
        with untraced(), resolving(None):
            rate, bound = kernel.exponent_rate(), centers.radius.bound()
            if rate is None or bound is None or self.degrees is None or bound.is_meta:
                return False
            return bool(all_rows(rate * (bound * self.degrees.reach).square()).amax() <= SERIES_BELOW)

    def _bound(self, kernel: Kernel, centers: StateFollowingCenters) -> Tensor | None:
        """Return sup nu over all states where one series serves; as prepared where a compiler is tracing."""
        serves = self._analytic if torch.compiler.is_compiling() else self._series_serves(kernel, centers)
        return centers.radius.bound() if serves else None

    def _of(self, centers: StateFollowingCenters) -> tuple[GradedBasis, Tensor, Tensor]:
        """Return the graded basis of the directions, with what an evaluation needs in their dtype."""
        directions = centers.directions
        # Directions that were swapped in from outside (functional_call, a parametrization) are other ones.
        exporting = torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
        if self.graded is not None and self._narrow is not None:
            ours = "directions" in centers._buffers if exporting else directions is self._prepared_for
            if ours:
                return self.graded, *self._narrow
        graded = graded_basis(directions, self.degrees)
        return graded, *graded.narrow(directions)


def choose(kernel: Kernel, directions: Tensor) -> tuple[str, Degrees | None]:
    """Return the kind of local basis, and what fixes it for these directions (M, n); None: nothing has to.

    Raises:
        ValueError: if directions coincide to rounding, for a graded basis.
    """
    if kernel.exponent_rate() is not None:
        return "graded", None if directions.is_meta else made_by_rows(lambda: degrees_of(directions))
    highest = kernel.polynomial_degree()
    if highest is not None and directions.is_meta:
        return "polynomial", None
    if highest is not None:
        degrees = made_by_rows(lambda: degrees_of(directions))
        # A functional of a higher degree than the kernel's sees nothing: a case for the Newton basis.
        if len(degrees.sizes()) <= highest + 1:
            return "polynomial", degrees
    return "newton", None
