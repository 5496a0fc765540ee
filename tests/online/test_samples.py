"""Samples as users give them: what becomes of each kind, and what each refusal says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from staf_torch.online.samples import lapse_of, lapses, pair, tensor_of


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (torch.tensor([1.0, 2.0]), torch.float32),
        (torch.tensor([1, 2]), torch.float64),
        (torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True), torch.float64),
        (torch.tensor([1.0, 2.0], dtype=torch.float16), torch.float16),
        (np.array([1.0, 2.0], np.float32), torch.float32),
        (np.array([1, 2]), torch.float64),
        (np.array([1, 2.0], dtype=object), torch.float64),
        ([1, 2], torch.float64),
        ((1.0, 2.0), torch.float64),
    ],
)
def test_a_value_keeps_its_floats_and_integers_become_double(value: Any, dtype: torch.dtype) -> None:
    found = tensor_of("call", "x", value)
    assert found.dtype == dtype
    assert found.tolist() == [1.0, 2.0]
    assert not found.requires_grad


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
    with pytest.raises(
        kind, match=rf"`call\(x=...\)` must be a tensor or an array of numbers.*{message}"
    ) as told:
        tensor_of("call", "x", value)
    assert type(told.value) is kind


def shapes(*dims: int) -> torch.Tensor:
    return torch.zeros(dims)


FITS = [
    ((1, 2), (3,), ()),
    ((1, 2), (3,), (2,)),  # K outputs
    ((1, 2), (4, 3), (4,)),
    ((1, 2), (4, 3), (4, 2)),
    ((2, 3), (5, 3), (5,)),
    ((2, 3), (5, 4, 3), (5, 4)),
    ((2, 3), (5, 4, 3), (5, 4, 2)),
]
DO_NOT = [
    ((1, 2), (), ()),
    ((1, 2), (5, 4, 3), (5, 4)),
    ((1, 2), (4, 3), (3,)),
    ((1, 2), (3,), (2, 2)),
    ((2, 3), (5, 3), (4,)),
    ((2, 3), (5, 4, 3), (5, 3)),
    ((2, 3), (5, 4, 3), (5, 4, 2, 1)),
]


@pytest.mark.parametrize(("dims", "of_x", "of_y"), FITS)
def test_shapes_that_fit_are_taken(
    dims: tuple[int, int], of_x: tuple[int, ...], of_y: tuple[int, ...]
) -> None:
    x, y = pair("call", shapes(*of_x), np.zeros(of_y), dims)
    assert (tuple(x.shape), tuple(y.shape)) == (of_x, of_y)


@pytest.mark.parametrize(("dims", "of_x", "of_y"), DO_NOT)
def test_shapes_that_do_not_fit_are_named(
    dims: tuple[int, int], of_x: tuple[int, ...], of_y: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match=r"`call\(x=...\)` must have the shape") as told:
        pair("call", shapes(*of_x), shapes(*of_y), dims)
    one, many = "(n,) or (S, n)", "(T, n) for one stream in time or (T, S, n) for S streams"
    wanted = f"the shape {one if dims == (1, 2) else many}, and y that without n, or with K in its place"
    assert f"{wanted}; got {of_x} and {of_y}." in str(told.value)


@pytest.mark.parametrize(
    ("of_x", "of_y", "what"),
    [
        ((0, 2), (0,), "0 sample(s) (shape=(0, 2))"),
        ((3, 0), (3,), "0 feature(s) (shape=(3, 0))"),
        ((0,), (), "0 feature(s) (shape=(0,))"),
        ((4, 0, 2), (4, 0), "0 sample(s) (shape=(4, 0, 2))"),
    ],
)
def test_what_is_empty_is_named(of_x: tuple[int, ...], of_y: tuple[int, ...], what: str) -> None:
    with pytest.raises(ValueError, match="must not be empty") as told:
        pair("call", shapes(*of_x), shapes(*of_y), (2, 3))
    wanted = f"`call(x=...)` must not be empty: {what} while a minimum of 1 is required."
    assert str(told.value) == wanted
    with pytest.raises(ValueError, match=r"`call` requires y to be passed.*target y is None"):
        pair("call", shapes(*of_x), None, (2, 3))


def test_time_between_samples_is_1_before_the_first() -> None:
    one, several = shapes(4, 2), shapes(4, 3, 2)
    assert lapses("call", None, one) is None
    found = lapses("call", [0, 0, 1.5, 2], one)
    assert found is not None
    assert found.tolist() == [[1.0], [0.0], [1.5], [0.5]]
    assert found.dtype == torch.float64
    each = lapses("call", np.arange(12.0).reshape(4, 3), several)
    assert each is not None
    assert each.tolist() == [[1.0] * 3, *[[3.0] * 3] * 3]
    for_all = lapses("call", torch.tensor([3.0, 4.0, 7.0, 7.0]), several)
    assert for_all is not None
    assert for_all.tolist() == [[1.0], [1.0], [3.0], [0.0]]


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
    with pytest.raises(ValueError, match=r"`call\(time=...\)` must be finite and increasing, \(4,\);"):
        lapses("call", time, shapes(4, 2))
    with pytest.raises(ValueError, match=r"must be finite and increasing, \(4,\) or \(4, 3\);"):
        lapses("call", time, shapes(4, 3, 2))


@pytest.mark.parametrize(
    "lapse", [-0.5, [0.0, -1e-9, 1.0], torch.inf, [1.0, torch.nan, 1.0], [1.0, 2.0], [[1.0]], [1.0] * 4]
)
def test_a_lapse_that_is_no_time_is_refused(lapse: Any) -> None:
    rule = r"`call\(lapse=...\)` must be finite and not negative, \(\) or \(3,\);"
    with pytest.raises(ValueError, match=rule):
        lapse_of("call", lapse, 3)
