"""Old module names, understood for one release: by imports, `_target_` and pickles."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Sequence
from typing import Any

RENAMED = {
    "adp.compilation": "adp.closed_loop",
    "adp.controller": "adp.controllers",
    "adp.identifying": "adp.identification",
    "adp.lqr": "adp.controllers",
    "adp.supervisor": "adp.controllers",
    "adp_metrics": "metrics.closed_loop",
    "ball_floor": "metrics.ball_error",
    "basis": "approximation.basis",
    "centers.radius": "centers.state_following",
    "chase": "engine",
    "diagnostics": "approximation.conditioning",
    "envs.agent": "envs.episodes",
    "experiments.app": "cli.staf",
    "experiments.build": "settings.chase",
    "experiments.build_adp": "settings.adp",
    "experiments.build_theory": "settings.chase",
    "experiments.export": "cli.export",
    "linalg": "numerics.linalg",
    "local": "local_basis",
    "local_errors": "metrics.ball_error",
    "memory": "online.experience_memory",
    "module": "approximation.staf",
    "objective": "optim.objective",
    "report": "tables",
    "report.latex": "tables.model",
    "report.plots": "figures.style",
    "report.trackers": "sweeps.callbacks",
    "riccati": "numerics.linalg",
    "sensitivity": "approximation.sensitivity",
    "streams": "online",
    "theory.construction": "theory.exponential_bound",
}
"""Old name -> new name of modules, both within staf_torch; submodules go with their package."""


def new_name(name: str) -> str | None:
    """Return today's name of the module that was called ``name``; None where nothing changed."""
    package, _, inner = name.partition(".")
    if package != __package__:
        return None
    parts = inner.split(".")
    for length in range(len(parts), 0, -1):  # the longest name that the table knows
        known = RENAMED.get(".".join(parts[:length]))
        if known is not None:
            return ".".join([package, known, *parts[length:]])
    return None


class RenamedModule(types.ModuleType):
    """A module under its old name: every attribute is looked up in the module of the new name."""

    def __init__(self, name: str, target: types.ModuleType) -> None:
        super().__init__(name, target.__doc__)
        self.__dict__["_target"] = target
        self.__path__: list[str] = []  # submodules come through the finder too, and are never loaded twice

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["_target"], name)

    def __dir__(self) -> list[str]:
        return dir(self.__dict__["_target"])

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the function that has the module's old name: `staf_torch.chase` is both."""
        own = self.__name__.rpartition(".")[2]
        return getattr(self.__dict__["_target"], own)(*arguments, **keywords)


class RenamedFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Import hook for old module names; asked last, so that it never hides a module that exists."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for an old name, None for any other."""
        if new_name(fullname) is None:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        """Import the module of the new name and wrap it, with a warning that names it.

        Raises:
            ModuleNotFoundError: if the new package has no such submodule.
        """
        new = new_name(spec.name)
        assert new is not None
        wrapped = importlib.import_module(new)
        warnings.warn(
            f"`{spec.name}` is now `{new}`; the old name goes with the next release.",
            FutureWarning,
            stacklevel=2,
        )
        return RenamedModule(spec.name, wrapped)

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing more: the wrapped module has been executed under its new name."""


def install() -> None:
    """Make imports of old names work in this process."""
    if not any(isinstance(finder, RenamedFinder) for finder in sys.meta_path):
        sys.meta_path.append(RenamedFinder())
