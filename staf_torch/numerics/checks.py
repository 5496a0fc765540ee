"""The checks behind every ``ValueError`` that a user can meet, in one place, and what modules hold.

Each check returns the value it was given, converted where that is safe, so that a constructor reads
``self.width = positive("GaussianKernel", "width", width)``.
"""

from __future__ import annotations

import copy
import math
import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from ..lanes.gradients import refuse_gradient
from ..lanes.row_numbers import RowNumbers, all_rows, in_use
from . import COMMAND_LINE as COMMAND_LINE
from . import fail as fail
from . import show

Module = TypeVar("Module", bound=nn.Module)


def number(call: str, name: str, value: object) -> float | Tensor:
    """A finite real number, or a tensor of them."""
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            raise fail(call, name, "must be a floating-point tensor", value)
        return _in_all_rows(call, name, value, torch.isfinite, "must be finite")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise fail(call, name, "must be a number", value)
    if not math.isfinite(value):
        raise fail(call, name, "must be finite", value)
    return float(value)


def real(call: str, name: str, value: object) -> float:
    """A finite Python number."""
    if isinstance(value, Tensor):
        several = isinstance(value, RowNumbers)
        raise fail(call, name, "must be one number for all rows" if several else "must be a number", value)
    checked = number(call, name, value)
    assert isinstance(checked, float)
    return checked


def positive(call: str, name: str, value: object) -> Tensor:
    """A positive number or tensor of them, as a floating-point tensor (float64 from a number)."""
    return _tensor(_signed(call, name, number(call, name, value), "positive", value))


def non_negative(call: str, name: str, value: object) -> Tensor:
    """Like `positive`, zero allowed."""
    return _tensor(_signed(call, name, number(call, name, value), "not negative", value))


def _signed(call: str, name: str, checked: float | Tensor, sign: str, value: object) -> float | Tensor:
    """Return a number or a tensor of them whose sign is right; ``value`` is what was given."""
    holds, rule = operator.gt, "must be positive"
    if sign == "not negative":
        holds, rule = operator.ge, "must not be negative"
    if isinstance(checked, Tensor):
        return _in_all_rows(call, name, checked, lambda x: holds(x, 0), rule, value)
    if not holds(checked, 0):
        raise fail(call, name, rule, value)
    return checked


def _tensor(checked: float | Tensor) -> Tensor:
    if isinstance(checked, Tensor):
        return checked
    return torch.tensor(checked, dtype=torch.float64, device="cpu")


def _in_all_rows(
    call: str, name: str, value: Tensor, holds: Callable[[Tensor], Tensor], rule: str, given: object = None
) -> Tensor:
    """Return a tensor whose entries obey a rule, of numbers of rows in every row."""
    numbers = all_rows(value)
    if numbers.is_meta or bool((held := holds(numbers)).all()):
        return value
    if numbers is value:
        raise fail(call, name, rule, value if given is None else given)
    row = int((~held.reshape(len(held), -1).all(-1)).nonzero()[0])
    raise fail(call, name, f"{rule} in every row, which it is not in row {row}", numbers[row])


def fails(rule: Tensor) -> bool:
    """Return whether a rule (...), bool, is broken in an entry; on the meta device nobody can look, and it is
    not."""
    return not rule.is_meta and not bool(rule.all())


def own_number(call: str, name: str, value: object, sign: str = "any") -> Any:
    """Return a finite number, or a tensor of one without dimensions, of `rows` one a row; its sign
    ``positive``, ``not negative`` or ``any``."""
    if type(value) is float and 0 < value < math.inf:
        return value
    checked = number(call, name, value)
    if isinstance(checked, Tensor) and checked.dim():
        raise fail(call, name, "must be one number, or one a row by `rows`", value)
    return checked if sign == "any" else _signed(call, name, checked, sign, value)


def keep(module: nn.Module, name: str, value: Any) -> Any:
    """Hold a number of a module, by `hold` where it is a tensor."""
    return hold(module, name, value) if isinstance(value, Tensor) else value


