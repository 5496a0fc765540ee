"""What a compiled program is handed: addresses, strides, rooms; what decides whether it is called at all."""

from __future__ import annotations

import ctypes
import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from staf_torch import lanes
from staf_torch.lanes import Shared
from staf_torch.lanes import plan as plans
from staf_torch.lanes.given import Given
from staf_torch.lanes.plan import Compiled, Plan, _even, _inner, form, ordinary
from staf_torch.lanes.tree import flatten, labels, moved, plain, unflatten

ROWS, TIMES, EVERY = 3, 5, 2
RECORDED = 3
KINDS = {torch.float64: ctypes.c_double, torch.float32: ctypes.c_float}


class Library:
    """In the place of machine code: reads every number of the inputs, and numbers all places of the rooms."""

    def __init__(self, real: torch.dtype, table: Tensor) -> None:
        self.kind, self.size, self.table = KINDS[real], torch.empty(0, dtype=real).element_size(), table
        self.read: list[list[float]] = []
        self.inputs = self.carries = 0

    def __call__(self, reference: int, addresses: bytes, threads: int) -> None:
        call = plans._Call.from_address(reference)
        count = len(addresses) // 8
        slots = (plans._Slot * count).from_address(call.slots)
        assert (call.rows, call.times, call.every) == (ROWS, TIMES, EVERY)
        assert call.table == self.table.data_ptr()
        assert threads == torch.get_num_threads()
        places = struct.unpack(f"{count}q", addresses)
        self.read = [
            [self.at(place, slot, row, time, entry).value for row, time, entry in self.places(slot, TIMES)]
            for place, slot in zip(places[: self.inputs], slots, strict=False)
        ]
        for k in range(self.inputs, count):
            times = 1 if k < self.inputs + self.carries else RECORDED
            for row, time, entry in self.places(slots[k], times):
                self.at(places[k], slots[k], row, time, entry).value = (
                    100 * row + 10 * time + entry + 1000 * k
                )

    @staticmethod
    def places(slot: Any, times: int) -> Iterator[tuple[int, ...]]:
        return itertools.product(range(ROWS), range(times), range(slot.entries))

    def at(self, place: int, slot: Any, row: int, time: int, entry: int) -> Any:
        return self.kind.from_address(
            place + self.size * (row * slot.row + time * slot.time + entry * slot.entry)
        )


def drawn(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).to(dtype)


INPUTS: dict[str, tuple[Callable[[], Any], bool, bool]] = {  # what, whether times come first, whether direct
    "numbers": (lambda: drawn(ROWS), False, True),
    "vectors": (lambda: drawn(ROWS, 4), False, True),
    "every second entry": (lambda: drawn(ROWS, 8)[:, ::2], False, True),
    "rows last": (lambda: drawn(4, ROWS).mT, False, True),
    "matrices": (lambda: drawn(ROWS, 2, 3), False, True),
    "matrices turned over": (lambda: drawn(ROWS, 3, 2).mT, False, False),
    "matrices of one column": (lambda: drawn(ROWS, 2, 3)[:, :, :1], False, True),
    "single": (lambda: drawn(ROWS, 4, dtype=torch.float32), False, False),
    "integers": (lambda: torch.arange(12).view(ROWS, 4), False, False),
    "flags": (lambda: drawn(ROWS, 4) > 0, False, False),
    "shared": (lambda: Shared(drawn(4)), False, False),
    "a shared number": (lambda: Shared(drawn(1)[0]), False, False),
    "shared and turned over": (lambda: Shared(drawn(3, 2).mT), False, False),
    "one row for all": (lambda: drawn(1, 4).expand(ROWS, 4), False, True),
    "times": (lambda: drawn(ROWS, TIMES), True, True),
    "vectors of times": (lambda: drawn(ROWS, TIMES, 4), True, True),
    "times first": (lambda: drawn(TIMES, ROWS, 4).movedim(0, 1), True, True),
    "times of single": (lambda: drawn(TIMES, ROWS, 4, dtype=torch.float32).movedim(0, 1), True, False),
    "times turned over": (lambda: drawn(ROWS, TIMES, 3, 2).mT, True, False),
    "shared times": (lambda: Shared(drawn(TIMES, 2, 3)), True, False),
    "shared numbers of times": (lambda: Shared(drawn(2 * TIMES)[::2]), True, False),
}


