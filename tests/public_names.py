"""The public names: `staf_torch.__all__`, three functions that import Hydra, and `__all__` of packages."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

import torch

import staf_torch

PACKAGES = [
    *("adp", "centers", "deploy", "engine", "envs", "kernels", "lanes", "metrics", "online", "optim"),
    *("systems", "tables", "targets", "theory"),
]
API = ("read_runs", "run", "sweep")  # not in `__all__`: they import Hydra


def public() -> dict[str, tuple[object, dict[str, Any]]]:
    """Module and name -> the class or function, and the names that its example may use."""
    top = {name: getattr(staf_torch, name) for name in (*staf_torch.__all__, *API)}
    common = {"torch": torch, "Path": Path} | top
    common |= {name: getattr(staf_torch, name) for name in PACKAGES}
    found: dict[str, tuple[object, dict[str, Any]]] = {}
    for package in ("", *PACKAGES):
        module = importlib.import_module(f"staf_torch.{package}".rstrip("."))
        own = top if package == "" else {name: getattr(module, name) for name in module.__all__}
        for thing in own.values():
            if inspect.isclass(thing) or inspect.isfunction(thing):
                found.setdefault(f"{thing.__module__}.{thing.__name__}", (thing, common | own))
    return found
