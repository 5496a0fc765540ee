"""What was chosen once: constants of the streams' modules, rules and layout of a bank, as texts."""

from __future__ import annotations

import importlib
import math
import pkgutil

import pytest
from recorded import Record

from staf_torch import online
from staf_torch.online.bank_rules import BankShape, Rules, layout, size

MODULES = sorted(each.name for each in pkgutil.iter_modules(online.__path__))


@pytest.mark.parametrize("module", MODULES)
def test_constants_of_a_module_are_the_recorded(module: str, record: Record) -> None:
    found = vars(importlib.import_module(f"staf_torch.online.{module}"))
    plain = {
        name: repr(value)
        for name, value in found.items()
        if name.strip("_").isupper() and isinstance(value, int | float | tuple | str)
    }
    record(plain | {"module": module})


@pytest.mark.parametrize(("dim", "scaling", "doubtful"), [(1, True, None), (3, False, 5.0)])
def test_rules_of_a_bank_are_the_recorded(
    dim: int, scaling: bool, doubtful: float | None, record: Record
) -> None:
    rules = Rules.of(dim, scaling, doubtful)
    record({name: repr(value) for name, value in rules._asdict().items()} | {"all": repr(rules.numbers())})


@pytest.mark.parametrize("shape", [BankShape(2, 3, 128, 8), BankShape(20, 1, 200, 56)])
def test_the_layout_of_a_stream_is_the_recorded(shape: BankShape, record: Record) -> None:
    record({name: repr(dims) for name, dims in layout(shape)} | {"names": repr(layout(shape))})
    assert size(shape) == sum(math.prod(dims) for _, dims in layout(shape))


def test_a_quadratic_model_has_products_squares_or_neither_as_they_fit() -> None:
    found = {dim: BankShape(dim, 1, 128, 8).features for dim in (1, 2, 14, 15, 59, 60)}
    assert found == {1: 3, 2: 6, 14: 120, 15: 31, 59: 119, 60: 61}
