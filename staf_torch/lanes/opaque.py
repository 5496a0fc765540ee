"""Calls that compile themselves, or run in C++, under `torch.compile`: it leaves them alone."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import CodeType
from typing import Any, ParamSpec, TypeVar

import torch._C._dynamo.eval_frame as frames

_P = ParamSpec("_P")
_R = TypeVar("_R")


def opaque(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function that `torch.compile` neither traces nor enters, as by `torch.compiler.disable`.

    To trace a loop that `lanes` compiles takes minutes, and what comes out is hundreds of times slower. The
    decorator of torch imports its compiler, which takes a second; this one does not.
    """
    set_frames = frames.set_eval_frame

    @functools.wraps(function)
    def alone(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = set_frames(None)
        try:
            return function(*args, **kwargs)
        finally:
            set_frames(before)

    marked: Any = alone
    _skipped(marked.__code__)
    marked._torchdynamo_disable, marked._torchdynamo_disable_recursive = True, True
    marked._torchdynamo_disable_msg = "it compiles itself"
    return alone


def _skipped(code: CodeType) -> None:
    """Have torch run frames of a code as they stand."""
    if hasattr(frames, "skip_code"):  # up to 2.6
        frames.skip_code(code)
    else:
        actions = frames._FrameAction
        frames.set_code_exec_strategy(code, frames._FrameExecStrategy(actions.SKIP, actions.DEFAULT))
