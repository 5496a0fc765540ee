"""Time of a function in plain torch, and whether a compiler repays: by its operations, and so always alike.

A loop that is long, or whose step is, shall be compiled; a clock would choose otherwise on a busy machine,
and compiled and plain numbers differ in their last digits. So the operations of torch are counted while the
first step runs, and the entries that they make: 5 us each and 2.5 ns, three times that for each derivative or
`vmap` around them, is the time within a factor of two from one state to ten thousand. A compiler takes 1.5 s
and 50 us an operation. What is in the cache already is not asked for: the second run of a script would
otherwise differ from its first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_OPERATION, _ENTRY = 5e-6, 2.5e-9  # s
_TRANSFORMED = 3  # operations more that one takes for each transform of torch.func around it
GAIN = 2.0
"""Builds that a loop must take in plain torch before it is compiled."""
DIFFERENTIATED = 100
"""Times that a loop counts of which a gradient is wanted: four passes each, and who asks asks again."""
_OFTEN = 256  # operations after which it is asked
_BUILD, _BUILT_OPERATION = 1.5, 5e-5  # s


class RepaysError(Exception):
    """A loop takes longer in plain torch than a compiler."""


class PlainTime(TorchFunctionMode):
    """Context: counts the operations of torch inside of it.

    Args:
        times: of a loop of which this is one step, to be broken off where all of them repay a compiler; 0
            for none.

    Attributes:
        operations: their number, more for those inside of a transform of torch.func.
        entries: that they made.

    Raises:
        RepaysError: as soon as the loop is known to take `GAIN` times as long as a compiler.
    """

    def __init__(self, times: int = 0) -> None:
        super().__init__()
        self.operations, self.entries, self._times, self._asked = 0, 0, times, 0

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        made = (out,) if isinstance(out, Tensor) else out if type(out) in (tuple, list) else ()
        if made:
            stack = torch._C._functorch.peek_interpreter_stack()
            self.operations += 1 if stack is None else 1 + _TRANSFORMED * stack.level()
            self.entries += sum([part.numel() for part in made if isinstance(part, Tensor)])
            if self.operations >= self._asked + _OFTEN:
                self._asked = self.operations
                self.refuse()
        return out

    def refuse(self) -> None:
        """Raise RepaysError if the loop takes longer than a compiler."""
        if self._times * self.seconds() >= GAIN * self.build:
            raise RepaysError

    def seconds(self, share: float = 1.0) -> float:
        """Return the time in plain torch, with ``share`` times as many entries."""
        return _OPERATION * self.operations + _ENTRY * share * self.entries

    @property
    def build(self) -> float:
        """Seconds that a compiler takes for as many operations."""
        return _BUILD + _BUILT_OPERATION * self.operations