def positive_real(call: str, name: str, value: object) -> float:
    """A positive Python number."""
    checked = real(call, name, value)
    _signed(call, name, checked, "positive", value)
    return checked


def integer(call: str, name: str, value: object, least: int) -> int:
    """An integer that is at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise fail(call, name, "must be an integer", value)
    if value < least:
        raise fail(call, name, f"must be at least {least}", value)
    return value


def object_of(call: str, kind: type, else_write: str = "", **given: object) -> None:
    """Refuse what is no object of a class: the class itself, a function, a name, None; the first such
    argument by its name, with how one is made of what is often given instead."""
    for name, value in given.items():
        if isinstance(value, kind):
            continue
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        rule = f"must be {article} {kind.__name__}{else_write and f': {else_write}'}"
        if isinstance(value, type) and issubclass(value, kind):
            rule = f"must be an object, and is the class: write `{value.__name__}(...)`"
        raise fail(call, name, rule, value)


def flag(call: str, name: str, value: object) -> bool:
    """True or false, and nothing that merely looks like it."""
    if not isinstance(value, bool):
        raise fail(call, name, "must be true or false", value)
    return value


def choice(call: str, name: str, value: object, allowed: Collection[object]) -> object:
    """Return a value that must be one of a few."""
    if value not in allowed:
        listed = ", ".join(repr(a) for a in allowed)
        raise fail(call, name, f"must be one of {listed}", value)
    return value


def vector(call: str, name: str, value: object, length: int | None = None) -> list[float]:
    """A sequence of finite numbers, or a tensor of one dimension, of a stated length where one is stated."""
    value = numbers_of(call, name, value)
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise fail(call, name, "must be a list of numbers", value)
    numbers = [v for v in value if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) != len(value):
        raise fail(call, name, "must be a list of numbers", list(value))
    if length is not None and len(numbers) != length:
        raise fail(call, name, f"must have {length} entries, one a state", list(value))
    if not all(math.isfinite(v) for v in numbers):
        raise fail(call, name, "must be finite", list(value))
    return [float(v) for v in numbers]


def numbers_of(call: str, name: str, value: Any) -> Any:
    """The numbers of a tensor, which carry no gradient on, as nested lists; anything else as it is."""
    if not isinstance(value, Tensor):
        return value
    check_shared(call, name, value)
    refuse_gradient(call, **{name: value})
    return value.tolist()


def check_shared(call: str, name: str, value: Tensor) -> None:
    """Refuse numbers of rows where nobody has said whose are meant, outside of what serves them."""
    if isinstance(value, RowNumbers) and in_use():
        raise fail(call, name, "must be the same numbers for all rows", value)


def one_or_each(call: str, name: str, value: Any, count: int) -> Tensor:
    """Return a finite number for each of ``count``, given as one for all or one each: (count,) float64."""
    if isinstance(value, Tensor):
        check_shared(call, name, value)
        refuse_gradient(call, **{name: value})
        number(call, name, value)
        if value.dim() > 1 or (value.dim() and len(value) != count):
            raise fail(call, name, f"must be one number or a list of {count}", value)
        return value.detach().to("cpu", torch.float64).expand(count).clone()
    given = value if isinstance(value, Sequence) else [real(call, name, value)] * count
    numbers = vector(call, name, given)
    if len(numbers) != count:
        raise fail(call, name, f"must be one number or a list of {count}", value)
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")


_FLOATS, _DENSE = frozenset((torch.float64, torch.float32, torch.float16, torch.bfloat16)), torch.strided


def trailing(
    call: str,
    name: str,
    value: object,
    dims: int,  # at least
    last: int | None = None,  # size of the last dimension
    *,
    meta: bool = True,  # whether a tensor without numbers will do
    vmap: bool = True,  # whether one of `torch.func.vmap` will do
) -> Tensor:
    """The one rule of states and all that comes in rows: a floating-point tensor, dense, of the right size.

    Numbers of another kind are never rounded or converted without a word: the error says what to write.
    """
    if isinstance(value, Tensor):
        if value.dtype not in _FLOATS or value.layout is not _DENSE or value.is_nested:
            raise _not_dense(call, name, value)
        what, shape = f"`{call}({name}=...)`", value.shape
        if len(shape) < dims:
            least = f"at least {dims} dimension{'s' * (dims > 1)}"
            raise ValueError(f"{what} must have {least}; got the shape {tuple(shape)}.")
        if last is not None and shape[-1] != last:
            raise ValueError(
                f"{what} must have {last} entries in its last dimension; got the shape {tuple(shape)}."
            )
        if not meta and value.is_meta:
            raise ValueError(f"{what} must have numbers, which decide here; got one on the device meta.")
        if not vmap and torch._C._functorch.is_batchedtensor(value):
            rule = "must hold all rows at once, and not one by one as under `torch.func.vmap`"
            raise ValueError(f"{what} {rule}; flatten its dimension into the rows.")
        return value
    write = "torch.as_tensor(x, dtype=torch.float64)"
    if hasattr(value, "__array__") and hasattr(value, "dtype"):
        got = f"an array {getattr(value, 'shape', '')} of {value.dtype}"
    else:
        got = show(value)
        got = got if len(got) <= 80 else f"a {type(value).__name__}"
    raise ValueError(f"`{call}({name}=...)` must be a tensor, as by `{write}`; got {got}.")


def beside_batch(call: str, name: str, value: Tensor, dims: int, batch: Sequence[int], of: str) -> None:
    """Refuse a tensor whose sizes before its last ``dims`` do not broadcast with those of a batch; ``of``
    says in the message what has these."""
    leading = value.shape[: value.dim() - dims]
    pairs = zip(reversed(leading), reversed(batch), strict=False)
    if leading != batch and not all(size == other or size == 1 or other == 1 for size, other in pairs):
        rule = f"is for {_counted(leading)}, but {of} for {_counted(batch)}: as many, or 1"
        raise ValueError(f"`{call}({name}=...)` {rule}; got the shape {tuple(value.shape)}.")


def _counted(sizes: Sequence[int]) -> str:
    return f"{' x '.join(map(str, sizes))} state{'' if list(sizes) == [1] else 's'}"


def states(holder: object, name: str, x: Tensor, last: int | None = None) -> Tensor:
    """Return states that are floating-point numbers, refused by `trailing` otherwise, in the name of the
    holder's class; for methods that are called at every stage of a step."""
    if type(x) is Tensor and x.is_floating_point():  # in half the time of a look at its dtype
        return x
    return trailing(type(holder).__name__, name, x, 1, last)


