"""A function of one row without a state, compiled for those who call it thousands of times."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any

from torch import Tensor, nn

from .combinators import tracing_now
from .plan import ordinary
from .program import Program

_PAYS = 100  # calls of a small batch in plain torch (some 10 ms each) that take as long as to compile


class RowFunction:
    """y = function(x), (..., n) -> (..., m), each row by itself.

    The definition is plain torch. Where the calls so far would have paid for it, and nobody traces or
    differentiates, a program of `lanes` serves; it is made anew when a tensor of the module, or an attribute
    of the module or a child, has changed since.

    Args:
        function: plain torch, of one row or many.
        module: that holds all that ``function`` reads.
        name: in the log.
    """

    def __init__(self, function: Callable[[Tensor], Tensor], module: nn.Module, name: str) -> None:
        self._function, self._module, self._name = function, module, name
        self._asked = 0.0
        self._program: Program | None = None
        self._seen: list[Any] = []
        self._signature: list[int] = []
        self._settings: list[dict[str, Any]] = []
        self._tensors: list[Tensor] = []
        self._versions: list[int] = []

    def __call__(self, x: Tensor) -> Tensor:
        """y: (..., n) -> (..., m)."""
        if not ordinary((x,)) or x.numel() == 0 or tracing_now():
            return self._function(x)
        flat = x if x.dim() == 2 else x.reshape(-1, x.shape[-1])
        if self._asked < _PAYS:
            self._asked += 1 + len(flat) / 200
            return self._function(x)
        if self._program is None or self._changed():
            self._remember()
            self._program = Program(
                lambda carry, now, row: (carry, self._function(row)), name=self._name, copies=1
            )
        y: Tensor = self._program((), (), flat, steps=1)[1][:, 0]
        return y if x.dim() == 2 else y.reshape(*x.shape[:-1], y.shape[-1])

    def _changed(self) -> bool:
        now = list(map(id, chain.from_iterable(map(dict.values, self._settings))))
        return not self._settings or now != self._signature or self._versions != self._version_list()

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
        self._seen = list(chain.from_iterable(map(dict.values, self._settings)))  # no address is used twice
        self._signature = list(map(id, self._seen))
        self._tensors = [part for part in self._seen if isinstance(part, Tensor)]
        self._versions = self._version_list()
