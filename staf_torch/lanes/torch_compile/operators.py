"""Calls that compile themselves as one operator in the graph of somebody's `torch.compile`.

While it reads a function, `torch.compile` follows `in_graph` in the place of such a call. Tensors among the
arguments, and those that the other arguments hold or lead to, become inputs of the operator, so that
gradients reach them; the other arguments are guarded by identity and by content. When the graph runs, the
operator makes the call as anybody would. What autograd has recorded then belongs to the memory of a token,
one more result: the backward pass, a second operator, finds it as long as the graph keeps the token.

`graph_plans` is what runs while `torch.compile` reads.

Calls that compile themselves, or run in C++, under `torch.compile`: it leaves them alone.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import itertools
import logging
import weakref
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar, cast

import torch
import torch._C._dynamo.eval_frame as frames
from torch import Tensor

from ..tree import Shared

if TYPE_CHECKING:
    from ..dependencies.contents import Contents


KNOWN = type("Known", (), {})()
"""By the name of a call the tensors that its arguments lead to, and of its result what is no tensor.

Attributes, as `torch.compile` looks into a dictionary once a graph."""
CALLS: weakref.WeakValueDictionary[str, GraphCall] = weakref.WeakValueDictionary()
FUNCTIONS: dict[str, Callable[..., Any]] = {}
NAMED: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
"""Arguments for which graphs have names."""
_tickets: weakref.WeakValueDictionary[int, _Ticket] = weakref.WeakValueDictionary()
_log = logging.getLogger(__name__)
_count = itertools.count()
_CONTAINERS = tuple, list  # torch 2.6 reads no union of types


def spelled(function: Callable[..., Any]) -> Any:
    """Return the function that `torch.compile` reads in the place of another; closures it would not find."""
    name = f"{function.__module__}.{function.__qualname__}"
    FUNCTIONS[name] = function
    code = _spelling.__code__
    constants = tuple(name if constant == "its name" else constant for constant in code.co_consts)
    again: Any = FunctionType(code.replace(co_consts=constants), globals(), function.__name__)
    again.spells = function
    return again


def _spelling(*args: Any, **kwargs: Any) -> Any:
    return in_graph("its name", args, kwargs)


def in_graph(name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a function by the operator: `torch.compile` reads it, and nobody calls it."""
    tensors: list[Tensor] = []
    objects: list[Any] = []
    call, reason = plan(name, taken((args, kwargs), tensors, objects))
    if reason:
        torch._dynamo.graph_break(reason)
    captured, structure, constants = getattr(KNOWN, call)
    results = torch.ops.staf_torch.call(call, tensors, captured)
    return given_back(structure, iter(results), iter(constants))


def plan(name: str, structure: Any) -> tuple[str, str]:
    """Return the name of a call, or why the graph must break."""
    try:
        define()
        # It imports torch's compiler, and what leads here.
        called: str = importlib.import_module(f"{__package__}.graph_plans").planned(name, structure)
    except Exception as error:  # of a version of torch, or of the call, which says so where it is made
        reason = f"{type(error).__name__}: {error}"
    else:
        return called, ""
    _log.info("%s is no operator in a graph of torch.compile: %s", name, reason)
    return "", f"{name} is no operator here: {reason}"


plan._dynamo_marked_constant = True  # type: ignore[attr-defined]  # what `assume_constant_result` does


def taken(tree: Any, tensors: list[Tensor], objects: list[Any], *, results: bool = False) -> Any:
    """Return the structure of nested containers, of which tensors and objects are put into lists; of
    results dataclasses are containers, too."""
    if isinstance(tree, Tensor):
        tensors.append(tree)
        return "tensor"
    if isinstance(tree, Shared):
        tensors.append(tree.tensor)
        return "shared"
    if isinstance(tree, _CONTAINERS):
        return type(tree), tuple([taken(part, tensors, objects, results=results) for part in tree])
    if isinstance(tree, dict):
        return tuple(tree), tuple([taken(part, tensors, objects, results=results) for part in tree.values()])
    if results and dataclasses.is_dataclass(tree):
        parts = [getattr(tree, field.name) for field in dataclasses.fields(tree)]
        return type(tree), tuple([taken(part, tensors, objects, results=True) for part in parts])
    objects.append(tree)
    return "object"


