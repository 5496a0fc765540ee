"""Where the numbers of small programs are computed, and which maps are computed where they are read."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from staf_torch.lanes.fusion import ends_with, evenly, leaves, taken_over
from staf_torch.lanes.graph import FLAG, NOW, REAL, ROW, STEP, WHOLE, Graph, Loop
from staf_torch.lanes.rolled_choices import many
from staf_torch.lanes.schedule import Schedule


class Small:
    """Two numbers of a row, one of a time, one that is carried."""

    def __init__(self) -> None:
        self.graph = graph = Graph(False)
        self.x, self.y = (graph.add("row", (), REAL, (0, k), ROW) for k in range(2))
        self.t = graph.add("now", (), REAL, (0, 0), NOW)
        self.s = graph.add("state", (), REAL, (0, 0), STEP)

    def __call__(self, op: str, *args: int) -> int:
        return self.graph.apply(op, *args)

    def loop(self, initial: int | None = None, depth: int = STEP + 1) -> tuple[int, Loop, int]:
        """A loop of one number that begins with x or another: its number, itself, and the number inside."""
        number = len(self.graph.loops)
        loop = Loop(3, depth)
        self.graph.loops.append(loop)
        inside = self.graph.add("carry", (), REAL, (number, 0), depth)
        loop.carry, loop.initial = [inside], [self.x if initial is None else initial]
        return number, loop, inside

    def close(self, number: int, following: int, home: int) -> int:
        """Its last number."""
        loop = self.graph.loops[number]
        loop.following, loop.home = [following], home
        loop.node = self.graph.add("loop", tuple(sorted({*loop.initial})), "none", number, home)
        return self.graph.add("result", (loop.node,), REAL, (number, 0))


@pytest.fixture
def b() -> Small:
    return Small()


def test_a_number_is_found_as_early_as_it_can_be(b: Small) -> None:
    product, power = b("mul", b.x, b.y), b("exp", b.t)
    moved = b("mul", b.s, power)
    ends = b("add", product, moved)
    unread = b("sin", b.s)
    plan = Schedule(b.graph, [ends], [power])
    assert plan.live == {b.x, b.y, b.t, b.s, product, power, moved, ends}
    assert unread not in plan.live
    assert plan.uses == {b.x: 1, b.y: 1, b.t: 1, b.s: 1, product: 1, power: 2, moved: 1, ends: 1}
    assert plan.ahead == set()
    assert plan.fused == {ends: 1}  # of the same depth; the product of a row is no part of a step
    assert plan.block(ROW) == [b.x, b.y, product]
    assert plan.block(NOW) == []
    assert plan.block(STEP) == [b.t, b.s, power, ends]
    assert plan.cut() == [product]
    assert plan.together(b.s, ends)
    assert plan.together(b.t, ends)
    assert not plan.together(b.x, ends)
    early = Schedule(b.graph, [ends], [power], ahead=True)
    assert early.ahead == {b.t, power}
    assert early.block(NOW) == [b.t, power]
    assert early.block(STEP) == [b.s, ends]
    assert early.cut_ahead() == [power]
    assert early.cut() == [product]
    assert not early.together(b.t, ends)


def test_what_a_row_has_a_hand_in_is_not_found_ahead(b: Small) -> None:
    mixed, alone = b("mul", b.x, b.t), b("sin", b.t)
    plan = Schedule(b.graph, [b.s], [mixed, b("add", mixed, alone)], ahead=True)
    assert plan.ahead == {b.t, alone}
    assert plan.cut_ahead() == [alone]
    assert Schedule(b.graph, [b.s], [b.x, b("mul", b.x, b.y)]).cut() == [b("mul", b.x, b.y)]


def test_a_product_is_part_of_a_sum_that_alone_needs_it(b: Small) -> None:
    one, other = b("mul", b.s, b.s), b("mul", b.s, b.t)
    for op in ("add", "sub"):
        both = b(op, one, other)
        assert Schedule(b.graph, [b.s], [both]).fused == {both: 1}
        assert Schedule(b.graph, [b.s], [both, other]).fused == {both: 0}
        assert Schedule(b.graph, [b.s], [both, one]).fused == {both: 1}
        assert Schedule(b.graph, [one], [both, other]).fused == {}
        assert Schedule(b.graph, [b.s], [b(op, one, b.t)]).fused == {b(op, one, b.t): 0 if op == "sub" else 1}
    assert Schedule(b.graph, [b.s], [b("max", one, other), b("div", one, b.t)]).fused == {}
    whole = b.graph.add("row", (), WHOLE, (1, 0), ROW)
    count = b("add", b("mul", whole, whole), whole)
    assert Schedule(b.graph, [b.s], [count]).fused == {}


def test_a_product_of_times_alone_is_no_part_of_a_sum_in_a_step(b: Small) -> None:
    square = b("mul", b.t, b.t)
    early, late = b("add", square, b("sin", b.t)), b("add", square, b("mul", b.x, b.t))
    assert Schedule(b.graph, [b.s], [early], ahead=True).fused == {early: b.graph.args[early].index(square)}
    place = b.graph.args[late].index(square)
    assert Schedule(b.graph, [b.s], [late], ahead=True).fused == {late: 1 - place}
    assert Schedule(b.graph, [b.s], [late]).fused == {late: 1}


def test_a_loop_stands_where_what_it_reads_is_known(b: Small) -> None:
    number, loop, inside = b.loop()
    body = b("mul", inside, b.y)
    ends = b.close(number, body, ROW)
    after = b("add", ends, b.s)
    plan = Schedule(b.graph, [after], [])
    assert plan.carries == {0: {0}}
    assert plan.body(0) == [inside, body]
    assert loop.node in plan.block(ROW)
    assert plan.block(STEP) == [b.s, after]
    assert plan.cut() == [ends]
    assert plan.collected(0) == set()
    assert plan.uses[body] == 1
    assert plan.uses[b.y] == 1
    assert plan.uses[b.x] == 1  # where it begins: the node of the loop itself counts none
    unread = Schedule(b.graph, [b.s], [])
    assert unread.live == {b.s}
    assert unread.carries == {}


def test_only_what_steps_read_is_kept_of_what_a_row_has(b: Small) -> None:
    product = b("mul", b.x, b.y)
    power = b("exp", product)
    assert Schedule(b.graph, [b("add", power, b.s)], []).cut() == [power]
    for home, kept in ((ROW, []), (STEP, [product, power])):
        again = Small()
        product, power = again("mul", again.x, again.y), again("exp", again("mul", again.x, again.y))
        number, _, inside = again.loop(product)
        ends = again.close(number, again("mul", inside, power), home)
        plan = Schedule(again.graph, [again("add", ends, again.s)], [])
        assert plan.cut() == (kept or [ends])


def test_only_what_steps_read_is_kept_of_what_times_decide(b: Small) -> None:
    for home, kept in ((NOW, []), (STEP, ["root", "power"])):
        again = Small()
        found = {"root": again("sqrt", again.t), "power": again("exp", again("sqrt", again.t))}
        number, loop, inside = again.loop(found["root"])
        third = again.graph.constant(0.3, REAL)  # of no time, be it inside
        first = again("mul", inside, third)
        body = again("mul", first, found["power"])
        last = body if home == NOW else again("add", body, again.s)
        ends = again.close(number, last, home)
        plan = Schedule(again.graph, [again("add", ends, again.s)], [], ahead=True)
        assert plan.cut_ahead() == ([found[name] for name in kept] or [ends])
        assert plan.cut() == []
        inner = {loop.node, inside, first, body, ends} if home == NOW else set()
        assert plan.ahead == {again.t, *found.values(), *inner}
        assert plan.body(number)[:2] == [inside, first]


@pytest.mark.parametrize(("op", "depth"), [("row", ROW), ("now", NOW)])
def test_of_an_entry_the_whole_array_is_kept(op: str, depth: int, b: Small) -> None:
    graph = b.graph
    numbers = [graph.add(op, (), REAL, (1, k), depth) for k in range(3)]
    pack = graph.add("pack", numbers, REAL, 3)
    array = graph.add("map", (pack,), REAL, ("exp", (3,), (0, 1, 2)))
    entry = graph.add("elem", (array,), REAL, 1)
    plan = Schedule(graph, [b("add", entry, b.s)], [], ahead=True)
    assert (plan.cut() if op == "row" else plan.cut_ahead()) == [array]
    assert (plan.cut_ahead() if op == "row" else plan.cut()) == []
    unread = Schedule(graph, [b.s], [b("add", b.x, b.t)], ahead=True)
    assert unread.cut() == unread.cut_ahead() == []


def test_a_loop_in_a_loop_is_found_with_it(b: Small) -> None:
    outer, loop, inside = b.loop()
    inner, other, deep = b.loop(inside, STEP + 2)
    body = b("sin", deep)
    middle = b.close(inner, body, STEP + 1)
    ends = b.close(outer, b("add", middle, b.y), ROW)
    plan = Schedule(b.graph, [b("add", ends, b.s)], [])
    assert plan.body(inner) == [deep, body]
    assert plan.body(outer) == [inside, other.node, middle, loop.following[0]]
    assert plan.cut() == [ends]
    assert loop.node in plan.block(ROW)
    assert not plan.together(deep, inside)
    assert plan.together(inside, middle)


def test_what_passes_put_out_is_kept_with_what_it_needs(b: Small) -> None:
    number, loop, inside = b.loop()
    body, out = b("sin", inside), b("exp", inside)
    b.close(number, body, ROW)
    loop.collected = [[out], [b("cos", inside)]]
    array = b.graph.add("collect", (loop.node,), REAL, (number, 0, 3))
    entry = b.graph.add("elem", (array,), REAL, 2)
    plan = Schedule(b.graph, [b("add", entry, b.s)], [])
    assert plan.collected(0) == {0}
    assert plan.carries == {0: {0}}
    assert plan.body(0) == [inside, body, out]
    assert plan.cut() == [array]
    assert b("cos", inside) not in plan.live


def test_a_loop_that_a_row_ends_needs_what_it_asks(b: Small) -> None:
    number, loop, inside = b.loop()
    loop.going = b("lt", inside, b.s)
    body = b("sin", inside)
    ends = b.close(number, body, STEP)
    plan = Schedule(b.graph, [ends], [])
    assert plan.body(0) == [inside, loop.going, body]
    assert plan.uses[loop.going] == 1
    assert b.s in plan.live
    assert plan.cut() == []


def test_products_with_a_matrix_that_all_rows_share_are_told(b: Small) -> None:
    graph = b.graph
    shared = graph.add("pack", [graph.parameter(k, REAL) for k in range(4)], REAL, 4)
    fixed = graph.add("pack", [graph.constant(float(k), REAL) for k in range(4)], REAL, 4)
    own = graph.add("pack", [b.s, b.x, b.y, b.t], REAL, 4)
    aux = (2, 2, (0, 1, 2, 3), (0, 1, 0, 1))
    plan = Schedule(graph, [b.s], [])
    for pair, wanted in (
        ((shared, own), True),
        ((own, fixed), True),
        ((own, own), False),
        ((own, b.s), False),
    ):
        assert plan.shares_a_matrix(graph.add("dot", pair, REAL, aux)) is wanted
    assert not plan.shares_a_matrix(graph.add("map", (shared,), REAL, ("neg", (4,), (0, 1, 2, 3))))


# Maps.


class Maps:
    """An array of numbers that are carried, and maps of it."""

    def __init__(self, count: int = 10) -> None:
        self.graph, self.count = Graph(False), count
        self.state = [self.graph.add("state", (), REAL, (0, k), STEP) for k in range(count)]
        self.pack = self.graph.add("pack", self.state, REAL, count)

    def map(self, op: str, *read: int, at: Sequence[int] | None = None) -> int:
        """A map that reads arrays entry by entry, or at other places."""
        places = tuple(range(self.count)) if at is None else tuple(at)
        return self.graph.add("map", read, REAL, (op, (len(places),), *[places] * len(read)))

    def entries(self, array: int) -> list[int]:
        return [self.graph.add("elem", (array,), REAL, k) for k in range(self.graph.size(array))]

    def taken(self, last: int, *outputs: int) -> set[int]:
        return taken_over(self.graph, Schedule(self.graph, self.entries(last), outputs))


def test_a_map_that_one_other_reads_is_computed_there() -> None:
    m = Maps()
    first = m.map("exp", m.pack)
    second = m.map("neg", first)
    third = m.map("sin", second)
    assert m.taken(third) == {first, second}
    assert m.taken(third, m.entries(first)[2]) == {second}
    assert m.taken(first) == set()
    assert m.taken(m.map("add", first, second)) == {second}  # two read the first
    assert m.taken(m.map("mul", second, second)) == {first}  # every entry twice is too often


@pytest.mark.parametrize(("length", "taken"), [(4, True), (5, True), (6, False)])
def test_a_map_of_which_few_entries_are_read_twice_is_computed_where_it_is_read(
    length: int, taken: bool
) -> None:
    """Two pieces that overlap: ten entries of eight are the most, twelve of nine too many."""
    m = Maps(9)
    first = m.map("exp", m.pack)
    places = tuple(3 * piece + k for piece in range(2) for k in range(length))
    last = m.graph.add("map", (first,), REAL, ("neg", (2, length), places))
    assert m.taken(last) == ({first} if taken else set())


def test_places_that_no_loops_reach_evenly_are_read_from_memory() -> None:
    m = Maps()
    first = m.map("exp", m.pack)
    assert m.taken(m.map("neg", first, at=range(9, -1, -1))) == {first}
    assert m.taken(m.map("neg", first, at=[1, 0, 2, 3, 4, 5, 6, 7, 8, 9])) == set()


@pytest.mark.parametrize(("count", "longest"), [(24, 24), (25, 24), (30, 24)])
def test_an_expression_has_twenty_four_operations_at_most(count: int, longest: int) -> None:
    m = Maps()
    chain = [m.map("exp", m.pack)]
    for k in range(count - 1):
        chain.append(m.map(("neg", "exp")[k % 2], chain[-1]))
    found = m.taken(chain[-1])
    broken = [k + 1 for k, node in enumerate(chain[:-1]) if node not in found]
    assert broken == ([longest] if count > longest else [])


@pytest.mark.parametrize(("count", "taken"), [(11, True), (12, False)])
def test_a_map_that_is_read_for_two_operands_is_written_twice(count: int, taken: bool) -> None:
    m = Maps()
    chain = [m.map("exp", m.pack)]
    for k in range(count - 1):
        chain.append(m.map(("neg", "exp")[k % 2], chain[-1]))
    halves = tuple(range(5)), tuple(range(5, 10))
    last = m.graph.add("map", (chain[-1], chain[-1]), REAL, ("add", (5,), *halves))
    assert m.taken(last) == set(chain if taken else chain[:-1])


def test_the_leaves_of_a_map_are_those_of_the_maps_in_it() -> None:
    m = Maps(3)
    first = m.map("exp", m.pack, at=[2, 0, 1])
    second = m.graph.add("map", (first, m.state[0]), REAL, ("add", (2,), (1, 2), None))
    assert list(leaves(m.graph, (), second)) == [(first, (1, 2)), (m.state[0], None)]
    assert list(leaves(m.graph, {first}, second)) == [(m.pack, (0, 1)), (m.state[0], None)]
    assert list(leaves(m.graph, {first}, second, (1,))) == [(m.pack, (1,)), (m.state[0], None)]
    assert evenly((5,), []) == ([], 5)
    assert evenly(None, [2, 3]) == ([0, 0], 0)
    assert evenly((3, 4), [1, 2]) == ([0, 1], 3)
    assert evenly((0, 1, 2, 0, 1, 2), [2, 3]) == ([0, 1], 0)
    assert evenly((4, 4), [2]) == ([0], 4)
    assert evenly((4, 2, 0), [3]) == ([-2], 4)


def test_a_map_that_alone_makes_a_slot_may_write_over_it() -> None:
    m = Maps()
    graph, copy = m.graph, m.map("neg", m.pack)

    def written(
        node: int, *outputs: int, following: Sequence[int] | None = None, taken: Sequence[int] = ()
    ) -> bool:
        nodes = m.entries(node) if following is None else following
        found = ends_with(graph, Schedule(graph, nodes, outputs), taken, 0, nodes)
        assert found in (None, node)
        return found == node

    assert written(copy)
    assert not written(copy, m.entries(copy)[3])  # an output reads it as well
    assert not written(copy, following=m.entries(copy)[:9])
    assert not written(copy, following=m.entries(copy)[::-1])
    assert not written(m.pack)
    assert not written(m.state[0], following=m.state)
    assert not written(m.map("neg", m.pack, at=[1, 0, *range(2, 10)]))  # reads what it has written over
    other = graph.add("pack", [graph.add("row", (), REAL, (0, k), ROW) for k in range(10)], REAL, 10)
    assert written(m.map("neg", other))
    assert written(m.map("add", m.pack, other))
    mixed = graph.add("pack", [*graph.args[other][:1], *m.state[1:]], REAL, 10)
    assert written(m.map("neg", mixed))  # a copy, with another number in it
    foreign = graph.add("pack", [graph.add("state", (), REAL, (1, k), STEP) for k in range(10)], REAL, 10)
    assert not written(m.map("neg", foreign))
    inner = m.map("exp", m.pack)
    assert written(m.map("cos", inner), taken=[inner])
    turned = m.map("exp", m.pack, at=range(9, -1, -1))
    assert not written(m.map("cos", turned), taken=[turned])
    assert graph.type[copy] != FLAG


def test_from_a_hundred_and_twenty_nine_choices_on_a_loop_goes_through_them() -> None:
    a, row = torch.zeros(1, 16, 4), torch.zeros(1, 8, 4, dtype=torch.int64)
    few, more = row[:, :2], torch.zeros(1, 9, dtype=torch.int64)
    assert not many("gather", a, 1, few)  # 8 places, 16 entries each
    assert many("gather", a, 1, row[:, :3])
    assert many("scatter", a, 1, row[:, :3])
    assert many("scatter_add", a, -2, row[:, :3])
    assert not many("index_select", a, 1, more[0, :2])  # 2 places, 16 entries of 4
    assert many("index_select", a, 1, more[0, :3])
    assert many("gather", a, 2, torch.zeros(1, 11, 3, dtype=torch.int64))  # 33 places of 4
    assert not many("gather", a, 2, torch.zeros(1, 16, 2, dtype=torch.int64))
    assert many("index_select", torch.zeros(1, 130), 0, torch.zeros(1, dtype=torch.int64))
    assert not many("index_select", torch.zeros(1, 128), 0, torch.zeros(1, dtype=torch.int64))
    assert not many("index_select", torch.zeros(0, 130), 0, torch.zeros(1, dtype=torch.int64))
    assert not many("cumsum", a, 1, row)
    assert not many("gather", a, 1, row.bool())
    assert not many("gather", a, 1.0, row)
    assert not many("gather", a, 1, [1] * 99)
    assert not many("gather", torch.tensor(1.0), 0, torch.zeros(200, dtype=torch.int64))
