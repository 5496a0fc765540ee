"""Nested tuples, lists, dictionaries and named tuples of tensors as flat lists, and back."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from typing import Any

from torch import Tensor

Tree = Any
"""Nested tuples, lists, dictionaries or named tuples of tensors."""


def flatten(tree: Any) -> tuple[list[Any], Hashable]:
    """The tensors of a tree, and what is needed to build the tree again from others.

    Anything that is neither a container nor a tensor (None, numbers) is part of the structure.
    """
    leaves: list[Any] = []
    return leaves, _structure(tree, leaves)


def unflatten(structure: Any, leaves: Iterator[Any]) -> Any:
    """The tree of a structure with these leaves."""
    kind, parts = structure
    if kind == "leaf":
        return next(leaves)
    if kind == "fixed":
        return parts
    if isinstance(kind, tuple):
        return {name: unflatten(part, leaves) for name, part in zip(kind, parts, strict=True)}
    values = [next(leaves) if part is _LEAF else unflatten(part, leaves) for part in parts]
    if kind is tuple:
        return tuple(values)
    return kind(*values) if hasattr(kind, "_fields") else kind(values)


def mapped(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """The tree of function(leaf, ...): of every leaf, and of those of other trees in its place."""
    leaves, structure = flatten(tree)
    columns = leaves, *(flatten(other)[0] for other in others)
    return unflatten(structure, iter([function(*each) for each in zip(*columns, strict=True)]))


def _structure(tree: Any, leaves: list[Any]) -> Hashable:
    kind = type(tree)
    if kind is Tensor or kind is Shared:  # first what there is most of
        leaves.append(tree)
        return _LEAF
    if kind is tuple:
        if not tree:
            return _EMPTY
        parts: list[Hashable] = []
        for part in tree:
            if type(part) is Tensor:
                leaves.append(part)
                parts.append(_LEAF)
            else:
                parts.append(_structure(part, leaves))
        return kind, tuple(parts)
    if isinstance(tree, dict):
        return tuple(tree), tuple(_structure(part, leaves) for part in tree.values())
    if isinstance(tree, list | tuple):
        return kind, tuple(_structure(part, leaves) for part in tree)
    if isinstance(tree, Tensor):
        leaves.append(tree)
        return _LEAF
    return "fixed", tree


_LEAF, _EMPTY = ("leaf", None), (tuple, ())


class Shared:
    """A tensor without the dimension of rows: one for all rows.

    Example:
        >>> Shared(torch.ones(2)).tensor
        tensor([1., 1.])

        Shown by `staf experiment=adp`.

    Args:
        tensor: (...), or (T, ...) among the inputs of every time.
    """

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor


def labels(structure: Any, prefix: str) -> list[str]:
    """A name for every leaf of a structure: its keys and fields, numbers where there are none."""
    kind, parts = structure
    if kind == "leaf":
        return [prefix]
    if kind == "fixed":
        return []
    named = kind if isinstance(kind, tuple) else getattr(kind, "_fields", None)
    if named is None:
        named = [f"{prefix}{k}" for k in range(len(parts))]
    elif prefix not in _ROOTS:
        named = [f"{prefix}_{name}" for name in named]
    return [label for name, part in zip(named, parts, strict=True) for label in labels(part, str(name))]


_ROOTS = ("row", "now", "carry", "out")


def plain(leaf: Any) -> Tensor:
    """The tensor of a leaf, shared or not."""
    tensor: Tensor = leaf.tensor if type(leaf) is Shared else leaf
    return tensor


def moved(tree: Any, device: str) -> Any:
    """The tree with its tensors on a device."""
    return mapped(lambda x: Shared(x.tensor.to(device)) if isinstance(x, Shared) else x.to(device), tree)
