"""What scikit-learn asks of a regressor, without the dependency."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
from torch import Tensor

from ..kernels import NAMED, Kernel
from ..numerics.checks import choice, fail


class ScikitEstimator:
    """Parameters by name, those of a kernel as ``kernel__width``; tags; score."""

    @classmethod
    def _parameters(cls) -> list[str]:
        return [name for name in inspect.signature(cls.__init__).parameters if name != "self"]

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The arguments of the constructor, by name; with ``deep`` those of the kernel too."""
        found = {name: getattr(self, name) for name in self._parameters()}
        kernel = found.get("kernel")
        if deep and isinstance(kernel, Kernel):
            found |= {f"kernel__{name}": value for name, value in _arguments(kernel).items()}
        return found

    def set_params(self, **params: Any) -> Any:
        """Set arguments of the constructor; they hold from the next `reset` or `fit` on.

        Raises:
            ValueError: for a name that is none.
        """
        for name, value in params.items():
            own, _, nested = name.partition("__")
            choice(f"{type(self).__name__}.set_params", "params", own, self._parameters())
            if nested:
                self._set_nested(name, own, nested, value)
            else:
                setattr(self, name, value)
        return self

    def _set_nested(self, name: str, own: str, nested: str, value: Any) -> None:
        kernel = getattr(self, own)
        if isinstance(kernel, str) and kernel in NAMED:
            kernel = NAMED[kernel]()
        known = _arguments(kernel) if isinstance(kernel, Kernel) else {}
        if nested not in known:
            raise fail(f"{type(self).__name__}.set_params", "params", f"must be one of {[*known]}", name)
        setattr(self, own, type(kernel)(**(known | {nested: value})))

    def score(self, x: Any, y: Any, sample_weight: Any = None) -> float:
        """R^2 of the prediction at x, (P, n), as scikit-learn's regressors have it.

        The mean over the outputs; of constant targets 1 where they are met exactly, else 0.
        """
        truth, found = np.asarray(y, np.float64), np.asarray(self.predict(x), np.float64)  # type: ignore[attr-defined]
        weight = np.ones(len(truth)) if sample_weight is None else np.asarray(sample_weight, np.float64)
        weight = weight.reshape(len(truth), 1) if truth.ndim > 1 else weight.ravel()
        total = (weight * (truth - np.average(truth, 0, weight.ravel())) ** 2).sum(0)
        left = (weight * (truth - found) ** 2).sum(0)
        return float(np.mean(1 - np.where(total > 0, left / np.where(total > 0, total, 1), left > 0)))

    def __repr__(self) -> str:
        arguments = ", ".join(f"{name}={value!r}" for name, value in self.get_params(deep=False).items())
        return f"{type(self).__name__}({arguments})"

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


def not_fitted(message: str) -> Exception:
    """scikit-learn's own `NotFittedError` where it is in use, else the one of this module."""
    import sys

    exceptions = sys.modules.get("sklearn.exceptions")
    return NotFittedError(message) if exceptions is None else exceptions.NotFittedError(message)


def _arguments(kernel: Kernel) -> dict[str, Any]:
    """The arguments that a kernel was made with, as far as it keeps them by their names."""
    names = [name for name in inspect.signature(type(kernel).__init__).parameters if name != "self"]
    return {name: _plain(getattr(kernel, name)) for name in names if hasattr(kernel, name)}


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, Tensor) and value.dim() == 0 else value
