"""Gradients that nobody computes: refused where one is wanted, so that none is absent without a word.

Planners, designs and filters of streams run without autograd. Asked with a tensor that requires a gradient,
while autograd is on, they refuse in one sentence. Parameters of torch's own layers require one by default,
and a network that was trained elsewhere is no question for a derivative; in a loop a state follows from what
requires one. These are taken as numbers, and what is computed with them refuses the backward pass.

Derivatives in reverse mode as `torch.func` gives them, without what it loads for its own.

A backward pass of `torch.func` first imports torch's compiler, 1.4 s of a processor in every process, to tell
it that there is nothing to do; `torch.autograd.grad` of given slopes imports SymPy, .6 s, to compare shapes.
Between tensors that `torch.func.vjp` has made, the pass itself needs neither: it is the same operations in
the same order, also under `torch.func.vmap`, in a derivative of a derivative and in a trace.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import io
from collections.abc import Callable, Sequence
from types import FunctionType, MethodType
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from .dependencies.walk import ATOMS, BOUND, IDLE, Derived, Walk, content_of, is_users
from .tree import flatten, unflatten

_P = ParamSpec("_P")
_R = TypeVar("_R")
_REMEDY = "call it under `torch.no_grad()`, or detach that (`.detach()`, `.requires_grad_(False)`)"


def refuse_gradient(call: str, **given: Any) -> tuple[Tensor, ...]:
    """Refuse, while autograd is on, what requires a gradient: tensors, and what objects hold or lead to.

    Args:
        call: that computes none, for the message.
        given: its arguments by name.

    Returns:
        The parameters of layers that require one, for `marked`.

    Raises:
        ValueError: if a tensor that is no parameter of a layer requires a gradient.
    """
    layers: list[Tensor] = []
    for name, value in given.items() if torch.is_grad_enabled() else ():
        found, some = _wanting(value)
        if found and found[0] is value:
            raise ValueError(f"`{call}` computes no gradient, and `{name}` requires one: {_REMEDY}.")
        if found:
            what = f"a tensor of the shape {tuple(found[0].shape)} that requires one"
            raise ValueError(f"`{call}` computes no gradient, and `{name}` holds {what}: {_REMEDY}.")
        layers += some
    return tuple(layers)


def defer_gradient(call: str, **given: Any) -> tuple[Tensor, ...]:
    """Refuse as `refuse_gradient`, but for a tensor that follows from others, as in a loop of which a
    gradient is wanted, refuse the backward pass and not the call.

    Returns the tensors and the parameters of layers that require one, for `marked`.
    """
    if not torch.is_grad_enabled():
        return ()
    late = {n: v for n, v in given.items() if isinstance(v, Tensor) and v.requires_grad and not v.is_leaf}
    return *late.values(), *refuse_gradient(call, **{n: v for n, v in given.items() if n not in late})


def wants_gradient(*given: Any) -> bool:
    """Return whether autograd is on and something requires a gradient: tensors, and what objects hold."""
    return torch.is_grad_enabled() and any(part for value in given for part in _wanting(value))


def gradients_of(call: str, **given: Any) -> tuple[Tensor, ...]:
    """Return the tensors that require a gradient, of an object that keeps numbers made from them: as
    `refuse_gradient` where autograd is on, and where it is off all that somebody may ask for later.
    """
    if torch.is_grad_enabled():
        return refuse_gradient(call, **given)
    found = [part for value in given.values() for parts in _wanting(value) for part in parts]
    return tuple(part for part in found if part.is_leaf)  # others cannot be copied


def marked(call: str, layers: Sequence[Tensor], result: _R) -> _R:
    """Return a tree of results that refuse the backward pass to parameters of layers, where any require one.

    ``call`` is named by the message, ``layers`` are what `refuse_gradient` returned, ``result`` is a tree of
    tensors, or a dataclass of these.
    """
    wanted = [part for part in layers if part.requires_grad] if layers and torch.is_grad_enabled() else []
    if not wanted:
        return result
    if dataclasses.is_dataclass(result) and not isinstance(result, type):
        fields = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "time"}
        return dataclasses.replace(result, **marked(call, layers, fields))
    leaves, structure = flatten(result)
    real = [_Unserved.apply(leaf, wanted[0], call) if leaf.is_floating_point() else leaf for leaf in leaves]  # type: ignore[no-untyped-call]
    again: _R = unflatten(structure, iter(real))
    return again


def without_gradient(call: str, *names: str) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Decorate a function that runs without autograd: it refuses arguments that require a gradient.

    ``call`` is named by the message, ``names`` are those of the arguments that are looked at.
    """

    def decorated(function: Callable[_P, _R]) -> Callable[_P, _R]:
        places = [(name, [*inspect.signature(function).parameters].index(name)) for name in names]

        @functools.wraps(function)
        def alone(*args: _P.args, **kwargs: _P.kwargs) -> _R:
            if not torch.is_grad_enabled():
                return function(*args, **kwargs)
            given = {name: args[k] if k < len(args) else kwargs.get(name) for name, k in places}
            given = {"the object" if name == "self" else name: value for name, value in given.items()}
            layers = defer_gradient(call, **given)
            with torch.no_grad():
                result = function(*args, **kwargs)
            return marked(call, layers, result) if layers else result

        return alone

    return decorated


