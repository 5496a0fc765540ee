"""Named tuples of tensors as one flat row, which is what a controller carries."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ...lanes.tree import flatten, unflatten

Tree = Any
"""A tensor, or a named tuple of trees, as in `lanes.tree`."""


def pack(tree: Tree, lead: int) -> Tensor:
    """All tensors of a tree behind each other: (..., *shape) each -> (..., K).

    Args:
        tree: of tensors with the same leading dimensions.
        lead: how many dimensions lead.
    """
    leaves, _ = flatten(tree)
    return torch.cat([leaf.flatten(lead) if leaf.dim() > lead else leaf[..., None] for leaf in leaves], -1)


def unpack(like: Tree, flat: Tensor, lead: int) -> Tree:
    """The tree that was packed: (..., K) -> tensors (..., *shape).

    Args:
        like: a tree of the same shapes, with any leading dimensions.
        flat: (..., K).
        lead: how many dimensions lead in ``like``.
    """
    leaves, structure = flatten(like)
    shapes = [leaf.shape[lead:] for leaf in leaves]
    pieces = flat.split([math.prod(shape) for shape in shapes], dim=-1)
    found = [piece.reshape(*flat.shape[:-1], *shape) for piece, shape in zip(pieces, shapes, strict=True)]
    return unflatten(structure, iter(found))
