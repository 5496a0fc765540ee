"""When loops and policies that choose by themselves are compiled."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

CHOICES = ("auto", "always", "never")
_when = "auto"


@contextlib.contextmanager
def compiling(when: str) -> Iterator[None]:
    """Override, within the block, the automatic choice between compiled code and plain torch.

    Chases, trajectories, closed loops (``compile="auto"``) and policies compile by themselves where a call is
    long enough to pay for the compiler. A timed control loop wants ``"always"``, a debugger ``"never"``. An
    explicit ``compile=True`` or ``False``, and a `Program` that is called directly, are not affected.

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
    if when not in CHOICES:
        raise ValueError(f"`compiling(when=...)` must be one of {', '.join(CHOICES)}; got {when!r}.")
    before, _when = _when, when
    try:
        yield
    finally:
        _when = before


def worth(pays: bool) -> bool:
    """Whether an automatic choice falls on compiled code.

    Args:
        pays: whether the call is long enough to pay for the compiler.
    """
    return pays if _when == "auto" else _when == "always"