def _not_dense(call: str, name: str, value: Tensor) -> ValueError:
    """The error for numbers that are no floating point, or lie another way than one after the other."""
    if value.is_nested:
        return ValueError(f"`{call}({name}=...)` must be one dense tensor; got a nested one: stack its rows.")
    if value.dtype not in _FLOATS:
        write = ".real.double()" if value.is_complex() else ".double()"
        rule = f"must be a floating-point tensor and is {value.dtype}: write `{write}`"
        dense = value.layout is torch.strided and not value.is_meta
        return fail(call, name, rule, value if dense else None)
    return ValueError(f"`{call}({name}=...)` must be dense; got {value.layout}: write `.to_dense()`.")


def sampled(target: object, values: object, points: Tensor, outputs: int | None = None) -> Tensor:
    """Check a target's values at ``points`` (..., n): one a point, (...), or k outputs, (..., k)."""
    name = getattr(target, "__name__", type(target).__name__)
    if not isinstance(values, Tensor):
        raise ValueError(f"The target `{name}` must return a tensor; got {show(values)}.")
    expected = tuple(points.shape[:-1]) + (() if outputs is None else (outputs,))
    if tuple(values.shape) != expected:
        form = "(...)" if outputs is None else f"(..., {outputs})"
        raise ValueError(
            f"The target `{name}` must map points of shape (..., n) to values of shape {form}: "
            f"{tuple(points.shape)} must give {expected}; got {tuple(values.shape)}."
        )
    if not values.is_floating_point():
        raise ValueError(f"The target `{name}` must return floating-point numbers; got {values.dtype}.")
    return values


