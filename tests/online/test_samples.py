"""Samples as users give them: what becomes of each kind, and what each refusal says."""

from __future__ import annotations

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
        (np.array(["a", 2], dtype=object), ValueError, "could not convert string"),
        (np.array([{}, 2], dtype=object), TypeError, "must be a string or a real number"),
        ("no", ValueError, "'no'"),
    ],
)
def test_what_are_no_numbers_is_refused_with_the_reason(
    value: Any, kind: type[Exception], message: str
) -> None:
    rule = rf"`StaFRegressor.partial_fit\(x=...\)` must be a tensor or an array of numbers.*{message}"
    with pytest.raises(kind, match=rule) as told:
        st.StaFRegressor().partial_fit(value, 1.0)
    assert type(told.value) is kind


FITS = [((5, 2), (5,)), ((5, 2), (5, 2)), ((5, 4, 2), (5, 4)), ((5, 4, 2), (5, 4, 2))]  # K outputs last
DO_NOT = [((5, 2), (4,)), ((5, 4, 2), (5, 3)), ((5, 4, 2), (5, 4, 2, 1)), ((3,), ())]


@over(REGRESSORS, "kind")
@pytest.mark.parametrize(("of_x", "of_y"), [*FITS, *DO_NOT])
def test_shapes_that_fit_are_taken_and_others_named(
    kind: str, of_x: tuple[int, ...], of_y: tuple[int, ...]
) -> None:
    model, x, y = REGRESSORS[kind](), torch.zeros(of_x).double(), np.zeros(of_y)
    if (of_x, of_y) in FITS:
        assert model.fit(x, y).predict(x[-1]).shape == of_y[1:]
        return
    wanted = (
        "the shape (T, n) for one stream in time or (T, S, n) for S streams, and y that without n, or with K"
    )
    for call in ("fit", "tune"):
        with pytest.raises(ValueError, match=rf"Regressor.{call}\(x=...\)` must have the shape") as told:
            getattr(model, call)(x, y)
        assert f"{wanted} in its place; got {of_x} and {of_y}." in str(told.value)


@pytest.mark.parametrize(
    ("of_x", "of_y", "what"),
    [
        ((0, 2), (0,), "0 sample(s) (shape=(0, 2))"),
        ((3, 0), (3,), "0 feature(s) (shape=(3, 0))"),
        ((4, 0, 2), (4, 0), "0 sample(s) (shape=(4, 0, 2))"),
    ],
)
def test_what_is_empty_is_named(of_x: tuple[int, ...], of_y: tuple[int, ...], what: str) -> None:
    with pytest.raises(ValueError, match="must not be empty") as told:
        st.StaFRegressor().fit(torch.zeros(of_x), torch.zeros(of_y))
    wanted = f"`StaFRegressor.fit(x=...)` must not be empty: {what} while a minimum of 1 is required."
    assert str(told.value) == wanted
    with pytest.raises(ValueError, match=r"`StaFRegressor.fit` requires y to be passed.*target y is None"):
        st.StaFRegressor().fit(torch.zeros(of_x), None)


@pytest.mark.parametrize(
    "time",
    [
        [0.0, 1.0, 2.0],
        [[0.0, 1.0, 2.0, 3.0]],
        [0.0, 1.0, 0.5, 3.0],
        [0.0, 1.0, 2.0, torch.inf],
        [-1.7e308, 1.7e308, 1.7e308, 1.7e308],  # the step is no number
    ],
)
def test_times_that_do_not_increase_are_refused(time: list[Any]) -> None:
    for shape, form in (((4, 2), r"\(4,\);"), ((4, 3, 2), r"\(4,\) or \(4, 3\);")):
        x, rule = (
            torch.zeros(shape),
            rf"`StaFRegressor.fit\(time=...\)` must be finite and increasing, {form}",
        )
        with pytest.raises(ValueError, match=rule):
            st.StaFRegressor().fit(x, x[..., 0], time=time)


@pytest.mark.parametrize(
    "lapse", [-0.5, [0.0, -1e-9, 1.0], torch.inf, [1.0, torch.nan, 1.0], [1.0, 2.0], [[1.0]]]
)
def test_a_lapse_that_is_no_time_is_refused(lapse: Any) -> None:
    rule = r"`StaFRegressor.partial_fit\(lapse=...\)` must be finite and not negative, \(\) or \(3,\);"
    with pytest.raises(ValueError, match=rule):
        st.StaFRegressor().partial_fit(torch.zeros(3, 2), torch.zeros(3), lapse=lapse)


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
