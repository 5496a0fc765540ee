"""Calls that compile themselves, or run in C++, under `torch.compile`: it leaves them alone."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import torch._C._dynamo.eval_frame as frames

from .graph_operator import spelled

_P = ParamSpec("_P")
_R = TypeVar("_R")


def opaque(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function that `torch.compile` neither traces nor enters, as by `torch.compiler.disable`.

    To trace a loop that `lanes` compiles takes minutes, and what comes out is hundreds of times slower. The
    decorator of torch imports its compiler, which takes a second; this one does not.
    """
    if not hasattr(frames, "set_code_exec_strategy"):  # torch 2.6
        return _alone(function)
    _marked(function)
    actions = frames._FrameAction
    frames.set_code_exec_strategy(function.__code__, frames._FrameExecStrategy(actions.SKIP, actions.SKIP))
    return function


def one_operator(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function that is one operator in a graph of `torch.compile`, and else as by `opaque`.

    Calls elsewhere are those of the function itself.
    """
    made: Any = opaque(function)
    for name in [name for name in vars(made) if name.startswith("_torchdynamo_disable")]:
        delattr(made, name)
    made._torchdynamo_inline = spelled(function)
    if "." in function.__qualname__:
        return cast("Callable[_P, _R]", made)

    @functools.wraps(function)  # which copies attributes: that of a function a user's wrapper would have, too
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        result: _R = made(*args, **kwargs)
        return result

    vars(called).pop("_torchdynamo_inline", None)
    return called


def _alone(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that sees to it by itself that nobody compiles what it calls."""
    set_frames = frames.set_eval_frame

    @functools.wraps(function)
    def alone(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = set_frames(None)
        try:
            return function(*args, **kwargs)
        finally:
            set_frames(before)

    frames.skip_code(alone.__code__)  # type: ignore[attr-defined]
    _marked(alone)
    return alone


def _marked(function: Any) -> None:
    """Have torch call a function in place of looking into it."""
    function._torchdynamo_disable, function._torchdynamo_disable_recursive = True, True
    function._torchdynamo_disable_msg = "it compiles itself"
