"""Checks give back what they were given, and refuse what `tests/test_rules.py` reaches by no argument."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch.numerics import checks


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


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: checks.vector("F", "x", (1, 2), 3), "`F(x=...)` must have 3 entries, one a state"),
        (lambda: checks.one_or_each("F", "x", [1.0], 2), "`F(x=...)` must be one number or a list of 2"),
        (lambda: checks.sampled(nn.Identity(), 3, torch.ones(9)), "`Identity` must return a tensor; got 3."),
        (
            lambda: checks.sampled(math.sin, torch.ones(2), torch.ones(2, 3, 1)),
            "values of shape (...): (2, 3, 1) must give (2, 3); got (2,).",
        ),
        (
            lambda: checks.sampled(math.sin, torch.ones(2, 3), torch.ones(2, 3, 1), 1),
            "to values of shape (..., 1): (2, 3, 1) must give (2, 3, 1); got (2, 3).",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
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
