"""A row program as an ONNX graph whose loops stay loops: what a policy with rollouts inside becomes.

The scalar program of one row, which `lanes` traces, is written node by node: every number is a column (B, 1),
an array (B, size), a constant (1, 1); rows are the first dimension, and any batch is the same graph. A loop
over periods is ONNX's Loop with a body of one period, so that the file does not grow with the horizon.
Unrolled tensor operations, as `torch.onnx` writes them, take minutes of tracing for a filter.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor, nn

from ..lanes.emit.schedule import Schedule
from ..lanes.trace.graph import FLAG, NARROW, ROW, STEP, WIDE
from ..lanes.trace.step import Traced
from ..lanes.tree import Tree
from .controllers import searches
from .data_sheet import Source, counted, traced_row
from .remembered_policy import RememberedPolicy

_OPSET, _IR = 18, 8
_BINARY = {"add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "pow": "Pow", "lt": "Less", "eq": "Equal"}
_BINARY |= {"le": "LessOrEqual", "and": "And", "or": "Or", "xor": "Xor"}
_UNARY = {"neg": "Neg", "abs": "Abs", "sqrt": "Sqrt", "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos"}
_UNARY |= {"tanh": "Tanh", "floor": "Floor", "ceil": "Ceil", "round": "Round", "not": "Not"}
_OF_LOOPS = ("loop", "result", "results", "collect", "carry", "carrys")


class OnnxWriter:
    """An ONNX graph that grows by programs of one row, and by what policies with tables do between them.

    ``first`` names the input, which has all rows; `source` is what a call costs for a row.
    """

    def __init__(self, real: Any, first: str) -> None:
        import onnx

        self.onnx, self.real = onnx, real
        self.constants: dict[Any, str] = {}
        self.initializers: list[Any] = []
        self.scopes: list[tuple[list[Any], dict[int, str]]] = [([], {})]  # statements, and names of nodes
        self.single: set[str] = set()  # values of one row, whatever the batch
        self.count = 0
        self.source = Source(0, 0, 0)
        self.rows = self._rows_of(first)

    def model(
        self,
        name: str,
        names: Sequence[str],
        found: Sequence[tuple[str, int | None]],
        size: int,
        batch: int | None,
    ) -> Any:
        """Return the model, under a name, of values (B, ...) and their entries, None for a number a row."""
        make, rows = self.onnx.helper, "batch" if batch is None else batch
        kind, ends = make.np_dtype_to_tensor_dtype(self.real), []
        for output, (value, entries) in zip(names[1:], found, strict=True):
            if entries is None:
                self._emit("Squeeze", value, self._ints(1), name=output)
            else:
                self._emit("Identity", value, name=output)
            shape = [rows] if entries is None else [rows, entries]
            ends.append(make.make_tensor_value_info(output, kind, shape))
        given = make.make_tensor_value_info(names[0], kind, [rows, size])
        whole = make.make_graph(self.scopes[0][0], name, [given], ends, initializer=self.initializers)
        opset = make.make_opsetid("", _OPSET)
        return make.make_model(whole, opset_imports=[opset], producer_name="staf_torch", ir_version=_IR)

    # Policies.

    def policy(self, module: nn.Module, x: Tensor, state: str) -> list[tuple[str, int | None]] | None:
        """Write a policy that has loops, as `in_loops` takes it, with the input x (1, n) of the name
        ``state``; None, and nothing written, for any other."""
        if isinstance(module, RememberedPolicy):
            return [(self._remembered(module, x, state), module.problem.inputs)]
        if searches(module):
            inner = module.plant_state(x)
            first = state if inner.shape == x.shape else self._take(state, range(inner.shape[-1]))
            wanted = self.policy(module.policy, inner, first)
            u = module.policy(inner)
            traced = traced_row(
                lambda c, _, row: (c, (module.restrained(row["x"], row["u"]),)), {"x": x, "u": u}
            )
            if wanted is None or traced is None:
                return None
            return self.program(traced, [state, wanted[0][0]])

        def step(carry: Tree, _: Tree, row: Tree) -> tuple[Tree, Tree]:
            out = module(row["state"])
            return carry, (out,) if isinstance(out, Tensor) else tuple(out)

        traced = traced_row(step, {"state": x})
        return None if traced is None or not traced.program[0].loops else self.program(traced, [state])

    def _remembered(self, module: RememberedPolicy, x: Tensor, state: str) -> str:
        """Write the search for the nearest plans, and a loop that follows each."""
        count, states = module.candidates + 1, len(module.first) - 1

        def seen(carry: Tree, _: Tree, row: Tree) -> tuple[Tree, Tree]:
            return carry, (module.seen(row["x"]),)

        place, follow = traced_row(seen, {"x": x}), traced_row(module.step(), module.row(x))
        assert place is not None
        assert follow is not None
        ((at, _),) = self.program(place, [state])
        apart = self._emit("Sub", self._unsqueezed(at, 1), self._table(module.searched))
        far = self._emit("ReduceSum", self._emit("Mul", apart, apart), self._ints(2), keepdims=0)
        places, near = self._ints(module.candidates), self._new("near")
        self.scopes[-1][0].append(
            self.onnx.helper.make_node("TopK", [far, places], [self._new("far"), near], largest=0)
        )
        resting = self._constant([[states]], np.int64)
        near = self._emit("Mod", near, resting)
        chosen = self._reshaped(self._emit("Concat", near, self._full(resting), axis=1), -1)
        first, last, end = (
            self._emit("Gather", self._table(part), chosen)
            for part in (module.first, module.last, module.end)
        )
        ahead = self._emit(
            "Add", self._unsqueezed(first, 1), self._constant([range(module.lookahead)], np.int64)
        )
        steps = self._emit("Min", ahead, self._unsqueezed(last, 1))
        width = module.lookahead * module.plans.shape[1]
        window = self._reshaped(self._emit("Gather", self._table(module.plans), steps), -1, width)
        size = self._ints(1, count, 1)
        spread = self._reshaped(self._emit("Expand", self._unsqueezed(state, 1), size), -1, x.shape[-1])
        ends = self._emit("Gather", self._table(module.models), end)
        rows, self.rows = self.rows, self._rows_of(spread)
        before = self.source
        m = module.problem.inputs
        (cost, _), (control, _) = self.program(follow, [spread, window, ends])
        one = Source(*(b - a for a, b in zip(before, self.source, strict=True)))
        self.rows = rows
        self.source = Source(*(a + b for a, b in zip(before, module.source(one), strict=True)))
        best = self._emit("ArgMin", self._reshaped(cost, -1, count), axis=1, keepdims=1)
        wide = self._emit("Expand", self._unsqueezed(best, 2), self._ints(1, 1, m))
        found = self._emit("GatherElements", self._reshaped(control, -1, count, m), wide, axis=1)
        return self._emit("Squeeze", found, self._ints(1))

    def program(self, traced: Traced, inputs: Sequence[str]) -> list[tuple[str, int | None]]:
        """Write a program of a row: the names of its outputs (B, size), and their entries."""
        graph, _, _, ends = traced.program
        self.graph, self.schedule, self.inputs = graph, Schedule(graph, [], ends), inputs
        self.results: dict[tuple[str, int, int], str] = {}  # of loops that are written
        self.part = self._new("part")
        self.scopes[0][1].clear()
        for node in (*self.schedule.block(ROW), *self.schedule.block(STEP)):
            self._statement(node)
        nodes, found = iter(ends), list[tuple[str, int | None]]()
        for shape, _ in traced.outputs:
            values = [self._ref(node) for node in itertools.islice(nodes, shape[0] if shape else 1)]
            parts = [self._full(self._cast(value, self.real)) for value in values]
            found.append((self._emit("Concat", *parts, axis=1), shape[0] if shape else None))
        self.source = Source(*(a + b for a, b in zip(self.source, counted(traced), strict=True)))
        return found

    def _rows_of(self, value: str) -> str:
        """Return the shape (B, 1)."""
        count = self._emit("Shape", value, end=1)
        return self._emit("Concat", count, self._ints(1), axis=0)

    def _table(self, values: Tensor) -> str:
        """Return a table, as it is."""
        name = self._constant(values.numpy(), values.numpy().dtype)
        self.single.discard(name)
        return name

    def _unsqueezed(self, value: str, axis: int) -> str:
        return self._emit("Unsqueeze", value, self._ints(axis))

    def _reshaped(self, value: str, *shape: int) -> str:
        return self._emit("Reshape", value, self._ints(*shape))

    def _ints(self, *values: int) -> str:
        return self._constant(values, np.int64)

    # Values.

    def _new(self, kind: str) -> str:
        self.count += 1
        return f"_{kind}_{self.count}"

    def _emit(self, op: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        """Add an operation; it has one row if all of its inputs have."""
        name = self._new(op) if name is None else name
        node = self.onnx.helper.make_node(op, list(inputs), [name], **attributes)
        self.scopes[-1][0].append(node)
        if inputs and all(each in self.single for each in inputs) and op != "Shape":
            self.single.add(name)
        return name

    def _constant(self, values: Any, dtype: Any) -> str:
        array = np.asarray(values, dtype=dtype)
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self.constants:
            name = self.constants[key] = self._new("c")
            self.initializers.append(self.onnx.numpy_helper.from_array(array, name))
            self.single.add(name)
        return self.constants[key]

    def _dtype(self, node: int) -> Any:
        kind = self.graph.type[node]
        known = {FLAG: np.dtype(bool), WIDE: np.dtype(np.float64), NARROW: np.dtype(np.float32)}
        return known.get(kind, self.real)

    def _cast(self, value: str, dtype: Any) -> str:
        return self._emit("Cast", value, to=self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def _full(self, value: str) -> str:
        """Return a value with all rows."""
        if value not in self.single:
            return value
        full = self._emit("Expand", value, self.rows)
        self.single.discard(full)
        return full

    def _ref(self, node: int) -> str:
        """Return the value of a number or an array, written where nobody has read it before."""
        known = next((names[node] for _, names in reversed(self.scopes) if node in names), None)
        if known is None:
            known = self.scopes[-1][1][node] = self._value(node)
        return known

    def _value(self, node: int) -> str:
        graph, op, aux = self.graph, self.graph.op[node], self.graph.aux[node]
        if op == "const":
            return self._constant([[graph.value(node)]], self._dtype(node))
        if op == "row":
            return self._take(self.inputs[aux[0]], [aux[1]])
        if op == "elem":
            return self._take(self._ref(graph.args[node][0]), [aux])
        if op == "pack":
            return self._packed(graph.args[node])
        if op == "load":
            number, at, stride = aux
            turned = self._emit("Mul", f"_i{self.part}_{number}", self._ints(stride))
            array = self._ref(graph.args[node][0])
            found = self._emit("Gather", array, self._emit("Add", turned, self._ints(at)), axis=1)
            return self._marked(found, array in self.single)
        if op in ("map", "dot"):
            return self._map(node) if op == "map" else self._dot(node)
        if op in ("result", "results", "collect"):
            return self.results[op.removesuffix("s"), aux[0], aux[1]]
        return self._operation(op, [self._ref(a) for a in graph.args[node]], node)

    def _marked(self, name: str, single: bool) -> str:
        (self.single.add if single else self.single.discard)(name)
        return name

    def _take(self, array: str, places: Sequence[int]) -> str:
        return self._emit("Gather", array, self._ints(*places), axis=1)

    def _packed(self, nodes: Sequence[int]) -> str:
        graph = self.graph
        if all(graph.op[node] == "const" for node in nodes):
            return self._constant([[graph.value(node) for node in nodes]], self._dtype(nodes[0]))
        values = [self._ref(node) for node in nodes]
        if not all(value in self.single for value in values):
            values = [self._full(value) for value in values]
        return self._emit("Concat", *values, axis=1)

    def _map(self, node: int) -> str:
        op, shape, *places = self.graph.aux[node]
        values = []
        for operand, place in zip(self.graph.args[node], places, strict=True):
            value = self._ref(operand)
            values.append(value if place is None else self._take(value, place))
        if op == "copy":
            return self._emit("Identity", *values)
        found = self._operation(op, values, node)
        if all(place is None for place in places):
            size = self._ints(1, int(np.prod(shape)))
            return self._marked(self._emit("Expand", found, size), found in self.single)
        return found

    def _dot(self, node: int) -> str:
        outs, count, *places = self.graph.aux[node]
        values = []
        for operand, place in zip(self.graph.args[node], places, strict=True):
            value = self._ref(operand)
            values.append(
                self._unsqueezed(value, 2)
                if place is None
                else self._reshaped(self._take(value, place), -1, outs, count)
            )
        product = self._emit("Mul", *values)
        return self._emit("ReduceSum", product, self._ints(2), keepdims=0)

    # Operations.

    def _operation(self, op: str, values: Sequence[str], node: int) -> str:
        if op in _BINARY or op in _UNARY:
            return self._emit(_BINARY.get(op) or _UNARY[op], *values)
        if op == "where" and self.graph.type[node] == FLAG:  # of flags onnxruntime has no choice
            chosen, a, b = values
            other = self._emit("And", self._emit("Not", chosen), b)
            return self._emit("Or", self._emit("And", chosen, a), other)
        if op == "where":
            return self._where(*values)
        if op == "ne":
            return self._emit("Not", self._emit("Equal", *values))
        if op == "cast":
            return self._cast(values[0], self._dtype(node))
        if op in ("min", "max"):  # NaN wins
            a, b = values
            first = self._emit("Less", *((a, b) if op == "min" else (b, a)))
            return self._where(self._emit("Or", first, self._emit("IsNaN", a)), a, b)
        written: Callable[..., str] = getattr(self, f"_{op}")
        return written(*values, self._dtype(node))

    def _where(self, chosen: str, a: str, b: str) -> str:
        return self._emit("Where", chosen, a, b)

    def _tan(self, x: str, dtype: Any) -> str:
        return self._emit("Div", self._emit("Sin", x), self._emit("Cos", x))

    def _trunc(self, x: str, dtype: Any) -> str:
        below = self._emit("Less", x, self._constant([[0]], dtype))
        return self._where(below, self._emit("Ceil", x), self._emit("Floor", x))

    def _expm1(self, x: str, dtype: Any) -> str:
        """Kahan's (e^x - 1) x / log(e^x), which keeps the digits of a small x."""
        one, power = self._constant([[1]], dtype), self._emit("Exp", x)
        less = self._emit("Sub", power, one)
        exact = self._emit("Div", self._emit("Mul", less, x), self._emit("Log", power))
        ends = self._emit("Or", *[self._emit("IsInf", each) for each in (self._emit("Log", power), power)])
        return self._where(self._emit("Equal", power, one), x, self._where(ends, less, exact))

    def _log1p(self, x: str, dtype: Any) -> str:
        """Kahan's log(1 + x) x / ((1 + x) - 1)."""
        one = self._constant([[1]], dtype)
        more = self._emit("Add", x, one)
        log = self._emit("Log", more)
        exact = self._emit("Div", self._emit("Mul", log, x), self._emit("Sub", more, one))
        ends = self._emit("IsInf", log)
        return self._where(self._emit("Equal", more, one), x, self._where(ends, log, exact))

    def _atan2(self, y: str, x: str, dtype: Any) -> str:
        """The angle by Atan in float32, all that onnxruntime has, and what a rotation by it leaves."""
        single = np.float32
        zero = self._constant([[0]], dtype)
        steep = self._emit("Less", self._emit("Abs", x), self._emit("Abs", y))
        none = self._emit("And", self._emit("Equal", x, zero), self._emit("Equal", y, zero))
        low = self._where(none, self._constant([[1]], dtype), self._where(steep, y, x))
        ratio = self._emit("Div", self._where(steep, x, y), low)
        rough = self._cast(self._emit("Atan", self._cast(ratio, single)), dtype)
        half = self._constant([[np.pi / 2]], dtype)
        turned = self._where(self._negative(y, dtype), self._emit("Neg", half), half)
        flat = self._where(self._negative(x, dtype), self._emit("Add", turned, turned), zero)
        angle = self._where(steep, self._emit("Sub", turned, rough), self._emit("Add", flat, rough))
        sin, cos = self._emit("Sin", angle), self._emit("Cos", angle)
        across = self._emit("Sub", self._emit("Mul", y, cos), self._emit("Mul", x, sin))
        along = self._emit("Add", self._emit("Mul", x, cos), self._emit("Mul", y, sin))
        left = self._emit("Div", across, self._where(none, self._constant([[1]], dtype), along))
        far = self._emit("IsInf", self._emit("Add", self._emit("Abs", x), self._emit("Abs", y)))
        return self._where(far, angle, self._emit("Add", angle, left))

    def _negative(self, x: str, dtype: Any) -> str:
        """Return whether a number is below 0, or -0."""
        zero = self._constant([[0]], dtype)
        inverse = self._emit("Div", self._constant([[1]], dtype), x)
        return self._emit("Or", self._emit("Less", x, zero), self._emit("Less", inverse, zero))

    # Loops.

    def _statement(self, node: int) -> None:
        if self.graph.op[node] == "loop":
            self._loop(self.graph.aux[node])
        elif self.graph.op[node] not in _OF_LOOPS:
            self._ref(node)

    def _loop(self, number: int) -> None:
        """Write the Loop: carried values have all rows, and what a pass leaves behind is stacked."""
        make, loop = self.onnx.helper, self.graph.loops[number]
        live, kept = sorted(self.schedule.carries.get(number, ())), sorted(self.schedule.collected(number))
        initial = [self._full(self._ref(loop.initial[k])) for k in live]
        names = [f"_l{self.part}_{number}_{k}" for k in live]
        self.scopes.append(([], {loop.carry[k]: name for k, name in zip(live, names, strict=True)}))
        for node in self.schedule.body(number):
            self._statement(node)
        going = self._going(loop.going)
        after = [self._emit("Identity", self._full(self._ref(loop.following[k]))) for k in live]
        put = [self._emit("Identity", self._full(self._packed(loop.collected[k]))) for k in kept]
        statements, _ = self.scopes.pop()
        flag, index = self.onnx.TensorProto.BOOL, self.onnx.TensorProto.INT64
        begins = [make.make_tensor_value_info(f"_i{self.part}_{number}", index, [])]
        begins.append(make.make_tensor_value_info(f"_g{self.part}_{number}", flag, []))
        begins += [self._info(name, loop.carry[k]) for name, k in zip(names, live, strict=True)]
        ends = [make.make_tensor_value_info(going, flag, [])]
        ends += [self._info(name, loop.carry[k]) for name, k in zip(after, live, strict=True)]
        ends += [
            self._info(name, loop.collected[k][0], len(loop.collected[k]))
            for name, k in zip(put, kept, strict=True)
        ]
        body = make.make_graph(statements, f"loop{self.part}_{number}", begins, ends)
        results = [f"_r{self.part}_{number}_{k}" for k in live]
        stacked = [f"_y{self.part}_{number}_{k}" for k in kept]
        given = [self._constant(loop.count, np.int64), self._constant(True, bool), *initial]
        self.scopes[-1][0].append(make.make_node("Loop", given, [*results, *stacked], body=body))
        self.results |= {("result", number, k): name for k, name in zip(live, results, strict=True)}
        for k, name in zip(kept, stacked, strict=True):
            flat = self._emit("Transpose", name, perm=[1, 0, 2])
            shape = self._ints(-1, loop.count * len(loop.collected[k]))
            self.results["collect", number, k] = self._emit("Reshape", flat, shape)

    def _going(self, node: int) -> str:
        """Return whether any row took this pass: none takes another one then."""
        if node < 0:
            return self._emit("Identity", self._constant(True, bool))
        taken = self._cast(self._ref(node), np.int32)
        return self._cast(self._emit("ReduceMax", taken, keepdims=0), bool)

    def _info(self, name: str, node: int, size: int | None = None) -> Any:
        make, kind = self.onnx.helper, self._dtype(node)
        shape = [None, self.graph.size(node) if size is None else size]
        return make.make_tensor_value_info(name, make.np_dtype_to_tensor_dtype(kind), shape)
