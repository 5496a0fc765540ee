"""Functions that stand for a Gaussian process around a moving state, alike or of a stream's own."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from ..lanes.row_numbers import RowNumbers, all_rows, columns
from ..numerics.checks import fail, fails, own_number
from ..numerics.linalg import newton_basis, root

_JUMP = 4.0  # radii: beyond, a kernel whose scale grows with the state says nothing about the new one
_FAR = 1e8  # radii: beyond, no kernel does, and the squares of a user's kernel may overflow
NAMES = ("radius", "noise", "amplitude", "forgetting", "follow", "robust")
"""Arguments of `StaFRegressor` that may be one a stream, beside the hyperparameters of its kernel."""


class LocalFunctions(NamedTuple):
    """An orthonormal basis psi(z) = k0(z, d) C of the span of the kernels at the centers x + d.

    With P K0 P' = L L' it is the Newton basis, C = P'L^-T. A Gaussian process with the covariance k is then
    V(x + z) = e^{s(x, z)} (psi(z)'u + rest) with u ~ N(0, I) and a rest, independent of u, that vanishes at
    the centers. Its amplitude is 1 at the state: the kernel's gain e^{g(x)} is left out.

    Streams are the last dimension, S. Where the kernel is state-free one C serves all states. Computed in
    float64 whatever the dtype of the streams: C has entries as large as the conditioning of K0 makes them.
    """

    kernel: Kernel
    offsets: Tensor  # d, (M, n)
    shared: Tensor | None  # C, (M, M), for a state-free kernel
    rate: Tensor | None  # q, where k0(z, d) = exp(q z'd)
    pairs: Tensor | None  # with it, k0(d_i, d_j) C_jl in row (i, l), column j: (M M, M)

    @classmethod
    def of(cls, kernel: Kernel, offsets: Tensor) -> LocalFunctions:
        """The local functions of centers at the offsets (M, n), float64."""
        zero = offsets.new_zeros(offsets.shape[-1])
        if not kernel.state_free:
            return cls(kernel, offsets, None, None, None)
        gram = kernel.core(zero, offsets, offsets)
        shared, rate = newton_basis(gram), kernel.exponent_rate()
        pairs = None if rate is None else (gram.unsqueeze(1) * shared.mT).flatten(0, 1)
        return cls(kernel, offsets, shared, rate, pairs)

    def of_rows(self, rows: Tensor) -> LocalFunctions:
        """Those of some streams: these."""
        return self

    def fixed(self) -> dict[str, Tensor]:
        """Return the tensors that a loaded state must share: the centers, and the kernel at them."""
        zero = torch.zeros_like(self.offsets[0])
        return {"offsets": self.offsets, "gram": self.kernel.core(zero, self.offsets, self.offsets).detach()}

    def functions(self, x: Tensor, z: Tensor) -> Tensor:
        """psi at x + z: (n, S), (n, S) -> (M, S), in the dtype of z."""
        wide = z.double()
        if self.shared is None:
            state = x.mT.double()
            core = self.kernel.core(state, wide.mT.unsqueeze(-2), self.offsets)
            return (core @ self._newton(state)).squeeze(-2).mT.to(z)
        if self.rate is not None:
            return (self.shared.mT @ ((self.rate * self.offsets) @ wide).exp()).to(z)
        # All streams are points around one state.
        core = self.kernel.core(torch.zeros_like(self.offsets[0]), wide.mT, self.offsets)
        return (self.shared.mT @ core.mT).to(z)

    def variance(self, x: Tensor, z: Tensor) -> Tensor:
        """k0(z, z), of which psi'psi is what the centers explain: (n, S), (n, S) -> (S,)."""
        if self.rate is not None:
            return (z.square().sum(0) * self.rate).exp().to(z)
        point = z.mT.double().unsqueeze(-2)
        return self.kernel.core(x.mT.double(), point, point).flatten().to(z)

    def explained(self) -> float:
        """The least share of V's variance that the centers explain half way from the state to one of them.

        In [0, 1]; around the origin, for a kernel whose functions differ from state to state. NaN where the
        kernel overflows within the ball.
        """
        d = self.offsets
        gram = self.kernel.core(torch.zeros_like(d[0]), d, d)
        if not bool(torch.isfinite(gram).all()):  # the Newton basis of which is zero
            return math.nan
        z = d[(d != 0).any(-1)].mT / 2  # a center at the state explains all there
        if not z.numel():
            return 1.0
        psi = self.functions(torch.zeros_like(z), z)
        return float((psi.square().sum(0) / self.variance(torch.zeros_like(z), z)).amin())

    @property
    def stationary(self) -> bool:
        """Return whether k(x, x) is the same everywhere: e^s then goes into the functions."""
        return self.rate is not None and self.kernel.log_gain(self.offsets) is None

    def local(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return psi (M, S) and the log factor (S,), None for zeros, at x + z: (n, S), (n, S); the local
        functions are e^{log_factor} psi."""
        if self.rate is None or self.shared is None or not self.stationary:
            return self.functions(x, z), self.log_factor(x, z)
        # exp(q z'd - q z'z / 2) from z - d: no difference of two large numbers, whatever z is.
        apart = (z.double() - self.offsets.unsqueeze(-1)).square().sum(1)
        exponent = self.rate / 2 * (self.offsets.square().sum(-1, keepdim=True) - apart)
        return (self.shared.mT @ exponent.exp()).to(z), None

    def prior(self, x: Tensor, z: Tensor) -> Tensor | float:
        """The variance of V at x + z before any sample, in the units of `local`: (n, S), (n, S) -> (S,)."""
        return 1.0 if self.stationary else self.variance(x, z)

    def log_factor(self, x: Tensor, z: Tensor) -> Tensor | None:
        """s(x, z): (n, S), (n, S) -> (S,), None for zeros."""
        scale = self.kernel.log_scale(x.mT, z.mT.unsqueeze(-2))
        return None if scale is None else scale.squeeze(-1)

    def transfer(self, x: Tensor, step: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the map u' = e^f T u of the weights as x moves by h, (n, R) each; T alone maps what was
        learned.

        T = C'(x + h) diag(m) k0(h + d, d) C(x) with m_i = e^{s(x, h + d_i) - s(x + h, d_i) - f}, and f =
        (g(x + h) - g(x))/2: the local function at the new centers, fitted there. T is the compression of a
        unitary translation, so that |T| <= 1. For k0 = exp(q z'd) the spans at two states differ by the
        factor e^{-q h'z} alone, which m carries. T is (M, M, R); e^f is (R,), None for ones.
        """
        d = self.offsets
        reach = d.square().sum(-1).amax().clamp(min=1e-300).sqrt()
        most = _JUMP if self.kernel.log_gain(d) is not None else _FAR
        near = (step.double() / reach).square().sum(0) <= most**2
        state, h = x.mT.double(), torch.where(near, step.double(), 0.0)
        half = self._half(state, h.mT)
        if self.rate is not None and self.shared is not None and self.pairs is not None:
            exponent = (self.rate * d) @ h  # q h'd, (M, R)
            shift = self.rate * root(h.square().sum(0)) * reach  # so that neither exponential overflows
            rows = (self.pairs @ (exponent - shift).exp()).unflatten(0, (len(d), -1))
            lost = self.rate * h.square().sum(0) / 2
            rows = rows * (shift - exponent - lost).clamp(max=700.0).exp().unsqueeze(1)
            found = (self.shared.mT @ rows.flatten(1)).unflatten(-1, rows.shape[1:])
        else:
            found = self._dense(state, h)
        # After a jump too far for the kernel there is nothing to say: start afresh.
        found = torch.where(near, found, 0.0).to(step)
        return found, None if half is None else torch.where(near, half, 0.0).exp().to(step)

    def _dense(self, state: Tensor, h: Tensor) -> Tensor:
        """T for kernels without an exponent rate: (R, n), (n, R) -> (M, M, R)."""
        d, moved = self.offsets, state + h.mT
        points = (h + d.unsqueeze(-1)).permute(2, 0, 1)  # (R, M, n)
        here, there = self.kernel.log_scale(state, points), self.kernel.log_scale(moved, d)
        half = self._half(state, h.mT)
        if self.shared is None:
            core = self.kernel.core(state, points, d) @ self._newton(state)
            left = self._newton(moved).mT
        else:  # all points around one state
            zero = torch.zeros_like(d[0])
            core = self.kernel.core(zero, points.flatten(0, 1), d) @ self.shared
            core, left = core.unflatten(0, points.shape[:2]), self.shared.mT
        if here is not None and there is not None:
            core = core * (here - there).exp().unsqueeze(-1)
        if half is not None:
            core = core * (-half).exp()[:, None, None]
        return (left @ core).permute(1, 2, 0)

    def _half(self, state: Tensor, h: Tensor) -> Tensor | None:
        """f, (R, n), (R, n) -> (R,); None for zeros."""
        before, after = self.kernel.log_gain(state), self.kernel.log_gain(state + h)
        return None if before is None or after is None else (after - before) / 2

    def _newton(self, state: Tensor) -> Tensor:
        return newton_basis(self.kernel.core(state, self.offsets, self.offsets))


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
    """Return the checked arguments of `NAMES`, (S,) each, where the tensor ``like`` is."""

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
    least = math.sqrt(64 * torch.finfo(dtype).eps)  # less noise leaves no digit of the covariance
    enough = (found["noise"] / found["amplitude"]).square() >= 64 * torch.finfo(dtype).eps
    rules = (
        ("noise", enough, f"must be at least {least:.1e} amplitude in {dtype}"),
        ("forgetting", found["forgetting"] <= 1, "must be in (0, 1]"),
    )
    for name, held, rule in rules:
        if fails(held):
            row = int((~held).nonzero()[0])
            rule += f" in every row, which it is not in row {row}" if streams > 1 else ""
            raise fail(call, name, rule, float(found[name][row]))
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
