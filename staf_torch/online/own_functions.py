"""Streams with a kernel, a radius, a noise of their own: numbers of rows, a row a stream."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from ..lanes.row_numbers import RowNumbers, all_rows, columns
from ..numerics.checks import fail, fails, own_number
from ..numerics.linalg import root
from ..numerics.pivoted_cholesky import newton_basis

NAMES = ("radius", "noise", "amplitude", "forgetting", "follow", "robust")
"""Arguments of `StaFRegressor` that may be one a stream, beside the hyperparameters of its kernel."""
_FAR = 1e8  # radii, as in `LocalFunctions`


class OwnFunctions(NamedTuple):
    """`LocalFunctions` of a stationary kernel with an exponent rate, with offsets and a rate a stream."""

    offsets: Tensor  # d, (M, n, S)
    rate: Tensor  # q, (S,)
    shared: Tensor  # C, (M, M, S), upper triangular: the centers are in the order of the pivots
    gram: Tensor  # K0, (M, M, S)

    @classmethod
    def of(cls, rate: Tensor, offsets: Tensor) -> OwnFunctions:
        """The local functions of rates (S,) and offsets (S, M, n), float64."""

        def gram_of(d: Tensor) -> Tensor:
            return (rate[:, None, None] * (d @ d.mT)).exp()

        newton = newton_basis(gram_of(offsets))
        order = (newton == 0).long().cumprod(2).sum(2).argsort(1)[..., None]
        newton = newton.gather(1, order.expand_as(newton))
        offsets = offsets.gather(1, order.expand_as(offsets))
        parts = (part.permute(1, 2, 0) for part in (newton, gram_of(offsets)))
        return cls(offsets.permute(1, 2, 0), rate, *parts)

    def of_rows(self, rows: Tensor) -> OwnFunctions:
        """Those of the streams with these numbers."""
        return OwnFunctions(*(part[..., rows] for part in self))

    def fixed(self) -> dict[str, Tensor]:
        """Return the tensors that a loaded state must share."""
        return {"offsets": self.offsets, "gram": self.gram}

    def local(self, x: Tensor, z: Tensor) -> tuple[Tensor, None]:
        """psi at x + z, (M, S), and no log factor: (n, S), (n, S)."""
        apart = (z.double() - self.offsets).square().sum(1)
        near = (self.rate / 2 * (self.offsets.square().sum(1) - apart)).exp()
        return (self.shared * near.unsqueeze(1)).sum(0).to(z), None

    def prior(self, x: Tensor, z: Tensor) -> float:
        """The variance of V before any sample."""
        return 1.0

    def transfer(self, x: Tensor, step: Tensor) -> tuple[Tensor, None]:
        """T (M, M, S) of a step (n, S), as `LocalFunctions.transfer`."""
        reach = self.offsets.square().sum(1).amax(0).clamp(min=1e-300).sqrt()
        near = (step.double() / reach).square().sum(0) <= _FAR**2
        h = torch.where(near, step.double(), 0.0)
        along = self.rate * (self.offsets * h).sum(1)  # (M, S)
        shift, lost = self.rate * root(h.square().sum(0)) * reach, self.rate * h.square().sum(0) / 2
        before, after = (along - shift).exp(), (shift - along - lost).clamp(max=700.0).exp()
        moved = torch.einsum("jis,jls->ils", self.gram, before.unsqueeze(1) * self.shared)
        found = torch.einsum("iks,ils->kls", self.shared, after.unsqueeze(1) * moved)
        return torch.where(near, found, 0.0).to(step), None


def has_rows(numbers: dict[str, Any], kernel: Kernel) -> bool:
    """Return whether arguments or a kernel have numbers of rows."""
    found = (*numbers.values(), *kernel.buffers(), *kernel.parameters())
    return any(isinstance(value, RowNumbers) for value in found)


def own_law(
    call: str, numbers: dict[str, Any], dtype: torch.dtype, streams: int, like: Tensor
) -> dict[str, Tensor]:
    """Return the checked arguments, (S,) each.

    Args:
        call: in whose name an error speaks.
        numbers: of `NAMES`.
        dtype: of the streams.
        streams: S.
        like: a tensor where they are to be.
    """

    def column(name: str, value: Any) -> Tensor:
        sign = "not negative" if name == "follow" else "positive"
        checked = own_number(call, name, value, sign)
        if isinstance(checked, RowNumbers):
            return columns([checked], streams)[0].to(like.device).double()
        if isinstance(checked, Tensor):
            return checked.to(like.device).double().expand(streams)
        return like.new_full((streams,), checked, dtype=torch.float64)

    found = {name: column(name, value) for name, value in numbers.items() if value is not None}
    found.setdefault("robust", like.new_full((streams,), torch.inf, dtype=torch.float64))
    least = math.sqrt(64 * torch.finfo(dtype).eps)
    rules = (
        ("noise", found["noise"] >= least * found["amplitude"], f"must be at least {least:.1e} amplitude"),
        ("forgetting", found["forgetting"] <= 1, "must be in (0, 1]"),
    )
    for name, held, rule in rules:
        if fails(held):
            row = int((~held).nonzero()[0])
            raise fail(
                call, name, f"{rule} in every row, which it is not in row {row}", float(found[name][row])
            )
    return found


def own_functions(call: str, kernel: Kernel, radius: Tensor, toward: Tensor) -> OwnFunctions:
    """The local functions of a kernel with numbers of rows, or of radii (S,), around directions (M, n)."""
    rate = kernel.exponent_rate()
    if rate is None or not kernel.state_free or kernel.log_gain(toward[:1]) is not None:
        raise fail(call, "kernel", "must be a `GaussianKernel` beside numbers of rows", kernel)
    rates = (
        columns([rate], len(radius))[0]
        if isinstance(rate, RowNumbers)
        else all_rows(rate).expand(len(radius))
    )
    return OwnFunctions.of(rates.to(radius.device).double(), radius[:, None, None] * toward.double())