def _wanting(value: Any, depth: int = 6) -> tuple[list[Tensor], list[Tensor]]:
    """Return the tensors of an object that require a gradient: of somebody, and parameters of layers."""
    if value is None or isinstance(value, Tensor):
        return ([value] if value is not None and value.requires_grad else []), []
    if _surely_none(value, {}):
        return [], []
    walk = Walk(io.BytesIO())
    try:
        walk.dump(value)
        walk.finish()
    except Exception:  # an open file, a lock: beside it there may be tensors
        parts = [_wanting(part, depth - 1) for part in _inside(value)] if depth else []
        return [t for some, _ in parts for t in some], [t for _, some in parts for t in some]
    found = [part for part in walk.tensors if part.requires_grad]
    layers = [part for part in found if id(part) in walk.layers]
    return [part for part in found if id(part) not in walk.layers], layers


def _surely_none(value: Any, seen: dict[int, Any]) -> bool:
    """Return whether modules and containers of this library's and torch's, down to numbers and tensors, hold
    no tensor that requires a gradient: a tenth of the time of a walk. False where there is more to look at.
    """
    kind = type(value)
    if kind in _NUMBERS:
        return True
    if isinstance(value, Tensor):
        return not value.requires_grad
    if id(value) in seen:
        return True
    seen[id(value)] = value
    if isinstance(value, dict | tuple | list):
        parts = value.values() if isinstance(value, dict) else value
    elif isinstance(value, MethodType):
        parts = value.__self__, value.__func__
    elif isinstance(value, FunctionType):
        if is_users(value) or vars(value):
            return False
        parts = (value.__defaults__, *map(content_of, value.__closure__ or ()))
    elif isinstance(value, type):
        return not is_users(value)
    elif hasattr(value, "__dict__") and not isinstance(value, Derived) and not is_users(kind):
        parts = [part for name, part in vars(value).items() if name not in IDLE and name != BOUND]
    else:
        return False
    return all(_surely_none(part, seen) for part in parts)


_NUMBERS = frozenset((*ATOMS - {tuple}, torch.dtype, torch.device, torch.Size))


def _inside(value: Any) -> list[Any]:
    """Return what a container, a function or an object leads to, one step deep."""
    if isinstance(value, dict):
        return [*value.values()]
    if isinstance(value, list | tuple | set):
        return [*value]
    closed = map(content_of, getattr(value, "__closure__", None) or ())
    return [*closed, getattr(value, "__self__", None), *getattr(value, "__dict__", {}).values()]


