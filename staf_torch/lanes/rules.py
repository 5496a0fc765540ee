"""The rules of tensor operations in single numbers, by the names of the operations."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch

from .graph import Ids
from .tracer import Tracer

Rule = Callable[..., Any]
RULES: dict[str, Rule] = {}


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Decorator: a function of (tracer, what torch returned, arguments) is the rule of these operations."""

    def register(rule: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, rule))
        return rule

    return register


def common(t: Tracer, *values: Any) -> str:
    """The type in which torch computes with these together."""
    given = [v for v in values if v is not None]
    dtype = functools.reduce(torch.promote_types, [torch.result_type(v, w) for v in given for w in given])
    return t.kind(dtype)


def numbers(t: Tracer, kind: str, *values: Any) -> list[Ids]:
    """The nodes of tensors and numbers, as one type."""
    return [t.nodes(value, kind) for value in values]
