"""The functions that stand for a Gaussian process around a moving state."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from ..linalg import pivoted_cholesky

_JUMP = 4.0  # radii: beyond, a kernel whose scale grows with the state says nothing about the new one


class Features(NamedTuple):
    """The process at some points: V = e^{s(x, z)} (psi'u + rest), the rest of variance k0(z, z) - psi'psi."""

    functions: Tensor  # psi, (M, S)
    variance: Tensor  # k0(z, z), (S,)
    log_factor: Tensor | None  # s(x, z), (S,); None for zeros


class LocalFrame(NamedTuple):
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

    @classmethod
    def of(cls, kernel: Kernel, offsets: Tensor) -> LocalFrame:
        """The frame of centers at the offsets (M, n), float64."""
        zero = offsets.new_zeros(offsets.shape[-1])
        shared = _newton(kernel.core(zero, offsets, offsets)) if kernel.state_free else None
        return cls(kernel, offsets, shared)

    def features(self, x: Tensor, z: Tensor) -> Features:
        """psi at x + z: (n, S), (n, S) -> `Features`, in the dtype of z."""
        state, at = x.mT.double(), z.mT.double()
        if self.shared is not None:  # all streams are points around one state
            core = self.kernel.core(torch.zeros_like(self.offsets[0]), at, self.offsets)
            functions = self.shared.mT @ core.mT
        else:
            core = self.kernel.core(state, at.unsqueeze(-2), self.offsets)
            functions = (core @ self._newton(state)).squeeze(-2).mT
        scale = self.kernel.log_scale(state, at.unsqueeze(-2))
        log_factor = None if scale is None else scale.squeeze(-1).to(z)
        return Features(functions.to(z), self._variance(state, at).to(z), log_factor)

    def transfer(self, x: Tensor, step: Tensor) -> tuple[Tensor, Tensor | None]:
        """What becomes of u when the state x moves by h: u' = e^f T u; T alone for what was known of it.

        T = C'(x + h) diag(m) k0(h + d, d) C(x) with m_i = e^{s(x, h + d_i) - s(x + h, d_i) - f}, and
        f = (g(x + h) - g(x))/2: the local function at the new centers, fitted there. T is the compression of
        a unitary translation, so that |T| <= 1. For k0 = exp(q z'd) the spans at two states differ by the
        factor e^{-q h'z} alone, which m carries.

        Args:
            x: (n, R).
            step: h, (n, R).

        Returns:
            T' (M, M, R), the columns of T first, and e^f, (R,), None for ones.
        """
        state, h, d = x.mT.double(), step.mT.double(), self.offsets
        moved, points = state + h, h + d.unsqueeze(1)  # (R, n), (M, R, n)
        if self.shared is not None:
            core = self.kernel.core(torch.zeros_like(d[0]), points.flatten(0, 1), d)
            rows = (self.shared.mT @ core.mT).unflatten(-1, points.shape[:2])
        else:
            at = self.kernel.core(state, points.transpose(0, 1), d) @ self._newton(state)
            rows = at.permute(2, 1, 0)
        log_factor, half = self._factors(state, moved, points.transpose(0, 1))
        if log_factor is not None:
            rows = rows * log_factor.mT.exp()
        if self.shared is not None:
            columns = self.shared.mT @ rows
        else:
            columns = (rows.permute(2, 0, 1) @ self._newton(moved)).permute(1, 2, 0)
        return columns.to(step), None if half is None else half.exp().to(step)

    def _factors(self, state: Tensor, moved: Tensor, points: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """log m, (R, M), -inf after a jump, and f, (R,); None for zeros."""
        here, there = self.kernel.log_scale(state, points), self.kernel.log_scale(moved, self.offsets)
        log_factor = None if here is None or there is None else here - there
        g, g_moved = self.kernel.log_gain(state), self.kernel.log_gain(moved)
        if g is None or g_moved is None or log_factor is None:
            return log_factor, None
        near = (moved - state).square().sum(-1) <= _JUMP**2 * self.offsets.square().sum(-1).amax()
        half = torch.where(near, (g_moved - g) / 2, 0.0)
        return torch.where(near.unsqueeze(-1), log_factor - half.unsqueeze(-1), -torch.inf), half

    def _newton(self, state: Tensor) -> Tensor:
        return _newton(self.kernel.core(state, self.offsets, self.offsets))

    def _variance(self, state: Tensor, z: Tensor) -> Tensor:
        """k0(z, z): (S, n), (S, n) -> (S,)."""
        rate = self.kernel.exponent_rate()
        if rate is not None:
            return (z.square().sum(-1) * rate).exp()
        point = z.unsqueeze(-2)
        return self.kernel.core(state, point, point).flatten()


def _newton(gram: Tensor) -> Tensor:
    """C = P'L^-T of K0 (..., M, M), with zero columns beyond the rank: (..., M, M)."""
    factor = pivoted_cholesky(gram)
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    columns = [factor.solve_upper(unit.expand(factor.order.shape)) for unit in units]
    return torch.stack(columns, dim=-1)
