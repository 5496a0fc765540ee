"""Keys of what a program is made of, whose code it is, and what a watch sees."""

from __future__ import annotations

import functools
import math
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from staf_torch import kernels
from staf_torch.lanes import Shared, patches
from staf_torch.lanes.content import code, inside_classes, reads_users_code, signature, skeleton, written
from staf_torch.lanes.surroundings import EMPTY, Same, content_of, installed, is_users, lookups
from staf_torch.lanes.watch import Watch


def key(*objects: Any) -> Any:
    found = skeleton(*objects)
    assert found is not None
    return found[0]


def tensors(*objects: Any) -> list[Tensor]:
    found = skeleton(*objects)
    assert found is not None
    return found[1]


def scaled(by: Any, keyword: Any = 1) -> Callable[[Any], Any]:
    def inner(x: Any, default: Any = keyword, *, word: Any = keyword) -> Any:
        return x * by

    return inner


def test_numbers_of_integers_flags_and_small_arrays_are_part_of_a_key_and_floats_are_not() -> None:
    assert key(torch.ones(2)) == key(torch.zeros(2))
    for one, other in (
        *(
            (torch.ones(2), torch.ones(3)),
            (torch.ones(2), torch.ones(2).double()),
            (torch.ones(2, 3), torch.ones(3, 2).mT),
        ),
        *((torch.tensor([1]), torch.tensor([2])), (torch.tensor([True]), torch.tensor([False]))),
        *(
            (torch.tensor([1]), torch.tensor([1], dtype=torch.int32)),
            (torch.tensor([1]), torch.tensor([[1]])),
        ),
        *(
            (np.ones(2), np.zeros(2)),
            (np.ones(2), np.ones((2, 1))),
            (np.ones(2), np.ones(2, dtype=np.float32)),
        ),
        *(
            (np.zeros(9000), np.ones(9000)),
            (1, 2),
            (1, True),
            (1, 1.0),
            ("a", "b"),
            (None, 0),
            ((1, 2), [1, 2]),
        ),
        *(
            (torch.sin, torch.cos),
            (math.sin, math.cos),
            (nn.ReLU, nn.Tanh),
            (math, np),
            (scaled(1), scaled(2)),
        ),
        *(
            (scaled(1, 2), scaled(1, 3)),
            (nn.Linear(2, 2), nn.Linear(2, 3)),
            (nn.ReLU(), nn.ReLU(inplace=True)),
        ),
        *(({1: 2}, {1: 3}), ({1}, {2}), (Shared(torch.tensor([1])), Shared(torch.tensor([2])))),
    ):
        assert key(one) != key(other), (one, other)
        assert key(one) == key(one)
    x, y = torch.ones(2), torch.zeros(2)
    assert key(x, x) != key(x, y) == key(y, x)
    assert [id(t) for t in tensors(x, [y, x], {"a": y})] == [id(x), id(y)]
    assert tensors(torch.tensor([1])) == []
    assert key(nn.Linear(2, 2)) == key(nn.Linear(2, 2))
    assert len(tensors(nn.Linear(2, 2))) == 2


def test_hooks_of_a_module_count_and_the_number_of_those_elsewhere_does_not() -> None:
    plain, hooked, other = nn.ReLU(), nn.ReLU(), nn.ReLU()
    hooked.register_forward_hook(print)
    nn.Tanh().register_forward_hook(print)
    other.register_forward_hook(print)
    assert key(hooked) == key(other) != key(plain)
    third = nn.ReLU()
    third.register_forward_hook(math.sin)
    assert key(third) != key(hooked)
    fourth = nn.ReLU()
    fourth.register_state_dict_pre_hook(lambda *_: None)
    assert key(fourth) == key(plain)


def test_what_has_no_form_is_named() -> None:
    def why(value: Any) -> str:
        found = written((value,))
        assert isinstance(found, str)
        return found

    assert skeleton(x for x in ()) is None
    assert "generator" in why(x for x in ())
    import itertools

    assert why(itertools.count()) == "PicklingError: an iterator, count"
    mine = types.ModuleType("mine")
    assert why(mine) == "PicklingError: the module mine, which may change"
    assert reads_users_code(mine)
    assert not isinstance(written((math,)), str)


