"""Every check: what it gives back, at its edge and beyond, and the sentence of each refusal."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch.numerics import checks

LARGE = torch.ones(9).double()


@pytest.mark.parametrize("check", [checks.number, checks.positive, checks.non_negative])
def test_a_tensor_of_numbers_is_given_back_as_it_is(check: Callable[..., Any]) -> None:
    for value in (torch.tensor([1.0, 2.0]), torch.tensor(3.0).double(), torch.ones(2, device="meta")):
        assert check("F", "x", value) is value
    found = check("F", "x", 3)
    assert float(found) == 3.0
    if isinstance(found, Tensor):
        assert found.dtype == torch.float64
    else:
        assert type(found) is float


def test_values_at_the_edge_are_accepted() -> None:
    assert float(checks.non_negative("F", "x", 0.0)) == 0.0
    assert checks.integer("F", "x", 3, least=3) == 3
    assert checks.flag("F", "x", False) is False
    assert checks.choice("F", "x", "a", ("a", "b")) == "a"
    assert checks.vector("F", "x", (1, 2.5)) == [1.0, 2.5]
    assert all(type(each) is float for each in checks.vector("F", "x", [1, 2], 2))
    assert checks.vector("F", "x", []) == []


REFUSED: list[tuple[Callable[[], Any], str]] = [
    (
        lambda: checks.number("F", "x", torch.ones(2).int()),
        "`F(x=...)` must be a floating-point tensor; got [1, 1].",
    ),
    (lambda: checks.number("F", "x", -math.inf), "`F(x=...)` must be finite; got -inf."),
    (lambda: checks.positive("F", "x", -LARGE), "`F(x=...)` must be positive; got a tensor (9,)."),
    (
        lambda: checks.non_negative("F", "x", torch.tensor([0.0, -1.0])),
        "must not be negative; got [0.0, -1.0].",
    ),
    (lambda: checks.integer("F", "x", True, least=0), "`F(x=...)` must be an integer; got True."),
    (lambda: checks.flag("F", "x", 1), "`F(x=...)` must be true or false; got 1."),
    (lambda: checks.choice("F", "x", 3, ("a", 2)), "`F(x=...)` must be one of 'a', 2; got 3."),
    (lambda: checks.vector("F", "x", "12"), "`F(x=...)` must be a list of numbers; got '12'."),
    (lambda: checks.vector("F", "x", (1, 2), 3), "`F(x=...)` must have 3 entries, one a state; got [1, 2]."),
    (
        lambda: checks.one_or_each("F", "x", [1.0], 2),
        "`F(x=...)` must be one number or a list of 2; got [1.0].",
    ),
    (
        lambda: checks.trailing("F", "x", torch.ones(3), dims=2),
        "`F(x=...)` must have at least 2 dimensions; got the shape (3,).",
    ),
    (
        lambda: checks.trailing("F", "x", torch.ones(2, 3), dims=2, last=2),
        "`F(x=...)` must have 2 entries in its last dimension; got the shape (2, 3).",
    ),
    (lambda: checks.sampled(nn.Identity(), 3, LARGE), "The target `Identity` must return a tensor; got 3."),
    (
        lambda: checks.sampled(math.sin, torch.ones(2), torch.ones(2, 3, 1)),
        "The target `sin` must map points of shape (..., n) to values of shape (...): "
        "(2, 3, 1) must give (2, 3); got (2,).",
    ),
    (
        lambda: checks.sampled(math.sin, torch.ones(2, 3), torch.ones(2, 3, 1), 1),
        "to values of shape (..., 1): (2, 3, 1) must give (2, 3, 1); got (2, 3).",
    ),
]


@pytest.mark.parametrize("at", range(len(REFUSED)))
def test_what_is_wrong_is_said_in_one_sentence(at: int) -> None:
    call, said = REFUSED[at]
    with pytest.raises(ValueError, match=rf"{re.escape(said)}$"):
        call()


@pytest.mark.parametrize("given", [2, 2.0, torch.tensor(2.0), [2.0, 2.0, 2.0], torch.full((3,), 2.0)])
def test_one_number_serves_all_or_each_has_its_own(given: Any) -> None:
    found = checks.one_or_each("F", "x", given, 3)
    assert found.tolist() == [2.0, 2.0, 2.0]
    assert found.dtype == torch.float64


def test_a_module_shows_its_numbers_by_value_and_other_tensors_by_shape() -> None:
    module = nn.Module()
    checks.hold(module, "rate", torch.tensor(0.123456789).double())
    checks.hold(module, "learned", nn.Parameter(torch.ones(2, 3)))
    checks.hold(module, "later", torch.ones((), device="meta"))
    module.register_buffer("none", None)
    assert list(dict(module.named_parameters())) == ["learned"]
    assert list(dict(module.named_buffers())) == ["rate", "later"]
    assert checks.shown(module) == "learned=(2, 3), rate=0.123457, later=()"