def wanted(leaf: Any, timed: bool) -> list[float]:
    """The numbers of a leaf, row by row, time by time."""
    x = plain(leaf).double()
    x = x.unsqueeze(0).expand(ROWS, *x.shape) if isinstance(leaf, Shared) else x
    x = x if timed else x.unsqueeze(1).expand(ROWS, TIMES, *x.shape[1:])
    found: list[float] = x.reshape(ROWS, TIMES, -1).flatten().tolist()
    return found


def plan_of(names: Sequence[str], real: torch.dtype = torch.float64) -> tuple[Plan, Library, list[Any]]:
    leaves = [INPUTS[name][0]() for name in names]
    if real == torch.float32:
        swap = {torch.float64: torch.float32, torch.float32: torch.float64}
        leaves = [
            leaf if isinstance(leaf, Shared) else leaf.to(swap.get(leaf.dtype, leaf.dtype)) for leaf in leaves
        ]
    library = Library(real, torch.zeros(1, dtype=real))
    library.inputs, library.carries = len(leaves), 2
    compiled = Compiled(
        library,
        library.table,
        real,
        ((torch.Size([2, 3]), real), (torch.Size([]), torch.int64)),
        ((torch.Size([4]), real), (torch.Size([2, 2]), torch.float32), (torch.Size([]), torch.bool)),
        "structure",
    )
    timed = [INPUTS[name][1] for name in names]
    return Plan(compiled, leaves, timed, rows=ROWS, steps=TIMES, every=EVERY), library, leaves


@pytest.mark.parametrize("name", INPUTS)
def test_every_number_of_an_input_lies_where_its_slot_says(name: str) -> None:
    plan, library, leaves = plan_of([name])
    assert plan.direct is INPUTS[name][2]
    assert plan.structure == "structure"
    plan(leaves)
    assert library.read == [wanted(leaves[0], INPUTS[name][1])]


