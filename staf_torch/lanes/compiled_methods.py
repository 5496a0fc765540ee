"""Methods of a class that a program serves once their calls pay for it: `compiled`, `ready`.

A policy is asked ten times in a test and a hundred thousand times in a control loop. Its class says in one
line that a method may be compiled, ``@compiled("a policy")``; the method stays plain torch, which is what it
means. A program serves once the calls in plain torch have taken as long as a compiler, by their operations
(`PlainTime`), and from the hundredth call on at the latest. It is made anew when anything that the owner
holds has changed (`Contents`), is no part of a pickle or a copy, and is out of the way where somebody traces
or differentiates. To compile at construction would take seconds of every short test.

Loops that begin in plain torch: compiled where that repays; a sign, and advice, where they take long.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import time
from collections.abc import Callable, Sequence
from types import CodeType, MethodType
from typing import Any, overload

import torch
from torch import Tensor, nn
from torch.utils import _device

from ..signs import Sign
from .calls.choice import PlainTime, RepaysError, ShortCall, undecided, worth
from .calls.inputs import at_once, one_precision, ordinary
from .calls.inputs import served as served_by
from .dependencies.contents import Contents
from .dependencies.walk import BOUND
from .program import Program
from .row_numbers import RowNumbers, one_by_one, over_rows, points_of_rows
from .shared_programs import Rows, Trees, is_state
from .threads import ENTRIES, Mutex, alone
from .torch_compile.operators import NAMED, one_operator, spelled
from .trace.loops import tracing_now
from .trace.row_independence import generators
from .tree import Shared, Tree, flatten, plain

_PAYS = 100  # calls of a small batch in plain torch after which it is compiled, however short they are
_KEPT = 64  # shapes of calls that are remembered
_is_exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)  # torch 2.6 has none


class compiled:  # noqa: N801
    """Decorator of a method whose rows are alone, y = f(x) or trees of several: compiled where that pays.

    Example:
        >>> class Damping(torch.nn.Module):
        ...     @lanes.compiled("a damping")
        ...     def forward(self, x):
        ...         return -x[..., 1:].tanh()
        >>> lanes.ready(Damping(), torch.zeros(2))
        True

        Shown by `staf_torch/lanes/README.md`.

    The method takes one tensor, (..., n) -> (..., m), or several trees of (B, ...) and returns such a tree.

    Args:
        name: in the log; programs of one name share texts.
        by: makes what serves for an owner, the like of `Rows`; one program of the method by default.
        pays: calls of a small batch after which it is compiled at the latest; inf: not before `hasten`.
        copies: as in `Program`.
    """

    def __init__(
        self, name: str, *, by: Callable[[Any], Any] | None = None, pays: float = _PAYS, copies: int = 1
    ) -> None:
        self.name, self.by, self.pays, self.copies = name, by, pays, copies

    def __call__(self, definition: Callable[..., Tree]) -> compiled:
        self.definition, self.__doc__ = definition, definition.__doc__
        self.in_graphs = f"{self!r} {len(NAMED)}"
        NAMED[self.in_graphs] = self
        return self

    @overload
    def __get__(self, owner: None, _: type) -> compiled: ...
    @overload
    def __get__(self, owner: Any, _: type) -> CompiledMethod: ...
    def __get__(self, owner: Any, _: type) -> compiled | CompiledMethod:
        if owner is None:
            return self
        bound = vars(owner).get(BOUND)
        if bound is None or bound.owner is not owner:
            bound = bound_to(owner)
        method: CompiledMethod | None = bound.get(self)
        if method is None:
            method = bound.setdefault(self, CompiledMethod(MethodType(self.definition, owner), owner, self))
        return method


def _called_by(settings: compiled, owner: Any, *given: Any) -> Any:
    """Call the method of an owner."""
    return settings.__get__(owner, type(owner))(*given)


def _got_in_graph(settings: compiled, owner: Any, _: type) -> Any:
    """Return what `torch.compile` reads as the method of an owner."""
    return settings if owner is None else functools.partial(_CALLED_BY, settings.in_graphs, owner)


_CALLED_BY = spelled(_called_by)
vars(compiled)["__get__"]._torchdynamo_inline = _got_in_graph


class _Bound(dict[Any, Any]):
    """The compiled methods of an object and its calls in graphs: none of a copy or a pickle."""

    def __init__(self, owner: Any = None) -> None:
        self.owner = owner

    def __reduce__(self) -> tuple[Any, ...]:
        return _Bound, ()


def bound_to(owner: Any) -> dict[Any, Any]:
    """Return what is compiled of an object."""
    bound: _Bound = vars(owner).setdefault(BOUND, _Bound(owner))
    if bound.owner is not owner:  # that of which the owner is a shallow copy
        bound = vars(owner)[BOUND] = _Bound(owner)
    return bound


class CompiledMethod:
    """A method of an owner, by its definition or by a program."""

    def __init__(self, definition: Callable[..., Tree], owner: Any, settings: compiled) -> None:
        self.definition, self.owner, self._settings = definition, owner, settings
        self._asked, self.waits = 0.0, False  # whether it was to be compiled, and has not been called since
        self._plain: tuple[PlainTime, float] | None = None  # of its first call, with so many rows
        self._lock = Mutex()
        self._at_once: dict[Any, Callable[[Tensor], Tensor]] = {}  # by shape, strides, dtype: of what serves
        self._served: Any = None  # written before what it has read
        self._read: Contents | None = None

    @overload
    def __call__(self, x: Tensor, /) -> Tensor: ...
    @overload
    def __call__(self, x: Tensor, first: Tree, /, *more: Tree) -> Any: ...
    @one_operator
    def __call__(self, x: Tensor, /, *more: Tree) -> Any:
        """y: (..., n) -> (..., m), or trees of (B, ...)."""
        read = self._read
        if read is not None and not more and at_once(x) and worth(True) and not tracing_now():
            try:
                found = self._at_once.get((x.shape, x.stride(), x.dtype))
            except RuntimeError:  # neither of one that is sparse or nested
                found = None
            if found is not None and read.unchanged(library=False) and not read.wants_gradient():
                self.waits = False
                return found(x)
        return self._looked_at(x, *more)

    def _looked_at(self, x: Tensor, *more: Tree) -> Any:
        """Compute where a call is not like an earlier one that machine code has served."""
        try:
            plain = not ordinary(flatten((x, *more))[0] if more else (x,)) or x.numel() == 0 or tracing_now()
            if not (plain or more):
                x.stride()
        except RuntimeError:  # a nested tensor has no size, a sparse one no strides
            return self._defined(x, *more)
        if plain:
            return self._exported(x, *more) if _is_exporting() else self._learned(x, *more)
        if self._served is None or not worth(True):
            if not is_state(x):
                return self._refused(x, *more)
            rows = x.numel() / x.shape[-1]
            if not self._pays(rows):
                return self._counted(rows, x, *more)
        read = self._read
        if read is None or not read.unchanged(library=False):
            read = self._compile(trees=bool(more))
        if read.wants_gradient():  # of what the owner holds
            return self._learned(x, *more)
        if (served := self._served) is None:  # no longer
            self._compile(trees=bool(more))
            served = self._served
        assert served is not None
        self.waits = False
        if more:
            return served(x, *more)
        dims = x.dim()
        try:
            if dims > 2:
                with points_of_rows(len(x), x.shape[1:-1].numel()):
                    y = served(x.reshape(-1, x.shape[-1]))
            else:
                y = served(x)
        except (RuntimeError, ValueError):
            self._refused(x)
            raise
        return y.view(-1) if dims == 1 else y.reshape(*x.shape[:-1], y.shape[-1])

    def _learned(self, x: Tensor, *more: Tree) -> Any:
        """Compute what may have a gradient: by the program that serves, if one does, or the definition."""
        program: Program | None = getattr(self._served, "program", None)
        given = flatten((x, *more))[0]
        usable = worth(True) and torch.is_grad_enabled() and isinstance(x, Tensor) and not tracing_now()
        if program is None or not usable or x.is_nested or not x.numel() or not served_by(given):
            return self._defined(x, *more)
        if self._read is None or not self._read.unchanged(library=False):
            self._compile(trees=bool(more))
            return self._learned(x, *more)
        if more:
            return program.once(x, *more)
        if not is_state(x):
            return self._refused(x)
        with points_of_rows(len(x), x.shape[1:-1].numel()) if x.dim() > 2 else contextlib.nullcontext():
            y: Tensor = program((), (), (x.reshape(-1, x.shape[-1]),), steps=1)[1]
        return y.reshape(*x.shape[:-1], y.shape[-1])

    def _exported(self, x: Tensor, *more: Tree) -> Any:
        """Compute by the definition for `torch.export`, which has no words for what it does not take."""
        try:
            return self.definition(x, *more)
        except Exception as error:
            told = f"`torch.export` does not take {self._settings.name} ({type(self.owner).__name__})"
            remedy = "`staf_torch.deploy.trace(policy, x)` makes such a program, its `export_c` a C header"
            raise ValueError(f"{told}: {remedy}.") from error

    @property
    def __code__(self) -> CodeType:
        """Return the code of the definition, for `torch.export`."""
        return self.definition.__code__

    def _defined(self, x: Tensor, *more: Tree) -> Any:
        """Compute by the definition, with new tensors beside x whatever the default device is."""
        with one_precision(self._settings.name, x, *more):
            if RowNumbers.made and isinstance(x, Tensor):
                states = Shared(x) if x.dim() < 2 else x
                return over_rows(lambda at, *rest: self.definition(plain(at), *rest), states, *more)
            if _device.CURRENT_DEVICE is None or not isinstance(x, Tensor):
                return self.definition(x, *more)
            with torch.device(x.device):
                return self.definition(x, *more)

    def _refused(self, x: Tensor, *more: Tree) -> Any:
        """Raise what the definition says of x, or that no state is an integer, a flag or a single number."""
        found = self._defined(x, *more)
        if is_state(x):
            return found
        name = f"{type(self.owner).__name__}.{self.definition.__name__}"
        rule = "must be states (..., n) of floating point: write `.double()`"
        raise ValueError(f"`{name}(x=...)` {rule}; got {tuple(x.shape)} of {x.dtype}.")

    def _pays(self, rows: float) -> bool:
        """Return whether the calls so far and this one repay a compiler: a large batch does by itself."""
        work, most = rows / 200, self._settings.pays
        if self._plain is not None:
            plain, counted = self._plain
            work = max(work, most * plain.seconds(rows / counted) / plain.build)
        pays = self._asked + work >= most
        pays = worth(pays) if most < math.inf else pays
        self._asked += 0.0 if pays else 1 + work
        return pays

    def _counted(self, rows: float, x: Tensor, *more: Tree) -> Any:
        """Compute by the definition, the first time with a count of its operations."""
        few = alone(int(rows) * ENTRIES)
        if self._plain is not None or not undecided() or self._settings.pays == math.inf:
            with few:
                return self._defined(x, *more)
        with few, PlainTime() as plain:
            found = self._defined(x, *more)
        self._plain = plain, rows
        self._asked = max(self._asked, self._settings.pays * plain.seconds() / plain.build)
        return found

    @property
    def compiled(self) -> bool:
        """Return whether a compiled program has served a call."""
        return self._served is not None and self._served.compiled

    def hasten(self) -> None:
        """Compile at the next call, whatever it pays."""
        self._asked, self.waits = math.inf, True

    def _compile(self, trees: bool) -> Contents:
        """Make what serves, unless that is made in a way of its own and a gradient by the owner is wanted."""
        with self._lock:
            if self._served is not None and self._read is not None and self._read.unchanged(library=False):
                return self._read  # another thread has
            settings, read = self._settings, Contents(self.definition, self.owner)
            read.warn(settings.name)
            served: Any = None
            if settings.by is None:
                made = self.definition, settings.name, self.definition, self.owner
                rows = Rows(*made, copies=settings.copies, make=lambda definition, _: definition)
                served = Trees(rows) if trees else rows
            elif not read.wants_gradient():
                served = settings.by(self.owner)
            self._at_once = {} if served is None else served.at_once
            self._served, self._read = served, read
            return read


@Sign("lanes.ready")
def ready(module: nn.Module, x: Tensor) -> bool:
    """Compile now what serves calls like ``module(x)``: no control loop must wait for it later.

    Policies of `staf_torch.adp` run in plain torch until their calls would have paid for a compiler. It takes
    one second to thirty, once; from the user's cache the machine code is there in milliseconds.

    Example:
        >>> plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = adp.RolloutPolicy.of_lqr(plant, cost)
        >>> lanes.ready(policy, torch.zeros(1, 2).double())  # now, not in the loop
        True

        Shown by `staf_torch/lanes/README.md`.

    Args:
        module: a policy, or one that holds policies.
        x: a state (n,) or states (B, n) as they will come; every shape has a plan of its own.

    Returns:
        Whether compiled programs serve, all there are. False where there are none, or plain torch serves: the
        log says why.
    """
    methods = [method for part in module.modules() for method in methods_of(part)]
    for method in methods:
        method.hasten()
    with torch.no_grad():
        module(x)
    served = [method.compiled for method in methods if not method.waits]
    for part in module.modules():
        served += [value.compiled for value in vars(part).values() if isinstance(value, Program)]
    return bool(served) and all(served)


def methods_of(owner: Any) -> list[CompiledMethod]:
    """Return the compiled methods of an object."""
    kinds = [vars(kind).values() for kind in type(owner).__mro__]
    return [
        value.__get__(owner, type(owner)) for kind in kinds for value in kind if isinstance(value, compiled)
    ]


_log = logging.getLogger(__name__)
_FEW = 16  # steps of a loop that are not worth the count of one
_SAID, _LONG = 1.5, 3.0  # s after which a loop says that it takes long, and that are then left of it at least


class LoopProgram:
    """Program of a loop that begins in plain torch, and is compiled from its start where that repays.

    The first step is counted as it runs (`PlainTime`). Where all of them take twice as long as a compiler,
    it is undone, random numbers too, and the compiled program runs the loop. Else plain torch goes on, and
    says in the log after 1.5 s how long the rest takes, if more than 3 s.

    ``times`` are those of all calls together, ``remedy`` says in the log what makes it faster, and other
    ``parts`` are other loops.
    """

    def __init__(
        self,
        plain: Program,
        compiled: Callable[[], Program] | None,
        times: int,
        *,
        remedy: str = "",
        parts: Sequence[Any] = (),
    ) -> None:
        self._step, self._make, self._times, self._remedy = plain.step, compiled, times, remedy
        self._plain = Program(self._timed, name=plain.name, compile=False)
        self._compiled: Program | None = None
        self._sign = Sign(f"{plain.name} in plain torch", times)
        self._done, self._spent, self._fastest, self._said = 0, 0.0, math.inf, False
        self._counted = 0  # rows, one after the other, of which a step was counted
        self._short = ShortCall(plain.name, tuple(map(type, parts)), "`compile=True`" if remedy else "")

    def __call__(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> tuple[Tree, Tree]:
        """The carry after the last step, and the outputs, as of a `Program`."""
        if self._compiled is None:
            put_back = generators()
            try:
                return self._in_plain_torch(carry, now, row, steps=steps, every=every)
            except RepaysError:
                assert self._make is not None
                put_back()
                self._compiled = self._make()
        return self._compiled(carry, now, row, steps=steps, every=every)

    def _in_plain_torch(self, *given: Tree, steps: int | None, every: int) -> tuple[Tree, Tree]:
        calls, before = int(not self._done), self._spent
        with self._sign:
            found = self._plain(*given, steps=steps, every=every)
        if self._make is not None and not self._said:
            self._short.count(self._spent - before, calls)
        return found

    def _timed(self, carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        start = time.perf_counter()
        rows = one_by_one()
        if self._make is not None and rows > self._counted and self._times * rows >= _FEW:
            self._counted = rows
            with PlainTime(self._times * rows) as plain:
                found = self._step(carry, now, row)
            plain.refuse()
        else:
            found = self._step(carry, now, row)
        self._look(time.perf_counter() - start)
        return found

    def _look(self, seconds: float) -> None:
        """Log once, if a loop takes long, how long the rest of it takes by the fastest step so far."""
        self._done, self._spent = self._done + 1, self._spent + seconds
        self._sign.advance()
        self._fastest = min(self._fastest, seconds)
        if self._said or self._done < 2 or self._spent < _SAID:
            return
        rest = self._fastest * (self._times * one_by_one() - self._done)
        if rest < _LONG:
            return
        self._said = True
        _log.warning(
            "%s: %d of %d steps took %.1f s in plain torch, the rest takes some %.0f s%s",
            *(self._plain.name, self._done, self._times * one_by_one(), self._spent, rest, self._remedy),
        )
