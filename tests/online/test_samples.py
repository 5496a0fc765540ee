"""Samples as users give them: what becomes of each kind, and what each refusal says."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from helpers_streams import REGRESSORS
from variants import over

import staf_torch as st

KINDS_OF_NUMBERS = [
    torch.tensor([1.0, 2.0]),
    torch.tensor([1, 2]),
    torch.tensor([1.0, 2.0], dtype=torch.float64),
    torch.tensor([1.0, 2.0], dtype=torch.float16),
    np.array([1.0, 2.0], np.float32),
    np.array([2.0, 1.0])[::-1],
    np.array([1.0, 2.0], ">f8"),
    np.array([1, 2.0], dtype=object),
    [1, 2],
    (1.0, 2.0),
]


@pytest.mark.parametrize(
    "value", KINDS_OF_NUMBERS, ids=lambda value: str(getattr(value, "dtype", type(value)))
)
def test_numbers_of_any_kind_are_samples(value: Any) -> None:
    single = getattr(value, "dtype", None) in (torch.float32, np.float32)
    model = st.StaFRegressor(radius=0.4).partial_fit(value, 3)
    assert model.state_dict()["dtype"] == ("torch.float32" if single else "torch.float64")
    assert float(model.predict(value)) == pytest.approx(3.0, rel=1e-3)
    assert isinstance(model.predict(value), torch.Tensor if isinstance(value, torch.Tensor) else np.ndarray)
    assert model.predict(torch.ones(2)).dtype == torch.float32  # the caller's, whatever the first sample had
    assert model.predict(np.ones(2)).dtype == np.float64
    with pytest.raises(ValueError, match=r"predict\(x=...\)` must be on cpu.*meta"):
        model.predict(torch.ones(2, device="meta"))


@over(REGRESSORS, "kind")
def test_samples_in_single_precision_are_the_same_stream(kind: str) -> None:
    draw = torch.Generator().manual_seed(3)
    x = torch.randn(60, 3, 2, generator=draw).cumsum(0) / 10
    y, single, double = x.sum(-1).sin(), REGRESSORS[kind](), REGRESSORS[kind]()
    for a, b in zip(x, y, strict=True):  # as they lie in memory, one by one
        single.partial_fit(a, b)
        double.partial_fit(a.double(), b.double())
    found = single.predict(x[-1] + 0.05)
    assert found.dtype == torch.float32
    close = {"rtol": 0, "atol": 2e-2, "check_dtype": False}
    torch.testing.assert_close(found, double.predict(x[-1].double() + 0.05), **close)


class Sparse:
    """What has `toarray` is sparse."""

    def toarray(self) -> np.ndarray:
        return np.ones(2)


@pytest.mark.parametrize(
    ("value", "kind", "message"),
    [
        (Sparse(), TypeError, r"sparse data is not supported: use toarray\(\)"),
        (np.array([1 + 1j]), ValueError, "Complex data not supported"),
        (["a", "b"], ValueError, "can't convert"),
        (np.array([{}, 2], dtype=object), TypeError, "must be a string or a real number"),
    ],
)
def test_what_are_no_numbers_is_refused_with_the_reason(
    value: Any, kind: type[Exception], message: str
) -> None:
    rule = rf"`StaFRegressor.partial_fit\(x=...\)` must be a tensor or an array of numbers.*{message}"
    with pytest.raises(kind, match=rule) as told:
        st.StaFRegressor().partial_fit(value, 1.0)
    assert type(told.value) is kind


@over(REGRESSORS, "kind")
def test_shapes_that_fit_are_taken_and_others_named(kind: str) -> None:
    model = REGRESSORS[kind]()
    for of_x, of_y in (((5, 2), (5,)), ((5, 2), (5, 2)), ((5, 4, 2), (5, 4)), ((5, 4, 2), (5, 4, 2))):
        x = torch.zeros(of_x).double()
        assert model.fit(x, np.zeros(of_y)).predict(x[-1]).shape == of_y[1:]
    for of_x, of_y in (((5, 2), (4,)), ((5, 4, 2), (5, 3)), ((5, 4, 2), (5, 4, 2, 1)), ((3,), ())):
        for call in ("fit", "tune"):
            rule = rf"Regressor.{call}\(x=...\)` must have the shape \(T, n\) for one stream in time or"
            with pytest.raises(ValueError, match=rule):
                getattr(model, call)(torch.zeros(of_x).double(), np.zeros(of_y))


def test_what_is_empty_or_has_no_increasing_times_is_named() -> None:
    for of_x, what in (((0, 2), "0 sample(s)"), ((3, 0), "0 feature(s)"), ((4, 0, 2), "0 sample(s)")):
        said = re.escape(f"must not be empty: {what} (shape={of_x}) while a minimum of 1 is required.")
        with pytest.raises(ValueError, match=said):
            st.StaFRegressor().fit(torch.zeros(of_x), torch.zeros(of_x[:-1]))
    with pytest.raises(ValueError, match=r"`StaFRegressor.fit` requires y to be passed.*target y is None"):
        st.StaFRegressor().fit(torch.zeros(3, 2), None)
    x = torch.zeros(4, 3, 2)
    for time in (
        [0, 1, 2],
        [[0, 1, 2, 3]],
        [0, 1, 0.5, 3],
        [0, 1, 2, torch.inf],
        [-1.7e308, 1.7e308, 2e308, 2e308],
    ):
        rule = r"fit\(time=...\)` must be finite and increasing, \(4,\) or \(4, 3\);"
        with pytest.raises(ValueError, match=rule):
            st.StaFRegressor().fit(x, x[..., 0], time=time)


@over(REGRESSORS, "kind")
def test_streams_are_where_their_samples_are_and_not_on_the_default_device(kind: str) -> None:
    x, y = np.random.default_rng(0).standard_normal((2, 30, 2))
    wanted = REGRESSORS[kind]().fit(x, y[:, 0]).partial_fit(x[0], y[0, 0]).predict(x[:3])
    with torch.device("meta"):
        model = REGRESSORS[kind]().fit(x, y[:, 0]).partial_fit(x[0], y[0, 0])
        assert np.array_equal(model.predict(x[:3]), wanted)
        several = REGRESSORS[kind]().fit(np.stack((x, x), 1), y)
        several.add(1).drop([0]).reset(streams=[0]).load_state_dict(several.state_dict())
        assert several.predict(x[:2]).shape == (2,)
