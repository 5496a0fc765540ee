"""What a scalar program simplifies, node by node: exact in every bit, and no more than that."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from staf_torch.lanes.graph import FLAG, NOW, REAL, ROW, STEP, WHOLE, WIDE, Graph, Loop

ONCE = (
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "tanh",
    "sqrt",
    "expm1",
    "log1p",
    "floor",
    "ceil",
    "trunc",
    "round",
)


class Board:
    """A graph with a few inputs."""

    def __init__(self, single: bool = False) -> None:
        self.graph = graph = Graph(single)
        self.x, self.y = (graph.add("row", (), REAL, (0, k), ROW) for k in range(2))
        self.t = graph.add("now", (), REAL, (0, 0), NOW)
        self.s = graph.add("state", (), REAL, (0, 0), STEP)
        self.p, self.q = (graph.add("row", (), FLAG, (1, k), ROW) for k in range(2))
        self.k = graph.add("row", (), WHOLE, (2, 0), ROW)
        self.w = graph.add("row", (), WIDE, (3, 0), ROW)

    def number(self, value: float, type: str = REAL) -> int:
        return self.graph.constant(value, type)

    def __call__(self, op: str, *args: int) -> int:
        return self.graph.apply(op, *args)

    def node(self, node: int) -> tuple[Any, ...]:
        return self.graph.op[node], self.graph.args[node], self.graph.type[node]


@pytest.fixture
def b() -> Board:
    return Board()


def test_depths_and_types_tell_apart_what_they_are_for(b: Board) -> None:
    assert len({ROW, NOW, STEP}) == 3
    assert ROW < NOW < STEP
    loop, other = Loop(3, 4), Loop(2, 4)
    assert (loop.home, loop.node, loop.going, loop.condition) == (ROW, -1, -1, [])
    for one, two in zip(
        *((each.carry, each.initial, each.following, each.collected) for each in (loop, other)), strict=True
    ):
        assert one == two == []
        assert one is not two
    loop.going = 0  # the first node of all is one, too
    assert loop.condition == [0]
    depths = b.graph.depth
    assert [depths[n] for n in (b.x, b.t, b.s)] == [ROW, NOW, STEP]
    assert depths[b("add", b.x, b.t)] == NOW
    assert depths[b("add", b.s, b.t)] == STEP
    assert depths[b.number(2.0)] == ROW
    assert depths[b.graph.add("load", (b.x,), REAL, (0, 0, 1), 7)] == 7


def test_a_node_is_made_once(b: Board) -> None:
    size = len(b.graph.op)
    one = b("mul", b.x, b.y)
    assert b("mul", b.y, b.x) == b("mul", b.x, b.y) == one == size
    assert b("sub", b.x, b.y) != b("sub", b.y, b.x)
    assert b.number(2.0) == b.number(2)
    assert b.number(0.0) != b.number(-0.0)
    assert b.number(math.nan) == b.number(-math.nan)
    assert b.number(2.0) != b.number(2.0, WHOLE)
    assert b.number(1.0) != b.number(True, FLAG) == b.number(3.0, FLAG)
    assert b.graph.parameter(0, REAL) != b.graph.parameter(1, REAL)
    for op in ("add", "eq", "ne"):
        assert b(op, b.x, b.y) == b(op, b.y, b.x)
    for op in ("lt", "le", "min", "max", "div", "atan2"):
        assert b(op, b.x, b.y) != b(op, b.y, b.x)
    for op in ("and", "or", "xor"):
        assert b(op, b.p, b.q) == b(op, b.q, b.p)
    assert [b.graph.type[b(op, b.x, b.y)] for op in ("lt", "le", "eq", "ne", "add")] == [FLAG] * 4 + [REAL]


VALUES = (0.0, -0.0, 1.0, -1.0, 2.0, -0.5, 3.25, 1e300, math.inf, -math.inf, math.nan)
ONE: dict[str, Any] = {
    **{
        name: getattr(np, name)
        for name in ("abs", "sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan")
    },
    **{
        "tanh": np.tanh,
        "neg": np.negative,
        "floor": np.floor,
        "ceil": np.ceil,
        "trunc": np.trunc,
        "round": np.rint,
    },
}
TWO: dict[str, Any] = {
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "min": np.minimum},
    **{
        "max": np.maximum,
        "atan2": np.arctan2,
        "lt": np.less,
        "le": np.less_equal,
        "eq": np.equal,
        "ne": np.not_equal,
    },
}


@pytest.mark.parametrize("single", [False, True])
def test_constants_are_computed_in_the_precision_of_the_program(single: bool) -> None:
    b = Board(single)
    kind = np.float32 if single else np.float64
    with np.errstate(all="ignore"):
        for name, function in ONE.items():
            for v in VALUES:
                found = b.graph.value(b(name, b.number(v)))
                np.testing.assert_array_equal(found, function(kind(v)).item(), err_msg=name)
        for name, function in TWO.items():
            for v in VALUES:
                for w in VALUES:
                    found = b.graph.value(b(name, b.number(v), b.number(w)))
                    wanted = function(kind(v), kind(w)).item()
                    np.testing.assert_array_equal(found, wanted, err_msg=f"{name} {v} {w}")
                    assert math.isnan(wanted) or math.copysign(1, found) == math.copysign(1, wanted)
        wide = b.graph.value(b("div", b.number(1.0, WIDE), b.number(3.0, WIDE)))
        assert wide == 1 / 3
        assert b.graph.value(b("div", b.number(1.0), b.number(3.0))) == (float(kind(1) / kind(3)))
        assert b.graph.value(b.number(0.1)) == float(kind(0.1))
        assert b.graph.value(b.number(0.1, WIDE)) == 0.1
        assert b.graph.value(b.number(1e300)) == float(kind(1e300))
    for p in (True, False):
        for q in (True, False):
            flags = b.number(p, FLAG), b.number(q, FLAG)
            found = [b.graph.value(b(op, *flags)) for op in ("and", "or", "xor")]
            assert found == [p and q, p or q, p != q]
        assert b.graph.value(b("not", b.number(p, FLAG))) is (not p)


def test_terms_that_add_nothing_go_only_where_no_sign_of_a_zero_depends_on_them(b: Board) -> None:
    zero, minus = b.number(0.0), b.number(-0.0)
    never = [b("exp", b.x), b("abs", b.x), b("mul", b.x, b.x)]  # is -0
    never += [b("add", b.x, never[0]), b("add", never[0], b.x), b("sub", never[0], b.x)]
    never += [b("min", never[0], never[1]), b("max", never[2], never[0])]
    never += [b.graph.where(b.p, never[0], never[1]), b.graph.where(b.p, b.number(2.0), b.number(0.0))]
    maybe = [
        b.x,
        b.s,
        b("neg", b.x),
        b("mul", b.x, b.y),
        b("div", b.x, b.y),
        b("add", b.x, b.y),
        b("sub", b.x, b.y),
    ]
    maybe += [
        b("min", never[0], b.x),
        b("max", b.x, never[0]),
        b.graph.where(b.p, b.x, never[0]),
        b("sin", b.x),
    ]
    maybe += [b.graph.where(b.p, never[0], b.x), b("sub", b.x, never[0]), b("floor", b.x), b("sqrt", b.x)]
    maybe += [
        b.graph.where(b.p, b.number(-0.0), b.number(1.0)),
        b.graph.where(b.p, b.number(1.0), b.number(-0.0)),
    ]
    for node in never:
        for known in (
            b("add", node, zero),
            b("add", zero, node),
            b("sub", node, minus),
            b("add", node, minus),
        ):
            assert known == node
        assert b("sub", node, zero) == b("add", minus, node) == node
    for node in maybe:
        for known in (b("add", node, zero), b("add", zero, node), b("sub", node, minus)):
            assert known != node
            assert b.graph.op[known] in ("add", "sub")
        assert b("add", node, minus) == b("add", minus, node) == b("sub", node, zero) == node
    for node in (*never, *maybe):
        assert b.node(b("sub", minus, node))[0] == "neg" or b.graph.op[node] == "neg"
        assert b.node(b("sub", zero, node))[0] in ("sub", "add")
        for other in (1.0, -1.0, 1e-300, math.nan, math.inf):
            assert b.graph.op[b("add", node, b.number(other))] in ("add", "sub")


def test_negations_are_drawn_into_sums_and_out_of_each_other(b: Board) -> None:
    minus = b("neg", b.x)
    assert b("neg", minus) == b.x
    assert b("add", b.y, minus) == b("add", minus, b.y) == b("sub", b.y, b.x)
    assert b("sub", b.y, minus) == b("add", b.y, b.x)
    assert b.node(b("sub", minus, b.y)) == ("sub", (minus, b.y), REAL)
    assert b("abs", minus) == b("abs", b.x)
    assert b("abs", b("abs", b.x)) == b("abs", b.x)
    assert b.node(b("neg", b("abs", b.x)))[0] == "neg"
    assert b("not", b("not", b.p)) == b.p
    assert b.node(b("exp", minus))[0] == "exp"


def test_factors_and_divisors_that_change_nothing_go_and_powers_of_two_divide_exactly(b: Board) -> None:
    one, less = b.number(1.0), b.number(-1.0)
    assert b("mul", b.x, one) == b("mul", one, b.x) == b("div", b.x, one) == b.x
    minus = b("neg", b.x)
    assert b("mul", b.x, less) == b("mul", less, b.x) == b("div", b.x, less) == minus
    for value in (2.0, 0.5, -4.0, 2.0**-99, 2.0**99, -0.25):
        known = b("div", b.x, b.number(value))
        assert b.graph.op[known] == "mul"
        assert 1 / value in [b.graph.value(a) for a in b.graph.args[known]]
    for value in (3.0, 0.1, 0.0, -0.0, math.inf, math.nan, 2.0**100, 2.0**-100, 2.0**101, 1.5):
        assert b.graph.op[b("div", b.x, b.number(value))] == "div"
    for value in (0.0, 2.0, -2.0, math.nan):
        assert b.graph.op[b("mul", b.x, b.number(value))] == "mul"
    assert b.graph.op[b("div", one, b.x)] == "div"
    assert b.graph.op[b("div", b.number(2.0), b.x)] == "div"


def test_extremes_and_flags_of_equals_are_themselves(b: Board) -> None:
    yes, no = b.number(True, FLAG), b.number(False, FLAG)
    for op in ("min", "max"):
        assert b(op, b.x, b.x) == b.x
        assert b.graph.op[b(op, b.x, b.y)] == op
        assert b.graph.op[b(op, b.x, b.number(0.0))] == op
    for op in ("and", "or"):
        assert b(op, b.p, b.p) == b.p
        assert b.graph.op[b(op, b.p, b.q)] == op
    assert b("and", b.p, yes) == b("and", yes, b.p) == b("or", b.p, no) == b("or", no, b.p) == b.p
    assert b("and", b.p, no) == b("and", no, b.p) == no
    assert b("or", b.p, yes) == b("or", yes, b.p) == yes
    assert b.graph.op[b("xor", b.p, b.p)] == "xor"
    assert b.graph.op[b("add", b.x, b.x)] == "add"
    for op in ("floor", "ceil", "trunc", "round"):
        assert b(op, b.k) == b.k
        assert b.graph.op[b(op, b.x)] == op


def test_choices_between_equals_and_of_what_is_known_are_none(b: Board) -> None:
    yes, no, graph = b.number(True, FLAG), b.number(False, FLAG), b.graph
    assert graph.where(yes, b.x, b.y) == graph.where(b.p, b.x, b.x) == b.x
    assert graph.where(no, b.x, b.y) == b.y
    assert graph.where(b("not", b.p), b.x, b.y) == graph.where(b.p, b.y, b.x)
    assert b.node(graph.where(b.p, b.x, b.y)) == ("where", (b.p, b.x, b.y), REAL)
    assert graph.where(b.p, yes, no) == b.p
    assert graph.where(b.p, no, yes) == b("not", b.p)
    assert b.node(graph.where(b.p, b.q, no)) == ("where", (b.p, b.q, no), FLAG)
    assert b.node(graph.where(b.p, yes, b.q)) == ("where", (b.p, yes, b.q), FLAG)
    assert b.node(graph.where(b.p, no, b.q))[0] == b.node(graph.where(b.p, b.q, yes))[0] == "where"
    one, zero = b.number(1.0), b.number(0.0)
    assert b.node(graph.where(b.p, one, zero)) == ("where", (b.p, one, zero), REAL)
    assert b.node(graph.where(b.p, zero, one)) == ("where", (b.p, zero, one), REAL)


def test_conversions_keep_the_number_and_cut_it_where_it_becomes_whole(b: Board) -> None:
    graph = b.graph
    assert graph.convert(b.x, REAL) == b.x
    for value, whole in ((2.7, 2.0), (-2.7, -2.0), (3.0, 3.0), (math.inf, math.inf)):
        assert graph.value(graph.convert(b.number(value), WHOLE)) == whole
        assert graph.value(graph.convert(b.number(value), WIDE)) == value
    assert math.isnan(graph.value(graph.convert(b.number(math.nan), WHOLE)) or 0.0)
    assert graph.value(graph.convert(b.number(0.5), FLAG)) is True
    assert graph.value(graph.convert(b.number(0.0), FLAG)) is False
    assert graph.value(graph.convert(b.number(True, FLAG), REAL)) == 1.0
    assert graph.convert(b.p, REAL) == graph.where(b.p, b.number(1.0), b.number(0.0))
    assert graph.convert(b.p, WHOLE) == graph.where(b.p, b.number(1.0, WHOLE), b.number(0.0, WHOLE))
    assert graph.convert(b.x, FLAG) == b("ne", b.x, b.number(0.0))
    assert graph.convert(b.k, FLAG) == b("ne", b.k, b.number(0.0, WHOLE))
    assert b.node(graph.convert(b.x, WHOLE)) == ("cast", (b("trunc", b.x),), WHOLE)
    assert b.node(graph.convert(b.k, REAL)) == ("cast", (b.k,), REAL)
    assert b.node(graph.convert(b.x, WIDE)) == ("cast", (b.x,), WIDE)
    assert b.node(graph.convert(b.w, REAL)) == ("cast", (b.w,), REAL)


def test_arrays_know_how_many_entries_they_have(b: Board) -> None:
    graph = b.graph
    pack = graph.add("pack", (b.x, b.y, b.x), REAL, 3)
    assert graph.size(pack) == 3
    assert graph.size(graph.add("map", (pack,), REAL, ("neg", (2, 3), None))) == 6
    assert graph.size(graph.add("dot", (pack, pack), REAL, (4, 3, None, None))) == 4
    for op in ("collect", "carrys", "results"):
        assert graph.size(graph.add(op, (), REAL, (0, 1, 7))) == 7
    assert graph.size(b.x) == graph.size(b("add", b.x, b.y)) == 1
    assert graph.value(b.x) is None
    assert graph.value(graph.parameter(0, REAL)) is None
    assert graph.op[b("add", graph.parameter(0, REAL), b.number(2.0))] == "add"