def hold(module: nn.Module, name: str, value: Tensor) -> Tensor:
    """Keep a hyperparameter: an `nn.Parameter` as one, to be learned; any other tensor as a fixed buffer.

    It is returned, so that ``self.width = hold(self, "width", width)`` gives the attribute its type.
    """
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, value)
    return value


def kept(module: nn.Module, name: str, *, zero: bool = False, squared: bool = False) -> Tensor:
    """Return a hyperparameter of `hold`, and refuse a learned one that training has taken out of its rule:
    positive and finite, with ``zero`` not negative, with ``squared`` its square positive in the precision
    that it has.

    A fixed one was checked when it was given. Inside `torch.compile` the check is an assertion.
    """
    fixed = module._buffers.get(name)
    if fixed is not None and not fixed.requires_grad:
        return fixed
    value: Tensor = getattr(module, name)
    if not (value.requires_grad or name in module._parameters) or value.is_meta:
        return value
    least = torch.finfo(value.dtype).tiny ** 0.5 if squared else 0.0
    rule = f"`{type(module).__name__}({name}=...)` must " + (
        "not become negative" if zero else "stay positive"
    )
    rule += f" and finite while it is learned{f' (above {least:.3g}, as it is squared)' if squared else ''}"
    plain = values_of(value)
    if plain is None:
        if torch.compiler.is_dynamo_compiling():
            inside = (value >= least if zero else value > least) & (value < math.inf)
            torch._assert_async(inside.all(), f"{rule}.")
        return value
    extremes = (plain,) if plain.dim() == 0 else plain.aminmax() if plain.numel() else ()
    for number in [extreme.item() for extreme in extremes]:  # NaN is both
        if not least <= number < math.inf or (number == least and not zero):
            raise ValueError(
                f"{rule}; got {number:.6g}. Take smaller steps, or learn its logarithm, with which it cannot "
                "leave (approximation/README.md)."
            )
    return value


def learns(module: nn.Module) -> bool:
    """Return whether a module holds parameters, in a tenth of the time of ``module.parameters()``."""
    if module._parameters and any(part is not None for part in module._parameters.values()):
        return True
    for inner in module._modules.values():  # a generator costs as much again  # noqa: SIM110
        if inner is not None and learns(inner):
            return True
    return False


def values_of(tensor: Tensor) -> Tensor | None:
    """Return the numbers of a tensor, also inside a transform of `torch.func`; None in a tracer."""
    if tensor.is_meta or torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack():
        return None
    plain = all_rows(tensor).detach()
    while torch._C._functorch.is_functorch_wrapped_tensor(plain):
        plain = torch._C._functorch.get_unwrapped(plain)
    return plain


def copied(module: Module, **buffers: Tensor) -> Module:
    """A shallow copy of a module, with other tensors in place of some; not checked."""
    other = copy.copy(module)
    other._buffers, other._modules = {**module._buffers, **buffers}, dict(module._modules)
    return other


def shown(module: nn.Module) -> str:
    """The module's own tensors for its repr: numbers by value, others by shape."""
    own = [(n, t) for n, t in (*module._parameters.items(), *module._buffers.items()) if t is not None]
    return ", ".join(f"{name}={_shown(t)}" for name, t in own)


def _shown(tensor: Tensor) -> str:
    numbers = all_rows(tensor.detach())
    if numbers.is_meta or tensor.dim():
        return str(tuple(tensor.shape))
    if isinstance(tensor, RowNumbers):
        return f"rows({float(numbers[0]):.6g} ... {float(numbers[-1]):.6g})"
    return f"{float(numbers):.6g}"
