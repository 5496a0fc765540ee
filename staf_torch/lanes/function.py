"""A function of one row without a state, compiled for those who call it thousands of times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from .call import Plan, ordinary
from .compiling import worth
from .kept import Kept
from .loops import tracing_now
from .program import Program
from .tree import Tree
from .watch import Watch

_PAYS = 100  # calls of a small batch in plain torch (some 10 ms each) that take as long as to compile
_KEPT = 64  # shapes of calls that are remembered
_OF_EVERY_MODULE = frozenset(vars(nn.Module())) - {"training"}  # containers, looked into elsewhere, and hooks
_kept: dict[str, Kept] = {}  # by the name of the functions


class Served(Protocol):
    """A function of rows, (n,) or (B, n) -> (B, 1, m), that knows whether it is compiled."""

    @property
    def compiled(self) -> bool: ...

    def __call__(self, x: Tensor, /) -> Tensor: ...


class RowFunction:
    """y = function(x), (..., n) -> (..., m), each row by itself.

    The definition is plain torch. Where the calls so far would have paid for it, and nobody traces or
    differentiates, a program of `lanes` serves; it is made anew when a tensor of the module, an attribute of
    the module or a child, or what functions of a user in it read (globals, closures) has changed since.

    Args:
        function: plain torch, of one row or many.
        module: that holds all that ``function`` reads.
        name: in the log.
        compile: makes what serves (B, n) -> (B, 1, m) in its place; one program of ``function`` by default.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        module: nn.Module,
        name: str,
        compile: Callable[[], Served] | None = None,
    ) -> None:
        self._function, self._module, self._name = function, module, name
        self._compile = self._one_program if compile is None else compile
        self._asked = 0.0
        self._served: Served | None = None
        self._seen: list[tuple[dict[str, Any], str, Any]] = []
        self._settings: list[dict[str, Any]] = []
        self._sizes: list[int] = []
        self._tensors: list[Tensor] = []
        self._versions: list[int] = []
        self._around: Watch | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it is made of: a copy compiles programs of its own."""
        compile = None if self._compile == self._one_program else self._compile
        return RowFunction, (self._function, self._module, self._name, compile)

    def __call__(self, x: Tensor) -> Tensor:
        """y: (..., n) -> (..., m)."""
        if not ordinary((x,)) or x.numel() == 0 or tracing_now():
            return self._function(x)
        rows = x.numel() / x.shape[-1]
        if not worth(self._asked + rows / 200 >= _PAYS):  # a large batch pays for itself
            self._asked += 1 + rows / 200
            return self._function(x)
        if self._served is None or self._changed():
            self._remember()
            self._served = self._compile()
        dims = x.dim()
        y = self._served(x if dims <= 2 else x.reshape(-1, x.shape[-1]))
        return y.view(-1) if dims == 1 else y.reshape(*x.shape[:-1], y.shape[-1])

    @property
    def compiled(self) -> bool:
        """Whether a compiled program has served a call."""
        return self._served is not None and self._served.compiled

    def hasten(self) -> None:
        """Compile at the next call, whatever it pays."""
        self._asked = _PAYS

    def _one_program(self) -> Served:
        return Rows(self._function, self._name, self._function, self._module)

    def _changed(self) -> bool:
        if [*map(len, self._settings)] != self._sizes:
            return True
        for part, name, value in self._seen:
            if part.get(name) is not value:
                return True
        if self._around is not None and not self._around.unchanged():
            return True
        return self._versions != self._version_list()

    def _version_list(self) -> list[int]:
        return [tensor._version for tensor in self._tensors]

    def _remember(self) -> None:
        near = [vars(module) for module in (self._module, *self._module.children())]
        parts = [
            part
            for module in self._module.modules()
            for part in (module._buffers, module._parameters, module._modules)
        ]
        self._settings = [*near, *(part for part in parts if part)]
        self._sizes = [*map(len, self._settings)]
        named = ((part, name) for part in self._settings for name in part if name not in _OF_EVERY_MODULE)
        self._seen = [(part, name, part[name]) for part, name in named]  # kept: no address is used twice
        self._tensors = [value for _, _, value in self._seen if isinstance(value, Tensor)]
        self._versions = self._version_list()
        around = Watch(self._function, self._module, surroundings=True)
        self._around = None if around.blind else around


def ready(module: nn.Module, x: Tensor) -> bool:
    """Compile now what serves calls like ``module(x)``: no control loop must wait for it at its 100th call.

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
    found = [
        part for each in module.modules() for part in vars(each).values() if isinstance(part, RowFunction)
    ]
    for function in found:
        function.hasten()
    with torch.no_grad():
        module(x)
    return bool(found) and all(function.compiled for function in found)


class Rows:
    """y = function(a, b, ...), (B, ...) to (B, ...), where nobody traces or differentiates.

    Args:
        function: plain torch, in which no row sees another.
        name: in the log.
        parts: all that ``function`` reads, for `lanes.kept`; none where nothing is to be kept.
    """

    def __init__(self, function: Callable[..., Tensor], name: str, *parts: Any) -> None:
        def step(carry: Tree, _: Tree, row: Tree) -> tuple[Tree, Tree]:
            return carry, function(*row)

        found = _kept.setdefault(name, Kept(name)).of(step, *parts, copies=1) if parts else None
        self._program = Program(step, name=name, copies=1) if found is None else found
        self._plans: dict[Any, Plan] = {}

    @property
    def compiled(self) -> bool:
        """Whether a compiled program has served a call."""
        return bool(self._plans)

    def __call__(self, *given: Tensor) -> Tensor:
        """Return y with a dimension of one time after the rows, (B, 1, ...); (n,) is one row."""
        # Shapes alone: the caller has looked at the rest.
        key = tuple([(x.shape, x.stride(), x.dtype) for x in given])
        plan = self._plans.get(key)
        if plan is not None:
            return plan(given)[0]
        rows = [x.unsqueeze(0) if x.dim() == 1 else x for x in given]
        plan, found = self.planned(*rows)
        if plan is not None:
            if len(self._plans) >= _KEPT:
                self._plans.clear()
            self._plans[key] = plan
        return found

    def planned(self, *given: Tensor) -> tuple[Plan | None, Tensor]:
        """Return the plan of calls with such inputs, (B, ...), None where the definition runs; and y."""
        prepared = self._program.prepare((), (), tuple(given), steps=1)
        found: Tensor = prepared((), (), tuple(given))[1]
        return prepared.plan, found
