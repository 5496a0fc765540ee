"""The automatic choice between compiled code and plain torch, and `compiling`, which overrides it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from torch import Tensor

from ..calls import planned_call as call

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

    Args:
        pays: whether a call pays for a compiler on the processor.
        states: of a loop, which on a device always pays: plain torch there waits for a launch at every
            operation, some hundred times as long as the operation takes; on the meta device nothing takes
            time.
    """
    if states is not None and states.is_meta:
        return False
    if _when != "auto":
        return _when == "always"
    return pays or (states is not None and runs_kernels(states))


def runs_kernels(x: Tensor) -> bool:
    """Return whether a tensor is where programs run as kernels: on a CUDA device, or on `device.host`."""
    return x.is_cuda or (x.is_cpu and call.processor is not True)