def test_a_signature_names_what_other_processes_have_as_well() -> None:
    told = signature(key(kernels.GaussianKernel(), nn.functional.relu, 3))
    assert told is not None
    assert told.endswith(b"\0staf_torch.kernels.gaussian.GaussianKernel") or b"GaussianKernel" in told
    assert signature(key(kernels.GaussianKernel(), nn.functional.relu, 4)) != told
    assert signature(key(nn.ReLU())) != signature(key(nn.Tanh()))
    assert signature(key(math.sin)) is not None
    assert signature(key(len)) is not None
    for foreign in (scaled(1), math, test_what_has_no_form_is_named, Module):
        assert signature(key(foreign)) is None
    assert signature(key(1)) == key(1)[0]


class Module(nn.Module):
    """Of a user."""

    gain = 2.0

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gain


def test_classes_are_kept_with_what_they_inherit() -> None:
    inside = inside_classes([Module, Module, "text", nn.Module])
    assert [part.get("__module__") for part in inside] == [__name__, "torch.nn.modules.module"]
    assert "forward" in inside[0]
    assert next(iter(code(key(Module()))))["__module__"] == __name__
    assert len(inside_classes([int])) == 1


def test_whose_code_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "script", types.ModuleType("script"))  # as a notebook: without a file
    monkeypatch.setitem(sys.modules, "beside", types.ModuleType("beside"))
    sys.modules["beside"].__file__ = str(Path.home() / "beside.py")
    for module in ("staf_torch", "staf_torch.lanes.tree", "math", "collections.abc", "torch.nn", "numpy"):
        assert installed(module)
    for module in ("script", "beside", "no_such_module", __name__):
        assert not installed(module)
    assert is_users(Module)
    assert is_users(test_whose_code_it_is)
    assert not is_users(nn.Module)
    assert not is_users(functools.wraps)
    assert not is_users(int)
    assert reads_users_code(Module())
    assert reads_users_code([{"a": (scaled(2.0),)}])
    assert not reads_users_code(nn.Linear(1, 1), kernels.GaussianKernel(), math, 3, "x", torch.ones(1))


def test_what_a_function_looks_up() -> None:
    def outer(x: Any) -> Any:
        return [np.sin(y) for y in (lambda z: math.tau * torch.nn.functional.relu(z) + x)(x)]

    found = {(lookup.space.get("__name__"), lookup.name): lookup for lookup in lookups(outer)}
    assert {(__name__, "np"), (__name__, "math"), ("numpy", "sin"), ("math", "tau")} <= found.keys()
    assert ("torch", "nn") in found
    assert ("torch.nn.functional", "relu") in found
    assert found["math", "tau"].value == math.tau
    assert found["math", "tau"].installed
    assert not found[__name__, "np"].installed
    assert len(found) == len(list(lookups(outer)))  # each once
    module = types.ModuleType("closed")
    module.gain = 3.0  # type: ignore[attr-defined]

    def closing() -> Any:
        return module.gain

    assert [lookup.value for lookup in lookups(closing) if lookup.name == "gain"] == [3.0]


def test_a_name_without_a_value_and_sameness() -> None:
    def make() -> Callable[[], Any]:
        def inner() -> Any:
            return later

        if math.tau < 0:
            later = 1
        return inner

    assert content_of(make().__closure__[0]) is EMPTY  # type: ignore[index]
    assert content_of(scaled(3).__closure__[0]) == 3  # type: ignore[index]
    assert not isinstance(written((make(),)), str)
    one, other = [1], [1]
    assert Same(one) == Same(one)
    assert hash(Same(one)) == hash(Same(one))
    assert Same(one) != Same(other)
    assert Same(one) != one


def test_what_a_function_closes_over_counts_by_its_content_and_a_module_by_itself() -> None:
    assert key(scaled([1, 2.5])) == key(scaled([1, 2.5]))
    one, other = types.ModuleType("one"), types.ModuleType("one")  # of no folder: a user may change them
    assert not isinstance(written((scaled(one),)), str)
    assert key(scaled(one)) == key(scaled(one)) != key(scaled(other))
    assert isinstance(written((one,)), str)  # by itself nobody knows what is asked of it

    def later(assigned: bool) -> Callable[[], Any]:
        def inner() -> Any:
            return name

        if assigned:
            name = object()
        return inner

    assert key(later(False)) == key(later(False)) != key(later(True))
    space: dict[str, Any] = {}
    exec("def nameless(): return 1", space)
    assert is_users(space["nameless"])  # a function of no module


