"""`StaF`: a local approximation as a torch module."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..lanes.gradients import refuse_gradient
from ..lanes.per_row.objects import refuse_rows
from ..lanes.threads import alone
from ..numerics.checks import beside_batch, choice, fail, fails, flag, hold, integer, trailing
from ..numerics.default_device import beside
from ..numerics.derivatives import row_jacobian
from ..numerics.rows import check_target
from .basis import StaFBasis, Target

_MODES = ("partial", "total_frozen_weights", "total")
_STARTS = ("random", "zeros")


class StaF(nn.Module):
    """V^(y; x) = sum_i w_i k(y, c_i(x)) around one state x a batch entry.

    The coefficients are held in the local basis at x, where they stay finite while the paper's weights w
    overflow; `weights` derives w from them. They are a parameter, or a buffer where they are not to be
    learned; the state is a buffer. Hyperparameters of the basis are learned where it was given them as
    `nn.Parameter`. `forward` changes nothing in the module. It computes in the module's precision, in float32
    where that is a half type, and returns that of its points: behind float32 layers it needs no `.float()`.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
        >>> staf = StaF(basis, batch_shape=(2,))
        >>> x = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
        >>> staf.fit_(x, targets.Paper())(x.unsqueeze(-2)).shape
        torch.Size([2, 1])

        Shown by `staf experiment=ablation`.

    Args:
        basis: kernel and centers.
        batch_shape: leading dimensions (...), independent approximations side by side.
        out_features: k, several functions over the same centers: targets then map (..., n) to (..., k), and
            values are (..., P, k), coefficients and weights (..., k, M). None: one function, without that
            dimension.
        init: where the coefficients begin, at the state 0. ``random``: V^ is near a random linear function of
            the size with which `nn.Linear` begins (without its constant where k(0, 0) = 0), so that gradients
            reach what is before and behind the layer from the first step. ``zeros``: V^ = 0. By default
            ``random`` where the coefficients are learnable; `fit_` replaces either.
        learnable: whether the coefficients are a parameter.
        dtype: of the coefficients and the state; by default that of the directions.
        device: likewise.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        basis: StaFBasis,
        batch_shape: tuple[int, ...] = (),
        out_features: int | None = None,
        *,
        init: str | None = None,
        learnable: bool = True,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(basis, StaFBasis):
            raise fail("StaF", "basis", "must be a StaFBasis", basis)
        refuse_rows("StaF", "`StaFBasis.ideal_weights` serves them", basis=basis)
        if out_features is not None:
            integer("StaF", "out_features", out_features, least=1)
        self.basis = basis
        if isinstance(batch_shape, int):
            raise fail("StaF", "batch_shape", f"must be a tuple: write `({batch_shape},)`", batch_shape)
        self.batch_shape, self.out_features = tuple(batch_shape), out_features
        outputs = () if out_features is None else (out_features,)
        like = basis.centers.directions.detach().new_empty((), dtype=dtype, device=device)
        zero = like.new_zeros(*self.batch_shape, *outputs, basis.count)
        self.coefficients = hold(
            self, "coefficients", nn.Parameter(zero) if flag("StaF", "learnable", learnable) else zero
        )
        self.init = _STARTS[0 if learnable else 1] if init is None else choice("StaF", "init", init, _STARTS)
        self.state = hold(self, "state", like.new_zeros(*self.batch_shape, basis.dim))
        self._target: Target | None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Back to the state 0 and to coefficients as `init` says, drawn anew."""
        with torch.no_grad():
            self.state.zero_()
            if self.init == "zeros" or self.coefficients.is_meta:
                self.coefficients.zero_()
            else:
                self.coefficients.copy_(self._random())
        self._remember(None)

    def _random(self) -> Tensor:
        """The coefficients of random linear functions around the state 0: (..., M), or (..., k, M)."""
        x, n = self.state.double(), self.basis.dim
        outputs = self.out_features or 1
        drawn = (
            2 * torch.rand(*self.batch_shape, outputs, n + 1, dtype=x.dtype, device=x.device) - 1
        ) / n**0.5
        corner = self.basis.kernel(x.new_zeros(1, n), x.new_zeros(1, n))
        drawn[..., n] *= bool(
            (corner > 0).all()
        )  # where k(0, 0) = 0 every function of the space vanishes at 0
        values = drawn[..., :n] @ self.basis.centers.offsets(x).mT + drawn[..., n:]
        return self.basis.local(x).fit(values.movedim(-2, 0)).movedim(0, -2).view_as(self.coefficients)

    @property
    def weights(self) -> Tensor:
        """The paper's w: (..., M), or (..., k, M).

        Raises:
            ValueError: if they cannot be represented in this dtype; the coefficients can.
        """
        w = self._weights()
        w = w if self.out_features is None else w.movedim(0, -2)
        lost = torch.isnan(w).any(-1) & torch.isfinite(self.coefficients).all(-1)
        if fails(~lost):
            rows = lost.nonzero().tolist() if lost.dim() else []
            where = f" of the batch entries {rows[:5]}" if rows else ""
            raise ValueError(
                f"`StaF.weights`{where} must be representable in {w.dtype}, but e^(-x'x) or a power of the "
                f"radius leaves its range: use `StaF.coefficients`, or the Gaussian kernel; "
                f"got |x| up to {float(self.state.norm(dim=-1).max()):.4g}."
            )
        return w

    @beside
    def fit_(self, x: Tensor, target: Target) -> StaF:
        """Move to the states x (..., n) and take the ideal coefficients of ``target`` there.

        A row whose samples are not finite gets coefficients that are not. No gradient goes through a fit;
        `StaFBasis.local` has one that does.

        Raises:
            ValueError: if x is not of the shape (*batch_shape, n), the target returns another shape, or one
                requires a gradient; the module then stays as it was.
        """
        trailing("StaF.fit_", "x", x, dims=1, last=self.basis.dim, meta=self.state.is_meta, vmap=False)
        if x.shape != self.state.shape:
            raise ValueError(
                f"`StaF.fit_(x=...)` must have the shape {tuple(self.state.shape)}; got {tuple(x.shape)}."
            )
        refuse_gradient("StaF.fit_", x=x, target=target)
        if x.numel():
            check_target(target, x, self.out_features)
        with torch.no_grad(), alone(x[..., 0].numel() * self.basis.count**2):
            x = _wide(x.to(self.state))
            self.basis.check_reach(x)
            coefficients = self.basis.local(x).fit(self.basis.values(x, target, self.out_features))
            coefficients = coefficients if self.out_features is None else coefficients.movedim(0, -2)
            self.state.copy_(x)
            if "parametrizations" in self._modules and parametrize.is_parametrized(self, "coefficients"):
                self.coefficients = coefficients  # by its right inverse
            else:
                self.coefficients.copy_(coefficients)
        self._remember(target)
        return self

    def forward(self, y: Tensor) -> Tensor:
        """V^(y; x): (..., P, n) -> (..., P), or (..., P, k). For one point a batch entry: `rowwise`.

        Raises:
            ValueError: if y has the shape (*batch_shape, n), which could mean either.
        """
        self._points("StaF", y, "`StaF.rowwise(y)`")
        x = _wide(self.state)
        return _in(y.dtype, self._values(x, _in(x.dtype, y) - x.unsqueeze(-2)))

    def rowwise(self, y: Tensor) -> Tensor:
        """V^ of each batch entry at its own point: (*batch_shape, n) -> batch_shape, or (*batch_shape, k).

        Example:
            >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(6), radius=0.1))
            >>> x = torch.rand(64, 2, dtype=torch.float64)
            >>> StaF(basis, batch_shape=(64,)).fit_(x, targets.Paper()).rowwise(x + 0.01).shape
            torch.Size([64])

        Args:
            y: one point a batch entry; more leading dimensions are further points.

        Raises:
            ValueError: if the shape does not end with (*batch_shape, n).
        """
        trailing("StaF.rowwise", "y", y, dims=1, last=self.basis.dim)
        if y.shape[:-1][y.dim() - self.state.dim() :] != self.state.shape[:-1] or y.dim() < self.state.dim():
            raise ValueError(
                f"`StaF.rowwise(y=...)` must have a shape that ends with {tuple(self.state.shape)}; got "
                f"{tuple(y.shape)}. For P points of every batch entry: `StaF(y)` with y (..., P, n)."
            )
        x = _wide(self.state)
        values = self._values(x, (_in(x.dtype, y) - x).unsqueeze(-2))
        return _in(y.dtype, values.squeeze(-1 if self.out_features is None else -2))

    def at_offsets(self, z: Tensor) -> Tensor:
        """V^(x + z; x): (..., P, n) -> (..., P), or (..., P, k).

        For radii near the rounding of x, where y - x has no digits left.
        """
        beside_batch("StaF.at_offsets", "z", z, 2, self.state.shape[:-1], "the coefficients are")
        x = _wide(self.state)
        return _in(z.dtype, self._values(x, _in(x.dtype, z)))

    def _values(self, x: Tensor, z: Tensor) -> Tensor:
        """V^ at offsets (..., P, n) from the state, all in the precision in which is computed."""
        return self._outputs_last(self.basis.local(x).evaluate(z, self._outputs_first(z.dim() - 2)))

    def value_and_gradient(
        self, y: Tensor, mode: str = "partial", target: Target | None = None
    ) -> tuple[Tensor, Tensor]:
        """V^(y; x) and its gradient, for less than the two apart.

        Args:
            y: (..., P, n).
            mode: of `gradient`. ``partial`` is in closed form for the exponential and Gaussian kernels.
            target: of `gradient`.

        Returns:
            (..., P) and (..., P, n), or (..., P, k) and (..., P, k, n).

        Raises:
            ValueError: for another mode, or ``total`` without a target.
        """
        choice("StaF.gradient", "mode", mode, _MODES)
        self._points("StaF.gradient", y, "`StaF.gradient(y.unsqueeze(-2)).squeeze(-2)`")
        x = _wide(self.state)
        given, y = y.dtype, _in(x.dtype, y)
        z = y - x.unsqueeze(-2)
        if mode != "partial":
            slope = row_jacobian(self._along(y, z, mode, target), torch.zeros_like(z))[1]
            return self(y).to(given), slope.to(given)
        values: Tensor
        values, gradient = self.basis.local(x).evaluate_with_gradient(z, self._outputs_first(z.dim() - 2))
        values, gradient = _in(given, values), _in(given, gradient)
        if self.out_features is None:
            return values, gradient
        return values.movedim(0, -1), gradient.movedim(0, -2)

    def gradient(self, y: Tensor, mode: str = "partial", target: Target | None = None) -> Tensor:
        """Gradient of V^ at y: (..., P, n) -> (..., P, n), or (..., P, k, n).

        Modes, which differ by O(1):
            ``partial``: d/dy with the centers frozen at x.
            ``total_frozen_weights``: the state moves with y (y - x fixed), the weights w do not.
                For the exponential kernel with constant offsets: partial + y V^(y); for a kernel of y - c
                with constant offsets zero, as V^ then moves along unchanged.
            ``total``: the weights are the ideal ones at every state; needs the target, by default
                that of the last `fit_`.

        Raises:
            ValueError: for another mode, or ``total`` without a target.
        """
        return self.value_and_gradient(y, mode, target)[1]

    def hessian(self, y: Tensor, mode: str = "partial", target: Target | None = None) -> Tensor:
        """Second derivatives of V^ at y, in the modes of `gradient`: (..., P, n) -> (..., P, n, n).

        With several outputs (..., P, k, n, n).
        """
        choice("StaF.hessian", "mode", mode, _MODES)
        trailing("StaF.hessian", "y", y, dims=2, last=self.basis.dim)
        beside_batch("StaF.hessian", "y", y, 2, self.state.shape[:-1], "the coefficients are")
        x = _wide(self.state)
        given, y = y.dtype, y.to(x.dtype)
        z = y - x.unsqueeze(-2)
        start = torch.zeros_like(z)
        if mode == "partial":
            return row_jacobian(lambda step: self.value_and_gradient(y + step)[1], start)[1].to(given)
        function = self._along(y, z, mode, target)
        return row_jacobian(lambda step: row_jacobian(function, step)[1], start)[1].to(given)

    def extra_repr(self) -> str:
        outputs = "" if self.out_features is None else f", out_features={self.out_features}"
        fixed = "" if isinstance(self.coefficients, nn.Parameter) else ", learnable=False"
        return f"batch_shape={self.batch_shape}{outputs}{fixed}"

    def _points(self, call: str, y: Tensor, one_each: str) -> None:
        """Refuse what is not (..., P, n), and (*batch_shape, n), which could be one point a batch entry."""
        trailing(call, "y", y, dims=2, last=self.basis.dim)
        batch = self.state.shape[:-1]
        if y.shape[:-1] == batch:
            ones = ", ".join("1" for _ in batch)
            whole = "y.unsqueeze(0)" if len(batch) == 1 else f"y.reshape({ones}, -1, {y.shape[-1]})"
            raise ValueError(
                f"`{call}(y=...)` of the shape {tuple(y.shape)} must say which points are meant: one of each "
                f"batch entry ({one_each}), or all of them for every entry (`{whole}`, ({ones}, P, n))."
            )
        if y.dim() > 2:
            beside_batch(call, "y", y, 2, batch, "the coefficients are")

    def _along(self, y: Tensor, z: Tensor, mode: str, target: Target | None) -> Callable[[Tensor], Tensor]:
        """V^ as a function of a step of both y and x, with what else moves in this mode."""
        if mode == "total_frozen_weights":
            return lambda step: self._frozen(y, step)
        chosen = self._target if target is None else target
        if chosen is None:
            raise ValueError(
                '`StaF.gradient(mode="total")` needs a target: pass `target=...` or call `fit_`.'
            )
        return lambda step: self._moving(z, step, chosen)

    def _frozen(self, y: Tensor, step: Tensor) -> Tensor:
        """V^(y + h; x + h) with w of x: (..., P, n), (..., P, n) -> (..., P), or (..., P, k).

        NaN in a row in which w cannot be represented.
        """
        rule = self.basis.kernel.follow(y, step) if self.basis.centers.radius.constant else None
        if rule is not None:
            # In coefficients, which keep their digits where w is huge and cancels.
            log_factor, shift = rule
            values: Tensor = self(y + shift)
            factor = log_factor.exp()
            return factor * values if self.out_features is None else factor.unsqueeze(-1) * values
        moved = _wide(self.state).unsqueeze(-2) + step
        sigma = self.basis((y + step).unsqueeze(-2), moved)  # (..., P, 1, M)
        weights = self._weights(step.dim() - 2).unsqueeze(-2).unsqueeze(-2)
        return self._outputs_last((sigma * weights).sum(-1).squeeze(-1))

    def _moving(self, z: Tensor, step: Tensor, target: Target) -> Tensor:
        """V^(x + z + h; x + h) with the ideal weights of x + h: (..., P, n) -> (..., P), or (..., P, k)."""
        moved = _wide(self.state).unsqueeze(-2) + step
        space = self.basis.local(moved)
        coefficients = space.fit(self.basis.values(moved, target, self.out_features))
        return self._outputs_last(space.evaluate(z.unsqueeze(-2), coefficients).squeeze(-1))

    def _weights(self, leading: int = 0) -> Tensor:
        """w, outputs first: NaN in a row where it cannot be represented."""
        return self.basis.local(_wide(self.state)).weights(self._outputs_first(leading))

    def _outputs_first(self, leading: int) -> Tensor:
        """The coefficients as (k, ..., M) with at least ``leading`` dimensions between, or as they are."""
        coefficients = _wide(self.coefficients)
        if self.out_features is None:
            return coefficients
        missing = max(0, leading - len(self.batch_shape))
        return coefficients.movedim(-2, 0)[(slice(None), *[None] * missing)]

    def _outputs_last(self, values: Tensor) -> Tensor:
        return values if self.out_features is None else values.movedim(0, -1)

    def _remember(self, target: Target | None) -> None:
        # Past `nn.Module`, which would make a target that is a module, and its parameters, a part of this.
        object.__setattr__(self, "_target", target)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any, **keywords: Any
    ) -> None:
        inner = f"{prefix}basis."
        if f"{inner}convention" in state_dict:
            self.basis.check_convention("StaF.load_state_dict", state_dict[f"{inner}convention"])
        elif any(key.startswith(inner) for key in state_dict):
            raise ValueError(
                "`StaF.load_state_dict`: the coefficients come without the `convention` of their basis. An "
                "earlier version of staf_torch wrote them, and they mean another function here: fit anew."
            )
        super()._load_from_state_dict(state_dict, prefix, *arguments, **keywords)
        self._remember(None)

    def __getstate__(self) -> dict[str, Any]:
        """For pickle: without the target of the last fit, which need not be picklable."""
        return self.__dict__ | {"_target": None}

    def __deepcopy__(self, memo: dict[int, Any]) -> StaF:
        clone = self.__class__.__new__(self.__class__)
        memo[id(self)] = clone
        target = self._target  # a function of the user's: shared, not copied
        held = vars(self) | {"_target": None}
        clone.__dict__.update({name: copy.deepcopy(v, memo) for name, v in held.items()})
        clone._remember(target)
        return clone


def _in(dtype: torch.dtype, tensor: Tensor) -> Tensor:
    """Return a tensor in a precision: `Tensor.to`, which takes a microsecond where it has nothing to do."""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def _wide(tensor: Tensor) -> Tensor:
    """Return a tensor of a half type as float32, in which matrices can be factored; others as they are."""
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor
