"""The conventions of scikit-learn: arguments, a score, a repr, tags, the error of what was not fitted."""

from __future__ import annotations

import inspect
import math
import warnings
from typing import Any

import numpy as np
from torch import Tensor

from ..kernels import NAMED, Kernel
from ..lanes.row_numbers import RowNumbers
from ..numerics.checks import choice, fail


class ScikitEstimator:
    """Parameters by name, those of a kernel as ``kernel__width``; tags; score."""

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The arguments of the constructor, by name; with ``deep`` those of the kernel too."""
        found = {name: getattr(self, name) for name in parameters(type(self))}
        kernel = found.get("kernel")
        if deep and isinstance(kernel, Kernel):
            found |= {f"kernel__{name}": value for name, value in _arguments(kernel).items()}
        return found

    def set_params(self, **params: Any) -> Any:
        """Set arguments of the constructor, a name that is none refused; they hold from the next `reset`
        or `fit` on."""
        for name, value in params.items():
            own, _, nested = name.partition("__")
            choice(f"{type(self).__name__}.set_params", "params", own, parameters(type(self)))
            if nested:
                kernel = getattr(self, own)
                if isinstance(kernel, str) and kernel in NAMED:
                    kernel = NAMED[kernel]()
                known = _arguments(kernel) if isinstance(kernel, Kernel) else {}
                if nested not in known:
                    raise fail(
                        f"{type(self).__name__}.set_params", "params", f"must be one of {[*known]}", name
                    )
                value = type(kernel)(**(known | {nested: value}))
            setattr(self, own, value)
        return self

    def score(self, x: Any, y: Any, sample_weight: Any = None) -> float:
        """R^2 of the prediction at x, (P, n), as scikit-learn's regressors have it.

        The mean over the outputs; of constant targets 1 where they are met exactly, else 0. Targets that are
        not finite were not measured and are left out, as in learning; a prediction that is not finite makes
        the score NaN, and so does an output without a finite target, with a warning.

        Args:
            x: (P, n).
            y: (P,), or (P, K) for K outputs.
            sample_weight: (P,), finite and not negative, not all zero; ones by default.

        Raises:
            ValueError: for another shape, or for weights that are none.
        """
        truth, found = np.asarray(y, np.float64), np.asarray(self.predict(x), np.float64)  # type: ignore[attr-defined]
        call = f"{type(self).__name__}.score"
        if truth.shape != found.shape:
            raise ValueError(f"`{call}(y=...)` must have the shape {found.shape}; got {truth.shape}.")
        weight = np.ones(len(truth)) if sample_weight is None else np.asarray(sample_weight, np.float64)
        if weight.size != len(truth) or not (np.isfinite(weight) & (weight >= 0)).all() or weight.sum() == 0:
            rule = f"must be ({len(truth)},), finite, not negative and not all zero"
            raise fail(call, "sample_weight", rule, sample_weight)
        seen = np.isfinite(truth)
        weight = np.where(seen, weight.reshape(len(truth), *[1] * (truth.ndim - 1)), 0.0)
        truth, whole = np.where(seen, truth, 0.0), weight.sum(0)
        if (whole == 0).any():
            warnings.warn(
                f"`{call}(y=...)` has an output without a finite target: the score is NaN", stacklevel=2
            )
            return math.nan
        total = (weight * (truth - (weight * truth).sum(0) / whole) ** 2).sum(0)
        inside = weight > 0
        spread = np.where(inside, truth, -np.inf).max(0) - np.where(inside, truth, np.inf).min(0)
        total = np.where(spread > 0, total, 0.0)  # the mean of equal numbers may be rounded
        left = (weight * (truth - np.where(inside, found, 0.0)) ** 2).sum(0)
        met = np.where(np.isnan(left), left, left > 0)
        return float(np.mean(1 - np.where(total > 0, left / np.where(total > 0, total, 1), met)))

    def __repr__(self) -> str:
        """Show arguments that differ from their defaults, as scikit-learn does; tensors by their shape."""
        usual = inspect.signature(type(self)).parameters
        told = {name: _shown(value) for name, value in self.get_params(deep=False).items()}
        differ = [f"{name}={text}" for name, text in told.items() if text != _shown(usual[name].default)]
        return f"{type(self).__name__}({', '.join(differ)})"

    def __sklearn_is_fitted__(self) -> bool:
        return "_streams_" in self.__dict__

    def __sklearn_tags__(self) -> Any:
        """scikit-learn asks for this, and is then installed."""
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        return Tags(
            estimator_type="regressor",
            target_tags=TargetTags(required=True, multi_output=True, single_output=True),
            regressor_tags=RegressorTags(poor_score=True),
            input_tags=InputTags(two_d_array=True, three_d_array=True, allow_nan=True),
            non_deterministic=False,
        )


class NotFittedError(ValueError, AttributeError):
    """Nothing was learned yet: the bases of scikit-learn's error of that name."""


def _arguments(kernel: Kernel) -> dict[str, Any]:
    """The arguments that a kernel was made with, as far as it keeps them by their names."""
    found = {name: getattr(kernel, name) for name in parameters(type(kernel)) if hasattr(kernel, name)}
    single = {
        k
        for k, v in found.items()
        if isinstance(v, Tensor) and not isinstance(v, RowNumbers) and v.dim() == 0
    }
    return {k: float(v.detach()) if k in single else v for k, v in found.items()}


def told_kernel(kernel: Kernel | str) -> str:
    """Return a kernel's class and the numbers that it was made with, as text; those of one by its name."""
    known = NAMED[kernel]() if isinstance(kernel, str) and kernel in NAMED else kernel
    if isinstance(known, str):
        return known
    told = [f"{name}={_shown(value)}" for name, value in _arguments(known).items()]
    return f"{type(known).__name__}({', '.join(told)})"


def _shown(value: Any) -> str:
    value = value.full if isinstance(value, RowNumbers) else value
    arrays = isinstance(value, Tensor | np.ndarray) and value.ndim > 0
    return f"<{type(value).__name__} {tuple(value.shape)}>" if arrays else repr(value)


def parameters(kind: type) -> list[str]:
    """Return the names of a constructor's arguments."""
    return [*inspect.signature(kind).parameters]