class _Unserved(torch.autograd.Function):
    """Return the same numbers as an operation without a derivative."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, wanted: Tensor, call: str) -> Tensor:
        ctx.call = call
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> Any:
        told = "and one is wanted through it"
        raise ValueError(f"`{ctx.call}` computes no gradient, {told}: {_REMEDY}.")


def grad(
    function: Callable[..., Any], argnums: int | tuple[int, ...] = 0, has_aux: bool = False
) -> Callable[..., Any]:
    """Return the derivative of a function whose value is one number, as `torch.func.grad`."""

    def slope(*args: Any) -> Any:
        if torch.compiler.is_compiling():  # torch's compiler knows its own transform
            return torch.func.grad(function, argnums, has_aux)(*args)

        def slopes(*at: Tensor) -> Any:
            value, *aux = of(*at) if has_aux else (of(*at),)
            if value.dim() > 0:  # torch's own pass takes one of a single entry
                rule = "a derivative is of one number, a tensor without dimensions"
                raise RuntimeError(f"{rule}; got one of the shape {tuple(value.shape)}")
            found = backward((value,), at, None, create_graph=True)
            return (found, *aux) if has_aux else found

        of, at = _of_some(function, args, argnums)
        found, _, *aux = torch.func.vjp(slopes, *at, has_aux=has_aux)
        found = found[0] if isinstance(argnums, int) else found
        return (found, *aux) if has_aux else found

    return slope


def vjp(function: Callable[..., Any], *primals: Tensor, has_aux: bool = False) -> tuple[Any, ...]:
    """Return the values of a function, a tensor or a tuple of them, and its pass back: `torch.func.vjp`."""
    kept: list[tuple[Tensor, ...]] = []

    def keeping(*at: Tensor) -> Any:
        made = function(*at)
        values = made[0] if has_aux else made
        kept[:] = [at, values if isinstance(values, tuple) else (values,)]
        return made

    values, own, *aux = torch.func.vjp(keeping, *primals, has_aux=has_aux)

    def pull(slopes: Any) -> tuple[Tensor, ...]:
        if torch.compiler.is_compiling() or torch.is_inference_mode_enabled():
            found: tuple[Tensor, ...] = own(slopes)
            return found
        at, ends = kept
        given = slopes if isinstance(values, tuple) else (slopes,)
        return backward(ends, at, given, create_graph=torch.is_grad_enabled())

    return (values, pull, *aux)


def jacrev(
    function: Callable[..., Any], argnums: int | tuple[int, ...] = 0, has_aux: bool = False
) -> Callable[..., Any]:
    """Return the derivative of a function whose value is one tensor, as `torch.func.jacrev`."""

    def jacobian(*args: Any) -> Any:
        if torch.compiler.is_compiling():
            return torch.func.jacrev(function, argnums, has_aux=has_aux)(*args)
        of, at = _of_some(function, args, argnums)
        values, pull, *aux = vjp(of, *at, has_aux=has_aux)
        units = torch.eye(values.numel(), dtype=values.dtype, device=values.device)
        rows = torch.func.vmap(pull)(units.view(-1, *values.shape))
        found = tuple(row.view(values.shape + x.shape) for row, x in zip(rows, at, strict=True))
        slopes = found[0] if isinstance(argnums, int) else found
        return (slopes, *aux) if has_aux else slopes

    return jacobian


def _of_some(
    function: Callable[..., Any], args: tuple[Any, ...], argnums: int | tuple[int, ...]
) -> tuple[Callable[..., Any], list[Tensor]]:
    """Return the function of some of its arguments alone, and these."""
    places = (argnums,) if isinstance(argnums, int) else argnums

    def of(*at: Tensor) -> Any:
        given = dict(enumerate(args)) | dict(zip(places, at, strict=True))
        return function(*given.values())

    return of, [args[place] for place in places]


def backward(
    ends: Sequence[Tensor], at: Sequence[Tensor], slopes: Sequence[Tensor] | None, *, create_graph: bool
) -> tuple[Tensor, ...]:
    """Return the slopes by some tensors of those that depend on them: 0 where none does.

    Without ``slopes``, that are of the shapes and dtypes of ``ends``, these are one number, of which the
    graph is not kept.
    """
    given: Sequence[Tensor | None] = [None] * len(ends) if slopes is None else slopes
    pairs = [(end, slope) for end, slope in zip(ends, given, strict=True) if end.requires_grad]
    if not pairs:
        return tuple(map(torch.zeros_like, at))
    some, their = [end for end, _ in pairs], [slope for _, slope in pairs]
    run = getattr(torch.autograd.graph, "_engine_run_backward", None)
    if slopes is None or run is None or torch._C._len_torch_function_stack():
        options: dict[str, Any] = {"retain_graph": slopes is not None, "create_graph": create_graph}
        found = torch.autograd.grad(some, at, their, allow_unused=True, **options)
    else:
        found = run(tuple(some), tuple(their), True, create_graph, tuple(at), True, accumulate_grad=False)
    return tuple(torch.zeros_like(x) if s is None else s for s, x in zip(found, at, strict=True))