def given_back(structure: Any, tensors: Iterator[Tensor], objects: Iterator[Any]) -> Any:
    """Return the tree of a structure of `taken`."""
    if structure == "object":
        return next(objects)
    if structure == "tensor":
        return next(tensors)
    if structure == "shared":
        return Shared(next(tensors))
    kind, parts = structure
    values = [given_back(part, tensors, objects) for part in parts]
    if isinstance(kind, tuple):
        return dict(zip(kind, values, strict=True))
    return kind(values) if kind is tuple or kind is list else kind(*values)


class TensorForm(NamedTuple):
    """A tensor without its numbers."""

    shape: tuple[int, ...]
    stride: tuple[int, ...]
    dtype: torch.dtype
    device: torch.device
    wanted: bool  # whether a gradient by it is

    @classmethod
    def of(cls, x: Tensor, *, recorded: bool = True) -> TensorForm:
        sizes = tuple(map(int, x.shape)), tuple(map(int, x.stride()))  # of symbols what they are now
        return cls(*sizes, x.dtype, x.device, recorded and x.requires_grad)

    def empty(self) -> Tensor:
        return torch.empty_strided(self.shape, self.stride, dtype=self.dtype, device=self.device)

    def dense(self) -> TensorForm:
        return self._replace(stride=torch.empty(self.shape, dtype=self.dtype, device="meta").stride())

    def example(self) -> Tensor:
        """Return a tensor of numbers between 0 and 1, of zeros where they are integers."""
        count, real = torch.Size(self.shape).numel(), self.dtype.is_floating_point
        numbers = torch.linspace(0.1, 0.9 if real else 0.1, count, dtype=torch.float64, device="cpu")
        return self.empty().copy_(numbers.view(self.shape)).requires_grad_(self.wanted)


class GraphCall:
    """A function with all of its arguments but tensors."""

    def __init__(
        self,
        name: str,
        structure: Any,
        objects: Sequence[Any],
        forms: Sequence[TensorForm],
        contents: Contents,
        surroundings: Surroundings,
    ) -> None:
        self._function, self._structure, self._objects = FUNCTIONS[name], structure, objects
        self.of = name
        self._contents, self._captured = contents, [*contents.tensors, *contents.others]
        self.inputs = [*forms, *(TensorForm.of(x, recorded=surroundings.recorded) for x in self._captured)]
        self.wanted = any(form.wanted for form in self.inputs)
        self._learned = [x.requires_grad for x in self._captured]
        self._surroundings = surroundings
        with self._surroundings.again():
            found = self.called([form.example() for form in forms])
        self.results, self._made = [TensorForm.of(x) for x in found[0]], found[1:]
        self._kinds = [*map(_kind, found[0])]
        digest = hashlib.blake2b(repr(self.results).encode(), digest_size=8).hexdigest()
        self.name = f"call_{next(_count)}_{digest}"  # of other results another graph, also in a cache
        CALLS[self.name] = self
        setattr(KNOWN, self.name, (self._captured, *self._made))
        weakref.finalize(self, vars(KNOWN).pop, self.name, None)

    def fresh(self) -> bool:
        """Return whether its objects hold and lead to what they did, but for numbers of these tensors."""
        if [x.requires_grad for x in self._captured] != self._learned:
            return False
        return self._contents.unchanged(library=False) or self._contents.renewed()

    def called(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], Any, tuple[Any, ...]]:
        """Return the tensors of the function's result, its structure and what else is in it."""
        args, kwargs = given_back(self._structure, iter(tensors), iter(self._objects))
        results: list[Tensor] = []
        objects: list[Any] = []
        structure = taken(self._function(*args, **kwargs), results, objects, results=True)
        return results, structure, tuple(objects)

    def run(self, tensors: Sequence[Tensor], captured: Sequence[Tensor]) -> list[Tensor]:
        """Return the results, in memory of their own, and the token where a gradient is wanted."""
        if not all(map(_same, self._captured, captured)):
            raise RuntimeError(
                f"{self.of} reads a tensor that has been changed within the graph of `torch.compile`: change "
                "it outside, or call that outside."
            )
        # What is kept for the backward pass is copied: the graph uses the memory of its tensors again.
        given = [x.detach().clone() if self.wanted else x.detach() for x in tensors]
        for x, form in zip(given, self.inputs, strict=False):
            x.requires_grad_(form.wanted)
        with self._surroundings.again():
            results, *made = self.called(given)
        if [_kind(x) for x in results] != self._kinds or tuple(made) != self._made:
            raise RuntimeError(f"{self.of} returned another kind of result than when it was compiled.")
        ends = _apart(results, self.results, (*tensors, *captured))
        if not self.wanted:
            return ends
        inputs = [x for x, form in zip((*given, *self._captured), self.inputs, strict=True) if form.wanted]
        return [*ends, _Ticket(results, inputs, self._surroundings).token()]