# Watches.


class Slots:
    __slots__ = ("number",)


WATCHED: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "a list grows": (lambda: [1], lambda v: v.append(2)),
    "an entry of a list": (lambda: [1, 2], lambda v: v.__setitem__(0, 3)),
    "an entry of a dictionary": (lambda: {"a": 1}, lambda v: v.update(a=2)),
    "another key": (lambda: {"a": 1}, lambda v: v.update(b=2)),
    "a set": (lambda: {1, 2}, lambda v: (v.remove(1), v.add(3))),
    "an array": (lambda: np.ones(2), lambda v: v.__setitem__(0, 2.0)),
    "the largest array": (lambda: np.ones(2048), lambda v: v.__setitem__(2047, 2.0)),
    "a tensor": (lambda: torch.ones(2), lambda v: v.add_(1)),
    "a tensor of integers": (lambda: torch.tensor([1]), lambda v: v.add_(1)),
    "an attribute": (lambda: nn.ReLU(), lambda v: setattr(v, "inplace", True)),
    "inside": (lambda: ([{"a": [1]}],), lambda v: v[0][0]["a"].append(2)),
    "a default": (lambda: scaled(1), lambda v: setattr(v, "__defaults__", (3,))),
    "code": (lambda: scaled(1), lambda v: setattr(v, "__code__", (lambda by: lambda x: by)(1).__code__)),
    "a closure": (lambda: scaled(1), lambda v: setattr(v.__closure__[0], "cell_contents", 2)),
    "a buffer": (lambda: nn.BatchNorm1d(2), lambda v: setattr(v, "running_mean", torch.ones(2))),
}


@pytest.mark.parametrize("name", WATCHED)
def test_a_watch_sees_what_changes(name: str) -> None:
    make, change = WATCHED[name]
    value, other = make(), make()
    watch = Watch(value, other)
    assert not watch.blind
    assert watch.unchanged()
    assert watch.unchanged()
    change(value)
    assert not watch.unchanged()


def test_a_watch_is_blind_where_it_cannot_see(monkeypatch: pytest.MonkeyPatch) -> None:
    held = Slots()
    held.number = 1
    for value in (held, np.ones(2049), (x for x in ())):
        watch = Watch(value)
        assert watch.blind
        assert not watch.unchanged()
    assert not Watch((1, 2.0, "x", b"x", None, frozenset((1,)), slice(1), range(3), 1j, torch.float32)).blind
    assert len(Watch(torch.ones(1), [torch.tensor([1])]).tensors) == 2
    watch = Watch(Module())
    monkeypatch.setattr(Module, "gain", 3.0)
    assert not watch.unchanged()


def test_only_the_library_and_those_it_builds_on_may_write_its_functions() -> None:
    assert patches._numerical("staf_torch.kernels.gaussian")
    assert patches._numerical("staf_torch")
    assert patches._numerical("staf_torch.lanes.graph")
    for name in (
        "staf_torch.cli",
        "staf_torch.cli.table",
        "staf_torch.lanes.build",
        "staf_torch_other",
        "torch",
    ):
        assert not patches._numerical(name)
    assert patches._origin(functools.wraps) == "functools"
    assert patches._origin(nn.functional.relu) == "torch"
    assert patches._origin(scaled) == __name__
    assert patches._origin(Path.home.__func__) in ("pathlib", "pathlib._local")  # type: ignore[attr-defined]
    assert list(patches._functions(property(scaled, None, key))) == [scaled, key]
    assert list(patches._functions(staticmethod(scaled))) == [scaled]
    assert list(patches._functions(functools.partial(functools.partial(scaled, 1), 2))) == [scaled]
    assert list(patches._functions(functools.lru_cache(scaled))) == [scaled]
    assert list(patches._functions(Module)) == []
    assert list(patches._functions(3)) == []
    assert list(patches._functions(Module())) == [nn.Module.__call__]
