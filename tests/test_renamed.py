"""Old module names still work, and say the new one."""

from __future__ import annotations

import importlib
import pickle
import sys
import warnings

import pytest

import staf_torch
from staf_torch._renamed import RENAMED, new_name


@pytest.fixture(autouse=True)
def _forget_old_names() -> None:
    for name in [name for name in sys.modules if new_name(name) is not None]:
        del sys.modules[name]


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_module_name_is_the_new_module_with_a_warning(old: str) -> None:
    new = importlib.import_module(f"staf_torch.{RENAMED[old]}")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        module = importlib.import_module(f"staf_torch.{old}")
    assert all(warning.category is FutureWarning for warning in said)
    assert f"`staf_torch.{old}` is now `staf_torch.{RENAMED[old]}`" in str(said[-1].message)
    public = [name for name in vars(new) if not name.startswith("_")]
    assert public
    assert all(getattr(module, name) is getattr(new, name) for name in public)


def test_a_submodule_goes_with_its_package() -> None:
    assert new_name("staf_torch.streams.regressor") == "staf_torch.online.regressor"
    assert new_name("staf_torch.engine.api") is None
    assert new_name("streams") is None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from staf_torch.chase.predictors import Secant
    assert Secant is staf_torch.predictors.Secant


def test_an_old_pickle_finds_its_classes() -> None:
    old = b"cstaf_torch.streams.regressor\nStaFRegressor\n."
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert pickle.loads(old) is staf_torch.StaFRegressor


def test_an_unknown_submodule_of_an_old_name_is_not_found() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ModuleNotFoundError, match="nothing_of_that_name"):
            importlib.import_module("staf_torch.streams.nothing_of_that_name")
