"""Loops that a compiled program keeps as loops; everywhere else they are plain Python.

While a step is traced, the body of a loop runs once: its carry is new nodes, what it reads from outside stays
where it is, and the nodes after the pass say what the next one begins with. The loop then stands as far
outside as what it reads allows. Writing all passes out, as tracers do that do not see Python's loops, gives
g++ a text that grows with the passes, and the processor one that fits no cache.
"""

from __future__ import annotations

import functools
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from ..tree import Tree, flatten, mapped, unflatten
from .graph import FLAG, STEP, Ids, Loop
from .tracer import LARGE, NotLoweredError, Tracer

Some = TypeVar("Some")
_active = threading.local()
_FEW = 2  # passes of a loop that is only tried: one feeds the other


def repeat(
    count: int, body: Callable[[Tree], Tree], carry: Tree, *, where: Callable[[Tree], Tensor] | None = None
) -> Tree:
    """body(...body(body(carry))), ``count`` times, or as often as a row asks for.

    Example:
        >>> repeat(3, lambda x: 2 * x, torch.ones(1))
        tensor([8.])
        >>> repeat(9, lambda x: 2 * x, torch.tensor([1.0, 3.0, 70.0]), where=lambda x: x < 50)
        tensor([64., 96., 70.])

        Shown by `staf experiment=adp adp/policy=rollout`.

    Args:
        count: of passes, at least 0.
        body: maps the carry to the next one of the same shapes and dtypes.
        carry: a tree of tensors; with ``where`` of tensors (B, ...).
        where: of a carry, (B,) bool: the rows that take the next pass. The others keep what they have, and
            once no row goes on, no pass is computed. What ``body`` reads from outside of the carry is found
            before the first pass, whoever takes it.
    """
    if (count > 1 or (where is not None and count)) and (tracer := tracer_of(carry)) is not None:
        return _loop(tracer, count, lambda now, _: (body(now), ()), carry, (), 1, where)[0]
    for _ in range(_passes(count, carry)):
        if where is None:
            carry = body(carry)
            continue
        going = where(carry)
        unseen = going.is_meta or tracing_now() or torch._C._functorch.peek_interpreter_stack()
        if not unseen and not bool(going.any()):
            break
        carry = _chosen(going, body(carry), carry)
    return carry


@contextmanager
def few_passes(asked: bool = True) -> Iterator[None]:
    """Plain torch's loops end, if asked, after a few passes; a scan repeats the outputs of the last."""
    before = getattr(_active, "few", False)
    _active.few = before or asked
    try:
        yield
    finally:
        _active.few = before


def _passes(count: int, given: Tree) -> int:
    formal = any(leaf.is_meta for leaf in flatten(given)[0])  # where one pass has the shapes of all
    return min(count, 1 if formal else _FEW if getattr(_active, "few", False) else count)


