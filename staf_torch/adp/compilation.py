"""The step of a closed loop, compiled where that pays."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from .closed_loop import ClosedLoop, LoopState

_log = logging.getLogger(__name__)
_PAYS = 60_000  # uncompiled steps of a small batch (some 1 ms each) that take as long as to compile twice
_ONE_THREAD = 4096  # rows up to which one thread is enough

Options = dict[str, str | int | bool | Callable[..., object]]
Step = Callable[[LoopState, Tensor], tuple[LoopState, Tensor]]


def compiled(loop: ClosedLoop, x0: Tensor, steps: int, wanted: bool | str) -> Step:
    """``loop``, or the same compiled by `torch.compile`.

    The compiler needs 10 to 40 s the first time (a C++ compiler runs), then about a second from its cache.
    What it cannot do (a user's plant with Python control flow, a kernel without a closed form) stays
    uncompiled.

    Args:
        loop: one step.
        x0: rows to try it on, (B, n).
        steps: of the run.
        wanted: True, False or ``auto``.
    """
    if wanted is False or (wanted == "auto" and steps * (1 + x0.shape[0] / 200) < _PAYS):
        return loop
    state = loop.init(x0)
    uniform = x0.new_zeros(x0.shape[0], loop.controller.draws, x0.shape[1])
    refused: Exception | None = None
    for options in _options(x0):
        step: Step = torch.compile(loop, dynamic=False, fullgraph=True, options=options)
        try:
            step(state, uniform)
            return step
        except Exception as error:  # the compiler raises errors of many kinds, none of them the run's
            refused = error
    reason = (str(refused) or type(refused).__name__).splitlines()[0]
    _log.warning("the closed loop runs uncompiled: %s", reason)
    return loop


def _options(x0: Tensor) -> Iterator[Options]:
    """What the compiler is asked for, the fastest first."""
    # A step is less than a millisecond's work: threads would spend it waiting for each other.
    alone = x0.device.type == "cpu" and x0.shape[0] <= _ONE_THREAD
    options: Options = {"cpp.threads": 1} if alone else {}
    if x0.device.type == "cpu":
        yield options | {"cpp_wrapper": True}  # a call costs half as much when no Python runs between kernels
    yield options