class _Ticket(bytearray):
    """Results that autograd has recorded, and the inputs by which a gradient is wanted: memory of a token."""

    def __init__(self, results: Sequence[Tensor], inputs: Sequence[Tensor], at: Surroundings) -> None:
        number = next(_count)
        super().__init__(number.to_bytes(8, "little"))
        self.results, self.inputs, self.surroundings = results, inputs, at
        _tickets[number] = self

    def token(self) -> Tensor:
        """Return its number, in memory that keeps the ticket."""
        return torch.frombuffer(self, dtype=torch.int64).view(())

    def gradients(self, slopes: Sequence[Tensor], places: Sequence[int]) -> list[Tensor]:
        """Return the gradients by all inputs, of slopes by the results at some places."""
        pairs = [(self.results[k], slope) for k, slope in zip(places, slopes, strict=True)]
        pairs = [(x, slope) for x, slope in pairs if x.requires_grad]
        found: Sequence[Tensor | None] = [None] * len(self.inputs)
        if pairs:
            ends, by = zip(*pairs, strict=True)
            with self.surroundings.again(recorded=False):
                found = torch.autograd.grad(ends, self.inputs, by, retain_graph=True, allow_unused=True)
        made = [torch.zeros_like(x) if y is None else y for x, y in zip(self.inputs, found, strict=True)]
        return _apart(made, [TensorForm.of(x).dense() for x in self.inputs], slopes)


class Surroundings:
    """The modes of torch, whether it records, casts or transforms operations, where a graph was read."""

    def __init__(self, recorded: bool) -> None:
        self.recorded = recorded
        self._keys = torch._C._dispatch_tls_local_include_set(), torch._C._dispatch_tls_local_exclude_set()
        self.key = recorded, *map(repr, self._keys)

    @contextlib.contextmanager
    def again(self, *, recorded: bool | None = None) -> Iterator[None]:
        """Restore them in an operator, in which autograd sees no operations, and where a graph is read."""
        on, flag = self.recorded if recorded is None else recorded, torch.compiler._is_compiling_flag
        with torch._C._ForceDispatchKeyGuard(*self._keys), torch.set_grad_enabled(on):
            torch.compiler._is_compiling_flag = False
            try:
                yield
            finally:
                torch.compiler._is_compiling_flag = flag


def _same(x: Tensor, y: Tensor) -> bool:
    """Return whether two tensors are the same numbers in memory."""
    return x.data_ptr() == y.data_ptr() and TensorForm.of(x.detach()) == TensorForm.of(y.detach())


def _kind(x: Tensor) -> TensorForm:
    """Return the form of a result whatever its strides are."""
    return TensorForm.of(x)._replace(stride=())


def _apart(tensors: Sequence[Tensor], forms: Sequence[TensorForm], others: Sequence[Tensor]) -> list[Tensor]:
    """Return tensors of given strides that share memory with none of these, with others, or with autograd."""
    used, found = {x.untyped_storage().data_ptr() for x in others}, []
    for x, form in zip(tensors, forms, strict=True):
        memory = x.untyped_storage().data_ptr()
        # The backward pass may read a result, and a graph uses its memory again when it is done with it.
        fits = memory not in used and x.stride() == form.stride and x.grad_fn is None
        found.append(x.detach() if fits else form.empty().copy_(x.detach()))
        used.add(memory)
    return found


