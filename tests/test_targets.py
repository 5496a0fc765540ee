"""Functions to approximate."""

from __future__ import annotations

import math
import re

import pytest
import torch
from helpers import tensor, uniform
from variants import TARGETS, over

from staf_torch.targets import Cosine, Quadratic


@over(TARGETS)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_target_equals_its_formula(name: str, batch: tuple[int, ...]) -> None:
    make, formula = TARGETS[name]
    x = uniform(*batch, 2, low=-2, high=2)
    values = make()(x)
    assert values.shape == batch
    expected = tensor([formula(point) for point in x.reshape(-1, 2).tolist()]).reshape(batch)
    torch.testing.assert_close(values, expected, rtol=1e-14, atol=1e-14)


@over(TARGETS)
def test_target_keeps_single_precision(name: str) -> None:
    target, x = TARGETS[name][0](), uniform(3, 2)
    assert target(x.float()).dtype == torch.float32
    torch.testing.assert_close(target(x.float()).double(), target(x), rtol=1e-5, atol=1e-5)


@over(TARGETS)
def test_target_keeps_single_precision_at_one_point(name: str) -> None:
    assert TARGETS[name][0]()(torch.tensor([0.3, 0.4])).dtype == torch.float32


@over(TARGETS)
def test_gradient_of_the_target_is_right(name: str) -> None:
    assert torch.autograd.gradcheck(TARGETS[name][0](), (uniform(4, 2).requires_grad_(),))


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_scalar_arguments_hold_in_any_dimension(dim: int) -> None:
    x = uniform(4, dim)
    torch.testing.assert_close(Quadratic(2)(x), 2 * x.square().sum(-1))
    torch.testing.assert_close(Cosine(0.5)(x), (0.5 * x.sum(-1)).cos())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quadratic([[1.0, 2.0], [3.0, 4.0]]), "`Quadratic(matrix=...)` must be symmetric"),
        (lambda: Quadratic([[1.0, 2.0]]), "`Quadratic(matrix=...)` must have 1 entries"),
        (lambda: Quadratic([1.0, 2.0]), "`Quadratic(matrix=...)` must be a list of numbers"),
        (lambda: Quadratic(uniform(2)), "`Quadratic(matrix=...)` must be a number or (n, n)"),
        (lambda: Quadratic(math.nan), "`Quadratic(matrix=...)` must be finite; got nan."),
        (lambda: Quadratic("P"), "`Quadratic(matrix=...)` must be"),
        (lambda: Cosine(math.inf), "`Cosine(frequency=...)` must be finite; got inf."),
        (lambda: Cosine([1.0, "a"]), "`Cosine(frequency=...)` must be a list of numbers; got [1.0, 'a']."),
        (lambda: Cosine(phase=math.nan), "`Cosine(phase=...)` must be finite; got nan."),
        (lambda: Cosine("a"), "`Cosine(frequency=...)` must be"),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


def test_of_a_cosine_the_frequency_alone_is_saved_and_numbers_are_in_double_precision() -> None:
    cosine = Cosine([1.0, 2.0], 0.5)
    assert list(cosine.state_dict()) == ["frequency"]
    assert (cosine.frequency.dtype, cosine.phase.dtype) == (torch.float64, torch.float64)
    assert (Cosine(2).frequency.dtype, float(Cosine(2).frequency), float(Cosine().phase)) == (
        torch.float64,
        2.0,
        0.0,
    )
    for given in (2, [[2.0, 1.0], [1.0, 3.0]], torch.eye(2)):
        assert Quadratic(given).matrix.dtype == torch.float64
    assert list(Quadratic().state_dict()) == ["matrix"]


@pytest.mark.parametrize("shape", [(2,), (2, 3), (3, 2), (1, 2, 2)])
def test_a_matrix_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"`Quadratic\(matrix=...\)` must be a number or \(n, n\)"):
        Quadratic(torch.ones(shape))