@pytest.mark.parametrize("real", [torch.float64, torch.float32])
def test_all_inputs_together_are_read_and_every_result_lies_in_its_own_place(real: torch.dtype) -> None:
    plan, library, leaves = plan_of(list(INPUTS), real)
    found = plan(leaves)
    for numbers, leaf, (_, timed, _) in zip(library.read, leaves, INPUTS.values(), strict=True):
        assert numbers == pytest.approx(wanted(leaf, timed), rel=1e-6)
    shapes = [(ROWS, 2, 3), (ROWS,), (ROWS, RECORDED, 4), (ROWS, RECORDED, 2, 2), (ROWS, RECORDED)]
    assert [tuple(x.shape) for x in found] == shapes
    assert [x.dtype for x in found] == [real, torch.int64, real, torch.float32, torch.bool]
    for k, x in enumerate(found, start=len(INPUTS)):
        times = 1 if k < len(INPUTS) + 2 else RECORDED
        grid = torch.meshgrid(
            *(torch.arange(size, dtype=torch.float64) for size in (ROWS, times, x.numel() // (ROWS * times))),
            indexing="ij",
        )
        numbers = 100 * grid[0] + 10 * grid[1] + grid[2] + 1000 * k
        assert torch.equal(x.double(), numbers.reshape(x.shape).to(x.dtype).double())


def test_results_of_many_bytes_lie_in_pages_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[torch.dtype, int]] = []

    def fresh(like: Tensor, count: int) -> Tensor:
        asked.append((like.dtype, count))
        return like.new_empty(count)

    monkeypatch.setattr(plans, "fresh", fresh)
    monkeypatch.setattr(plans, "LARGE", 8 * ROWS * 6)  # the carry of six numbers has as many bytes
    plan, _, leaves = plan_of(["vectors"])
    found = plan(leaves)
    assert asked == [(torch.float64, ROWS * count) for count in (6, RECORDED * 4, RECORDED * 4)]
    assert found[0].stride() == (1, 3 * ROWS, ROWS)


def test_strides_of_entries_and_whether_they_are_even() -> None:
    assert _inner((2, 3, 4), 5) == (60, 20, 5)
    assert _inner((), 7) == ()
    assert _even((2, 3), (3, 1))
    assert not _even((2, 3), (1, 2))
    assert _even((2, 1, 3), (6, 77, 2))
    assert _even((1, 3), (99, 1))
    assert not _even((2, 2, 2), (4, 1, 2))
    assert not _even((2, 3), (2, 1))
    assert _even((), ())


class Own(Tensor):
    pass


def test_what_is_no_ordinary_tensor_is_left_to_torch() -> None:
    x = torch.ones(2)
    learned = nn.Parameter(torch.ones(2))
    assert ordinary((x, Shared(x)))
    assert ordinary(())
    assert not ordinary((x, learned))
    assert not ordinary((Shared(learned),))
    assert not ordinary((x.clone().requires_grad_(),))
    assert not ordinary((x, x.to("meta")))
    assert not ordinary((x.as_subclass(Own), x))
    with torch.no_grad():
        assert ordinary((learned, x))
    seen: list[bool] = []

    def look(y: Tensor) -> Tensor:
        seen.append(ordinary((x,)))
        return y.sum()

    torch.func.grad(look)(x)
    torch.func.vmap(look)(x.view(2, 1))
    make_fx(look)(x)
    with forward_ad.dual_level():
        look(x)
    assert seen == [False] * 4
    look(x)
    assert seen[-1] is True


def test_the_form_of_an_input_is_its_shape_its_strides_its_dtype_and_whether_it_is_shared() -> None:
    x = torch.ones(2, 3)
    forms = [form(leaf) for leaf in (x, x.mT, x.double(), Shared(x), x[:1], x.clone())]
    assert len(set(forms[:5])) == 5
    assert forms[5] == forms[0] == ((2, 3), (3, 1), torch.float32, False)


# Given.


def given(carry: Any = (), now: Any = (), row: Any = (), steps: int | None = None) -> Given:
    return Given.of(carry, now, row, steps)


def test_rows_and_times_are_those_of_the_first_tensors() -> None:
    x, u = torch.zeros(4, 2), torch.zeros(4, 7, 3)
    assert given(x, u)[-2:] == (4, 7)
    assert given(x, (Shared(u[0]), u))[-2:] == (4, 7)
    assert given((), (), (Shared(x), u), steps=3)[-2:] == (4, 3)
    assert given(x, (), (), steps=9).times == 9
    assert given(x, u, steps=2).times == 7  # inputs know better
    with pytest.raises(ValueError, match=r"`Program\(steps=\.\.\.\)` must be given"):
        given(x)
    with pytest.raises(ValueError, match="at least one tensor with a dimension of rows; got none"):
        given((), Shared(u[0]), Shared(x))
    with pytest.raises(ValueError, match="at least one tensor"):
        given(steps=2)


def test_the_precision_of_a_program_is_the_highest_of_its_inputs() -> None:
    single, double, whole = torch.zeros(2), torch.zeros(2).double(), torch.zeros(2, dtype=torch.int64)
    for parts, real in {
        (single, single): torch.float32,
        (single, whole): torch.float32,
        (single, double): torch.float64,
        (double, whole): torch.float64,
        (whole, whole): torch.float64,
    }.items():
        assert given(*parts[:1], (), parts[1], steps=1).real == real
        assert given(parts[0], parts[1].unsqueeze(1)).real == real
    assert given(single, (), Shared(double), steps=1).real == torch.float64


def test_programs_are_told_apart_by_the_shapes_of_a_row_and_by_nothing_else() -> None:
    def key(carry: Any, now: Any, row: Any) -> Any:
        return given(carry, now, row, 1).key()

    c, n, r = torch.zeros(4, 2), torch.zeros(4, 6, 3), torch.zeros(4, 5)
    same = key(c, n, r)
    assert key(c[:2], n[:2, :3], r[:2]) == same
    others = [
        *(key(c[:, :1], n, r), key(c, n[..., :1], r), key(c, n, r[:, :1]), key(c.double(), n, r)),
        *(key(c, n.double(), r), key(c, n, r.double()), key(c, Shared(n[0]), r), key(c, n, Shared(r[0]))),
        *(key((c,), n, r), key(c, [n], r), key(c, n, {"r": r}), key(c, n, (r, r)), key(c, (n, n), r)),
    ]
    assert len({same, *others}) == len(others) + 1
    shared = key(c, Shared(n[0]), Shared(r[0]))
    assert key(c[:1], Shared(n[0, :2]), Shared(r[0])) == shared
    assert key(c, Shared(n[0, :, :1]), Shared(r[0])) != shared
    assert key(c, Shared(n[0]), Shared(r[0, :1])) != shared


def test_nothing_is_compiled_for_no_row_or_no_time() -> None:
    x = torch.zeros(2, 1)
    assert given(x, x.unsqueeze(1)).ordinary()
    assert given(x[:1], (), (), steps=1).ordinary()
    assert not given(x[:0], (), (), steps=1).ordinary()
    assert not given(x, (), (), steps=0).ordinary()
    assert not given(x, (), (), steps=1)._replace(carry=[x.clone().requires_grad_()]).ordinary()
    assert not given((x, nn.Parameter(x)), (), (), steps=1).ordinary()
    assert not given(x, nn.Parameter(x.unsqueeze(1)), ()).ordinary()
    assert not given(x, (), nn.Parameter(x), steps=1).ordinary()


# Trees.


class Pair(NamedTuple):
    a: Any
    b: Any


def test_a_tree_is_found_again_from_its_leaves() -> None:
    one, two, learned = torch.zeros(1), Shared(torch.ones(2)), nn.Parameter(torch.ones(3))
    tree = {"x": (one, [two, None]), "y": Pair(learned, ()), "z": {"n": 3, "t": one}, "u": [], "s": "text"}
    leaves, structure = flatten(tree)
    assert [id(leaf) for leaf in leaves] == [id(one), id(two), id(learned), id(one)]
    assert hash(structure) == hash(flatten(tree)[1])
    again = unflatten(structure, iter("abcd"))
    assert again == {
        "x": ("a", ["b", None]),
        "y": Pair("c", ()),
        "z": {"n": 3, "t": "d"},
        "u": [],
        "s": "text",
    }
    assert type(again["y"]) is Pair
    assert flatten([one]) != flatten((one,))
    kinds = [
        (),
        [],
        (one,),
        [one],
        Pair(one, one),
        (one, one),
        {"a": one, "b": one},
        {"b": one, "a": one},
        None,
        one,
    ]
    assert len({flatten(kind)[1] for kind in kinds}) == len(kinds)
    assert [len(flatten(kind)[0]) for kind in kinds] == [0, 0, 1, 1, 2, 2, 2, 2, 0, 1]


def test_leaves_are_called_by_their_keys_and_fields_else_by_numbers() -> None:
    x = torch.zeros(1)

    def names(tree: Any, prefix: str = "row") -> list[str]:
        return labels(flatten(tree)[1], prefix)

    assert names(x) == ["row"]
    assert names((x, None, x), "out") == ["out0", "out2"]
    assert names({"a": x, "b": (x, x)}, "carry") == ["a", "b0", "b1"]
    assert names(Pair(x, {"c": x}), "now") == ["a", "b_c"]
    assert names([Pair(x, x), x]) == ["row0_a", "row0_b", "row1"]
    assert names(None) == []


def test_trees_move_with_what_all_rows_share() -> None:
    tree = moved((torch.zeros(2), {"s": Shared(torch.zeros(3))}), "meta")
    assert tree[0].device.type == "meta"
    assert isinstance(tree[1]["s"], Shared)
    assert tree[1]["s"].tensor.device.type == "meta"
    assert plain(tree[1]["s"]) is tree[1]["s"].tensor
    assert plain(tree[0]) is tree[0]


# The definition.


@pytest.mark.parametrize(("every", "kept"), [(1, [0, 1, 2, 3, 4]), (2, [0, 2, 4]), (3, [0, 3]), (7, [0])])
def test_the_definition_takes_every_time_and_records_some(every: int, kept: list[int]) -> None:
    seen: list[tuple[int, ...]] = []

    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        seen.append((int(now[0][0]), int(now[1]), int(row[0][0]), int(row[1])))
        return carry + 1, {"now": now[0], "carry": carry}

    program = lanes.Program(step, compile=False)
    u = torch.arange(5.0).repeat(2, 1)
    given = (
        torch.zeros(2),
        (u, Shared(10 + torch.arange(5.0))),
        (torch.tensor([7.0, 8.0]), Shared(torch.tensor(9.0))),
    )
    for run in (program.definition, program, program.prepare(*given, every=every)):
        seen.clear()
        end, out = run(*given, **({} if run not in (program.definition, program) else {"every": every}))
        assert seen == [(k, 10 + k, 7, 9) for k in range(5)]
        assert end.tolist() == [5.0, 5.0]
        assert out["now"].tolist() == out["carry"].tolist() == [kept, kept]
    assert not program.compiles(*given)
    empty = lanes.Program(lambda carry, now, row: (carry, ()), compile=False)
    assert empty(torch.zeros(2), steps=3)[1] == ()
