"""Derivatives in reverse mode as `torch.func` gives them, without what it loads for its own.

A backward pass of `torch.func` first imports torch's compiler, 1.4 s of a processor in every process, to tell
it that there is nothing to do; `torch.autograd.grad` of given slopes imports SymPy, .6 s, to compare shapes.
Between tensors that `torch.func.vjp` has made, the pass itself needs neither: it is the same operations in
the same order, also under `torch.func.vmap`, in a derivative of a derivative and in a trace.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def grad(
    function: Callable[..., Any], argnums: int | tuple[int, ...] = 0, has_aux: bool = False
) -> Callable[..., Any]:
    """Return the derivative of a function whose value is one number, as `torch.func.grad`.

    Args:
        function: of tensors.
        argnums: of the arguments by which it is differentiated.
        has_aux: whether the function returns a pair, of which the second part is passed on.
    """

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

    Args:
        ends: that depend.
        at: with ``requires_grad``.
        slopes: of ``ends``, of their shapes and dtypes; None for one number, of which the graph is not kept.
        create_graph: whether the result is differentiated again.
    """
    given: Sequence[Tensor | None] = [None] * len(ends) if slopes is None else slopes
    pairs = [(end, slope) for end, slope in zip(ends, given, strict=True) if end.requires_grad]
    if not pairs:
        return tuple(map(torch.zeros_like, at))
    some, their = [end for end, _ in pairs], [slope for _, slope in pairs]
    found = _passed(some, their, at, slopes is not None, create_graph)
    return tuple(torch.zeros_like(x) if s is None else s for s, x in zip(found, at, strict=True))


def _passed(
    ends: Sequence[Tensor],
    slopes: Sequence[Tensor | None],
    at: Sequence[Tensor],
    again: bool,
    create_graph: bool,
) -> Sequence[Tensor | None]:
    run = getattr(torch.autograd.graph, "_engine_run_backward", None)
    if slopes[0] is None or run is None or torch._C._len_torch_function_stack():
        return torch.autograd.grad(
            ends, at, slopes, retain_graph=again, create_graph=create_graph, allow_unused=True
        )
    given = tuple(ends), tuple(slopes), again, create_graph, tuple(at), True
    found: Sequence[Tensor | None] = run(*given, accumulate_grad=False)
    return found
