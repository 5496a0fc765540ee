"""Whether tensors are still what they were: written to, or given other memory."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import torch
from torch import Tensor

from ..row_numbers import all_rows

_VERSION = operator.attrgetter("_version")


def version(tensor: Tensor) -> int:
    """Return a number that is another one once the tensor was written to.

    Torch counts writes, but not those to tensors made in inference mode: of these it is the content.
    """
    tensor = all_rows(tensor)
    return hash(tensor.numpy(force=True).tobytes()) if tensor.is_inference() else tensor._version


class Writes:
    """How tensors are now, to be compared later.

    Torch counts writes to a tensor, but not that ``tensor.data = other`` gives it other memory, as
    `torch.nn.utils.vector_to_parameters` does. Writes into ``tensor.data`` itself nobody can see.

    Args:
        tensors: numbers of rows among them.
    """

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        every = [*map(all_rows, tensors)]
        self._counted = [tensor for tensor in every if not tensor.is_inference()]
        self._compared = [tensor for tensor in every if tensor.is_inference()]
        self._placed = [tensor for tensor in self._counted if _has_memory(tensor)]
        # Kept, so that other memory cannot come to lie at the same address meanwhile.
        self._memory = [tensor.untyped_storage() for tensor in self._placed]
        self._then = self._now()

    def again(self) -> Writes:
        """Return how the same tensors are now."""
        return Writes((*self._counted, *self._compared))

    def none(self) -> bool:
        """Return whether nothing was written since."""
        return self._now() == self._then

    def _now(self) -> list[int]:
        now = [*map(_VERSION, self._counted), *map(Tensor.data_ptr, self._placed)]
        return [*now, *map(version, self._compared)] if self._compared else now


def _has_memory(tensor: Tensor) -> bool:
    """Return whether a tensor lies somewhere: sparse ones, those of a transform or a fake mode do not."""
    if tensor.layout is not torch.strided or tensor.is_nested or tensor.is_meta:
        return False
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:
        return False
