"""The choice between compiled code and plain torch, `compiling`, which overrides it, and what the log says.

A loop that is long, or whose step is, shall be compiled; a clock would choose otherwise on a busy machine,
and compiled and plain numbers differ in their last digits. So the operations of torch are counted while the
first step runs (`PlainTime`), and the entries that they make: 5 us each and 2.5 ns, three times that for each
derivative or `vmap` around them, is the time within a factor of two from one state to ten thousand. A
compiler takes 1.5 s and 50 us an operation. What is in the cache already is not asked for: the second run of
a script would otherwise differ from its first.

Calls that are each too short to be compiled stay in plain torch, the hundredth as the first was, so that
equal calls have equal bits. What that has cost, and what to write, is one line of the log (`ShortCall`).
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Hashable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from . import inputs

_log = logging.getLogger(__name__)
_log_of_programs = logging.getLogger(f"{__package__.rpartition('.')[0]}.program")
WHEN = ("auto", "always", "never")
_when = "auto"


@contextlib.contextmanager
def compiling(when: str) -> Iterator[None]:
    """Override, within the block, the automatic choice between compiled code and plain torch.

    Chases, trajectories, closed loops (``compile="auto"``) and policies compile by themselves where a call is
    long enough to pay for the compiler; loops on a device always do. A timed control loop wants ``"always"``,
    a debugger ``"never"``. An explicit ``compile=True`` or ``False``, and a `Program` that is called
    directly, are not affected.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> with lanes.compiling("never"):
        ...     states = systems.simulate(systems.VanDerPol(), x0, dt=0.01, steps=1000)

        Shown by `staf_torch/lanes/README.md`.

    Args:
        when: ``auto``, ``always`` (where it is possible at all) or ``never``; of the whole process.

    Raises:
        ValueError: for another word.
    """
    global _when
    if when not in WHEN:
        raise ValueError(f"`compiling(when=...)` must be one of {', '.join(WHEN)}; got {when!r}.")
    before, _when = _when, when
    try:
        yield
    finally:
        _when = before


def undecided(compile: bool | str = "auto", states: Tensor | None = None) -> bool:
    """Return whether a caller, and `compiling`, leave the choice to the library; on the meta device there is
    none."""
    return compile == "auto" and _when == "auto" and not (states is not None and states.is_meta)


def worth(pays: bool, states: Tensor | None = None) -> bool:
    """Return whether an automatic choice falls on compiled code.

    A loop of ``states`` on a device always pays: plain torch there waits for a launch at every operation,
    some hundred times as long as the operation takes. On the meta device nothing takes time.
    """
    if states is not None and states.is_meta:
        return False
    if _when != "auto":
        return _when == "always"
    return pays or (states is not None and runs_kernels(states))


def runs_kernels(x: Tensor) -> bool:
    """Return whether a tensor is where programs run as kernels: on a CUDA device, or on `device.host`."""
    return x.is_cuda or (x.is_cpu and inputs.processor is not True)


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

    Of one step of a loop it raises RepaysError as soon as all ``times`` are known to take `GAIN` times as
    long as a compiler.
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


_TOGETHER = 3.0  # s, in which most loops are compiled twice
_spent: dict[Hashable, tuple[int, float]] = {}  # calls of a kind, and s that they took; inf once it was said


class ShortCall:
    """Context of a call that `auto` leaves in plain torch as it is short."""

    def __init__(self, name: str, kind: Hashable, remedy: str = "") -> None:
        self._name, self._kind, self._remedy = name, (name, kind), remedy
        self._began = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self.count(time.perf_counter() - self._began)

    def count(self, seconds: float, calls: int = 1) -> None:
        """Count calls and what they took, and log the sum once it is large."""
        before, spent = _spent.get(self._kind, (0, 0.0))
        calls, spent = before + calls, spent + seconds
        late = _TOGETHER <= spent < math.inf and calls > 1
        _spent[self._kind] = calls, math.inf if late else spent
        if late:
            _log.warning(
                "%s: %d calls took %.1f s in plain torch, %.0f ms each: each is too short to be compiled, "
                'and equal calls keep equal bits. %s`with lanes.compiling("always"):` around them compiles '
                "them, once, in about two seconds; the numbers then differ by some 1e-12. Said once.",
                *(self._name, calls, spent, 1e3 * spent / calls, self._remedy and f"{self._remedy} or "),
            )


_said: set[tuple[str, str]] = set()  # what has been logged


def say(name: str, reason: str, kind: str | None = None) -> None:
    """Log why a program runs in plain torch, once for a reason or a kind of reasons."""
    reason = " ".join(reason.split())[:600]
    told = name, reason if kind is None else kind
    if told not in _said:
        _said.add(told)
        _log_of_programs.warning("%s runs in plain torch, slower: %s", name, reason)


def say_transformed(name: str) -> None:
    """Log once that a transform keeps a program in plain torch, where one looks and nobody traces."""
    if inputs.transformed() and not torch._C._len_torch_dispatch_stack():
        say(name, "a transform of `torch.func` (vmap, jacrev, grad, ...) or forward mode is active")