def _chosen(going: Tensor, after: Tree, before: Tree) -> Tree:
    """``after`` in the rows that go on, ``before`` in the others."""

    def chosen(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(going.reshape(going.shape + (1,) * (new.dim() - going.dim())), new, old)

    return mapped(chosen, after, before)


def repeat_counted(most: int, count: Tensor, body: Callable[[Tree], Tree], start: Tree) -> Tree:
    """Apply body to start as often as a row's own ``count``, (), says, at most ``most`` times.

    Args:
        most: passes.
        count: of a row, floating-point.
        body: of a tree of tensors (B, ...) to one.
        start: of which the first tensor has the rows.
    """
    first = flatten(start)[0][0]
    none = torch.zeros_like(first.reshape(len(first), -1)[:, 0])

    def counted(now: tuple[Tree, Tensor]) -> tuple[Tree, Tensor]:
        return body(now[0]), now[1] + 1

    found: Tree = repeat(most, counted, (start, none), where=lambda now: now[1] < count)[0]
    return found


def where_rows(where: Tensor, body: Callable[[Tree], Some], given: Tree, otherwise: Some) -> Some:
    """body(given) in the rows where ``where`` holds, ``otherwise`` in the others.

    Plain torch calls ``body`` with these rows alone, and not at all where there are none; so does a compiled
    program with a vector of rows.

    Example:
        >>> where_rows(torch.tensor([True, False]), torch.exp, torch.zeros(2), torch.full((2,), 7.0))
        tensor([1., 7.])

        Shown by `staf_torch/lanes/README.md`.

    Args:
        where: (B,) bool.
        body: of which no row sees another.
        given: a tree of tensors (B, ...): all that ``body`` reads of a row.
        otherwise: a tree of tensors (B, ...), as ``body`` returns it.
    """
    if tracer_of((given, otherwise)) is not None:
        start = otherwise, given
        chosen: Some = repeat(1, lambda now: (body(now[1]), now[1]), start, where=lambda _: where)[0]
        return chosen
    if where.is_meta or tracing_now() or torch._C._functorch.peek_interpreter_stack():
        every: Some = _chosen(where, body(given), otherwise)
        return every
    rows = where.nonzero().squeeze(1)
    if not len(rows):
        return otherwise
    found = body(mapped(lambda leaf: leaf[rows], given))
    some: Some = mapped(lambda old, new: old.index_copy(0, rows, new), otherwise, found)
    return some


def scan(
    body: Callable[[Tree, Tree], tuple[Tree, Tree]],
    carry: Tree,
    inputs: Tree,
    *,
    dim: int = 1,
    unrolled: bool = False,
) -> tuple[Tree, Tree]:
    """carry, out_k = body(carry, input_k) for k = 0, 1, ...; the last carry and all outputs.

    Example:
        >>> total, partial = scan(lambda s, x: (s + x, s + x), torch.zeros(1), torch.arange(1.0, 4.0)[None])
        >>> total, partial
        (tensor([6.]), tensor([[1., 3., 6.]]))

        Shown by `staf experiment=adp`.

    Args:
        body: maps a carry and the inputs of one k to the next carry and the outputs of this k.
        carry: a tree of tensors.
        inputs: a tree of tensors; entry k along ``dim`` is the input of pass k.
        dim: of inputs and outputs, counted from the front: 1 where the rows come first.
        unrolled: whether a compiled program writes the passes one after the other: faster where they are few
            and small, of longer text.

    Returns:
        The carry after the last pass, and the outputs stacked along ``dim``.
    """
    leaves, structure = flatten(inputs)
    count = leaves[0].shape[dim]
    tracer = None if unrolled or count < 2 else tracer_of((carry, inputs))
    if tracer is not None:
        first = mapped(lambda leaf: leaf.select(dim, 0), inputs)
        if not _fixed(tracer, (carry, inputs), lambda: body(carry, first)):
            return _loop(tracer, count, body, carry, inputs, dim)
    outputs, shape = [], None
    every = zip(*[leaf.unbind(dim) for leaf in leaves], strict=True)
    for at in itertools.islice(every, _passes(count, (carry, inputs))):
        carry, out = body(carry, unflatten(structure, iter(at)))
        parts, shape = flatten(out)
        outputs.append(parts)
    outputs += outputs[-1:] * (count - len(outputs))
    stacked = [torch.stack(column, dim=dim) for column in zip(*outputs, strict=True)]
    return carry, unflatten(shape, iter(stacked))


def reduce(
    body: Callable[[Tree], Tensor],
    points: Tree,
    operation: Literal["sum", "max", "min"] = "sum",
    *,
    dim: int = 1,
) -> Tensor:
    """The sum, the maximum or the minimum over points of what ``body`` computes at each.

    Plain torch calls ``body`` once with all points; a compiled program has them one after the other and
    keeps none of the values.

    Example:
        >>> reduce(lambda x: x.square(), torch.arange(3.0)[None], "sum")
        tensor([5.])

        Shown by `staf experiment=adp`.

    Args:
        body: a tree of tensors (..., P, ...) to (..., P, ...), P in the place ``dim``; no point sees another.
        points: such a tree.
        operation: over the points.
        dim: of the points, counted from the front.
    """
    count = flatten(points)[0][0].shape[dim]
    if count > 1 and (tracer := tracer_of(points)) is not None:
        first = _reduced(body(mapped(lambda leaf: leaf.narrow(dim, 0, 1), points)), operation, dim)

        def step(carry: Tensor, now: Tree) -> tuple[Tensor, tuple[()]]:
            one = _reduced(body(mapped(lambda leaf: leaf.unsqueeze(dim), now)), operation, dim)
            return _COMBINE[operation](carry, one), ()

        if count > 2:
            rest = mapped(lambda leaf: leaf.narrow(dim, 1, count - 1), points)
            total: Tensor = _loop(tracer, count - 1, step, first, rest, dim)[0]
            return total
        return step(first, mapped(lambda leaf: leaf.select(dim, 1), points))[0]
    return _reduced(body(points), operation, dim)


def each(body: Callable[[Tensor], Tensor], points: Tensor, *, dim: int = 1, together: int = 4) -> Tensor:
    """Apply ``body`` at every point: (..., P, ...) to (..., P, ...), P in the place ``dim``.

    Plain torch calls ``body`` once with all points; a compiled program goes through them, some at a time, so
    that its text is short.

    Example:
        >>> each(lambda x: x.square(), torch.arange(3.0)[None])
        tensor([[0., 1., 4.]])

        Shown by `staf experiment=adp adp/policy=rollout`.

    Args:
        body: of which no point sees another.
        points: a tensor.
        dim: of the points, counted from the front.
        together: points at a time.
    """
    count = points.shape[dim]
    if count <= together or (tracer := tracer_of(points)) is None:
        return body(points)
    passes = -(-count // together)
    more = passes * together - count
    spare = points.narrow(dim, 0, 1).expand(*points.shape[:dim], more, *points.shape[dim + 1 :])
    grouped = torch.cat((points, spare), dim=dim).unflatten(dim, (passes, together))
    done: Tensor = _loop(tracer, passes, lambda _, now: ((), body(now)), (), grouped, dim)[1]
    return done.flatten(dim, dim + 1).narrow(dim, 0, count)


_COMBINE: dict[str, Callable[..., Tensor]] = {"sum": torch.add, "max": torch.maximum, "min": torch.minimum}


def _reduced(values: Tensor, operation: str, dim: int) -> Tensor:
    return values.sum(dim) if operation == "sum" else getattr(values, f"a{operation}")(dim)


@contextmanager
def tracing(tracer: Tracer) -> Iterator[None]:
    """The combinators of this thread write loops of ``tracer``."""
    _active.tracer = tracer
    try:
        yield
    finally:
        _active.tracer = None


@contextmanager
def untraced() -> Iterator[None]:
    """Compute with numbers of no row while a step is traced: nothing of it comes into the program."""
    before, _active.tracer = getattr(_active, "tracer", None), None
    try:
        with _disable_current_modes():
            yield
    finally:
        _active.tracer = before


def tracing_now() -> bool:
    """Return whether somebody traces on this thread, here or in torch."""
    return (
        getattr(_active, "tracer", None) is not None
        or torch._C._len_torch_dispatch_stack() > 0
        or torch.compiler.is_compiling()
    )


def traced_as(spelling: Callable[..., Some]) -> Callable[[Callable[..., Some]], Callable[..., Some]]:
    """Decorator: in a program that is traced a function is spelt otherwise, as what is fast there is another.

    Example:
        >>> def in_turn(points): return scan(lambda s, x: (s + x, ()), torch.zeros(1), points)[0]
        >>> total = traced_as(in_turn)(lambda points: points.sum(1))
        >>> total(torch.ones(1, 3))
        tensor([3.])

        Shown by `staf_torch/lanes/README.md`.

    Args:
        spelling: a function of the same arguments and, up to rounding, results.
    """

    def decorated(plain: Callable[..., Some]) -> Callable[..., Some]:
        @functools.wraps(plain)
        def either(*args: Any, **kwargs: Any) -> Some:
            return (spelling if tracing_now() else plain)(*args, **kwargs)

        return either

    return decorated


def tracer_of(tree: Tree) -> Tracer | None:
    """Who traces the program now; None where nobody does, or a derivative is taken through the loop."""
    tracer: Tracer | None = getattr(_active, "tracer", None)
    if tracer is None or torch._C._functorch.peek_interpreter_stack() is not None:
        return None
    return None if any(leaf.requires_grad for leaf in flatten(tree)[0]) else tracer


def _fixed(tracer: Tracer, given: Tree, first: Callable[[], Tree]) -> bool:
    """Return whether no row has numbers of its own in the inputs of a first pass, and it makes none."""
    if any(tracer.traced(leaf) for leaf in flatten(given)[0]):
        return False
    return not any(tracer.traced(leaf) for leaf in flatten(first())[0])


def _loop(
    tracer: Tracer,
    count: int,
    body: Callable[[Tree, Tree], tuple[Tree, Tree]],
    carry: Tree,
    inputs: Tree,
    dim: int,
    where: Callable[[Tree], Tensor] | None = None,
) -> tuple[Tree, Tree]:
    """Trace one pass and write the loop: the trees that come out of it."""
    graph = tracer.graph
    tracer.inside += 1
    loop = Loop(count, depth=STEP + tracer.inside)
    number = len(graph.loops)
    graph.loops.append(loop)
    given, structure = flatten(carry)
    fed, feed = flatten(inputs)
    now = [_fed(tracer, leaf, dim, number, loop) for leaf in fed]
    inner = []
    for leaf in given:
        large = leaf.numel() > LARGE
        entries = _whole(tracer, leaf) if large else tracer.nodes(leaf).reshape(-1).tolist()
        start = len(loop.initial)
        loop.initial += entries
        new = _numbers(tracer, "carry", (), (number, start), leaf, loop.depth)
        loop.carry += [graph.args[new[0]][0]] if large else new
        inner.append(tracer.attach(leaf.detach().clone(), np.array(new, dtype=np.int64).reshape(leaf.shape)))
    before = unflatten(structure, iter(inner))
    going = None if where is None else where(before)
    if going is not None:
        loop.going = int(tracer.nodes(going, FLAG).item())
    after, outputs = body(before, unflatten(feed, iter(now)))
    if going is not None:
        after = _chosen(going, after, before)
    tracer.inside -= 1
    ends, end_structure = flatten(after)
    forms, given_forms = ([(leaf.shape, leaf.dtype) for leaf in leaves] for leaves in (ends, given))
    if forms != given_forms or end_structure != structure:
        raise NotLoweredError(
            "the body of a loop returns a carry of other shapes or dtypes than it was given"
        )
    for end in ends:
        large = end.numel() > LARGE
        loop.following += _whole(tracer, end) if large else tracer.nodes(end).reshape(-1).tolist()
    out_leaves, out_structure = flatten(outputs)
    loop.collected = [tracer.nodes(leaf).reshape(-1).tolist() for leaf in out_leaves]
    graph.close(number)
    results, done = [], 0
    for leaf in given:
        nodes = _numbers(tracer, "result", (loop.node,), (number, done), leaf, None)
        if leaf.numel() <= LARGE:  # what a pass finds without the carry of another, all passes find alike
            ends = loop.following[done : done + len(nodes)]
            nodes = [e if graph.depth[e] < loop.depth else n for e, n in zip(ends, nodes, strict=True)]
        done += 1 if leaf.numel() > LARGE else leaf.numel()
        ids = np.array(nodes, dtype=np.int64).reshape(leaf.shape)
        results.append(tracer.attach(leaf.detach().clone(), ids))
    stacked = [_collected(tracer, leaf, dim, loop, number, k) for k, leaf in enumerate(out_leaves)]
    return unflatten(structure, iter(results)), unflatten(out_structure, iter(stacked))


def _numbers(
    tracer: Tracer, op: str, args: tuple[int, ...], first: tuple[int, int], leaf: Tensor, depth: int | None
) -> list[int]:
    """New nodes of what passes through a loop: one a number, or the entries of one array of many."""
    graph, kind, size, (number, start) = tracer.graph, tracer.kind(leaf.dtype), leaf.numel(), first
    if size > LARGE:
        array = graph.add(f"{op}s", args, kind, (number, start, size), depth)
        entries: list[int] = tracer.entries(array, kind, size).tolist()
        return entries
    return [graph.add(op, args, kind, (number, start + k), depth) for k in range(size)]


def _whole(tracer: Tracer, leaf: Tensor) -> list[int]:
    """An array that holds the entries of a tensor in their order, and nothing else."""
    flat, kind = tracer.nodes(leaf).reshape(-1), tracer.kind(leaf.dtype)
    array, places = tracer.array(flat, kind)
    graph = tracer.graph
    fits = graph.op[array] not in ("carrys", "results") and places.tolist() == list(range(len(flat)))
    if fits and len(flat) == graph.size(array):
        return [array]
    chosen = tuple(places.tolist())
    return [graph.add("map", (array,), kind, ("copy", (len(flat),), chosen))]


def _fed(tracer: Tracer, leaf: Tensor, dim: int, number: int, loop: Loop) -> Tensor:
    """The input of one pass: entries of an array, at a place that the pass says."""
    graph = tracer.graph
    nodes = np.moveaxis(tracer.nodes(leaf), dim, 0)
    kind, size = tracer.kind(leaf.dtype), nodes[0].size
    array, places = tracer.array(nodes.reshape(-1), kind)
    table = places.reshape(loop.count, size)
    steps = np.diff(table, axis=0)
    if steps.size and not (steps == steps[0, 0]).all():
        array, table = tracer.pack(nodes.reshape(-1), kind), np.arange(nodes.size).reshape(loop.count, size)
    stride = int(table[1, 0] - table[0, 0])
    new = [graph.add("load", (array,), kind, (number, int(at), stride), loop.depth) for at in table[0]]
    like = leaf.detach().select(dim, 0).clone(memory_format=torch.contiguous_format)
    return tracer.attach(like, np.array(new, dtype=np.int64).reshape(like.shape))


def _collected(tracer: Tracer, leaf: Tensor, dim: int, loop: Loop, number: int, k: int) -> Tensor:
    """The outputs of all passes as one tensor."""
    graph, kind = tracer.graph, tracer.kind(leaf.dtype)
    array = graph.add("collect", (loop.node,), kind, (number, k, loop.count * leaf.numel()))
    nodes: Ids = tracer.entries(array, kind, loop.count * leaf.numel()).reshape(loop.count, *leaf.shape)
    whole = torch.stack([leaf.detach()] * loop.count, dim=dim)
    return tracer.attach(whole.contiguous(), np.moveaxis(nodes, 0, dim))
