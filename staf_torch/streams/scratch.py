"""Memory for the temporaries of a step."""

from __future__ import annotations

import torch
from torch import Tensor


class Scratch:
    """Temporaries by name, kept from one step to the next: fresh pages cost more than the arithmetic on them.

    What is in them is never read again: copies and pickles start empty.
    """

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def __call__(self, name: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """An uninitialised tensor of the shape, valid until the name is asked for again."""
        size = torch.Size(shape).numel()
        held = self._held.get(name)
        if held is None or len(held) < size or held.dtype != like.dtype or held.device != like.device:
            held = self._held[name] = like.new_empty(size + size // 4)
        return held[:size].view(shape)

    def __reduce__(self) -> tuple[type[Scratch], tuple[()]]:
        return Scratch, ()