@functools.cache
def define() -> None:
    """Define the operators, at the first call that is read for a graph."""
    tags: dict[str, Any] = (
        {"tags": (torch.Tag.cudagraph_unsafe,)} if hasattr(torch.Tag, "cudagraph_unsafe") else {}
    )

    @torch.library.custom_op(
        "staf_torch::call",
        mutates_args=(),
        schema="(str name, Tensor[] tensors, Tensor[] captured) -> Tensor[]",
        **tags,
    )
    def call(name: str, tensors: list[Tensor], captured: list[Tensor]) -> list[Tensor]:
        return CALLS[name].run(tensors, captured)

    @call.register_fake
    def _(name: str, tensors: list[Tensor], captured: list[Tensor]) -> list[Tensor]:
        of = CALLS[name]
        token = [torch.empty((), dtype=torch.int64, device="cpu")] if of.wanted else []
        return [*(form.empty() for form in of.results), *token]

    @torch.library.custom_op(
        "staf_torch::gradients",
        mutates_args=(),
        schema="(str name, Tensor token, Tensor[] slopes, int[] places) -> Tensor[]",
        **tags,
    )
    def gradients(name: str, token: Tensor, slopes: list[Tensor], places: list[int]) -> list[Tensor]:
        return _tickets[int(token)].gradients(slopes, places)

    @gradients.register_fake
    def _(name: str, token: Tensor, slopes: list[Tensor], places: list[int]) -> list[Tensor]:
        return [form.dense().empty() for form in CALLS[name].inputs if form.wanted]

    def keep(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
        ctx.set_materialize_grads(False)
        ctx.name, ctx.count, ctx.forms = inputs[0], len(inputs[1]), CALLS[inputs[0]].inputs
        ctx.save_for_backward(output[-1])

    def backward(ctx: Any, slopes: list[Tensor | None]) -> tuple[Any, ...]:
        places = [k for k, slope in enumerate(slopes[:-1]) if slope is not None]
        (token,) = ctx.saved_tensors
        found = iter(torch.ops.staf_torch.gradients(ctx.name, token, [slopes[k] for k in places], places))
        made = [next(found) if form.wanted else None for form in ctx.forms]
        return None, made[: ctx.count], made[ctx.count :]

    call.register_autograd(backward, setup_context=keep)


_P = ParamSpec("_P")
_R = TypeVar("_R")


def opaque(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function that `torch.compile` neither traces nor enters, as by `torch.compiler.disable`.

    To trace a loop that `lanes` compiles takes minutes, and what comes out is hundreds of times slower. The
    decorator of torch imports its compiler, which takes a second; this one does not.
    """
    if not hasattr(frames, "set_code_exec_strategy"):  # torch 2.6
        return _alone(function)
    _marked(function)
    actions = frames._FrameAction
    frames.set_code_exec_strategy(function.__code__, frames._FrameExecStrategy(actions.SKIP, actions.SKIP))
    return function


def one_operator(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function that is one operator in a graph of `torch.compile`, and else as by `opaque`.

    Calls elsewhere are those of the function itself.
    """
    made: Any = opaque(function)
    for name in [name for name in vars(made) if name.startswith("_torchdynamo_disable")]:
        delattr(made, name)
    made._torchdynamo_inline = spelled(function)
    if "." in function.__qualname__:
        return cast("Callable[_P, _R]", made)

    @functools.wraps(function)  # which copies attributes: that of a function a user's wrapper would have, too
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        result: _R = made(*args, **kwargs)
        return result

    vars(called).pop("_torchdynamo_inline", None)
    return called


def _alone(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that sees to it by itself that nobody compiles what it calls."""
    set_frames = frames.set_eval_frame

    @functools.wraps(function)
    def alone(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = set_frames(None)
        try:
            return function(*args, **kwargs)
        finally:
            set_frames(before)

    frames.skip_code(alone.__code__)  # type: ignore[attr-defined]
    _marked(alone)
    return alone


def _marked(function: Any) -> None:
    """Have torch call a function in place of looking into it."""
    function._torchdynamo_disable, function._torchdynamo_disable_recursive = True, True
    function._torchdynamo_disable_msg = "it compiles itself"
