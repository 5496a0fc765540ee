"""`staf_torch.conf` in a checkout and an editable install, where the folder `conf/` lies beside the package.

A wheel has it inside. Other people's Hydra applications name it as `pkg://staf_torch.conf`.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from collections.abc import Sequence
from pathlib import Path

_NAME = f"{__package__}.conf"
_FOLDER = Path(__file__).resolve().parent.parent / "conf"


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads nothing but a place: no `__pycache__` appears among the settings."""

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: the module is a folder of YAML files."""


class SettingsFinder(importlib.abc.MetaPathFinder):
    """Finds `staf_torch.conf` beside the package; asked after every other finder."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for `staf_torch.conf`, None for any other name."""
        place = _FOLDER / "__init__.py"
        if fullname != _NAME or not place.is_file():
            return None
        return importlib.util.spec_from_file_location(
            fullname, place, loader=_Loader(fullname, str(place)), submodule_search_locations=[str(_FOLDER)]
        )


def install() -> None:
    """Make `staf_torch.conf` importable in this process."""
    if not any(isinstance(finder, SettingsFinder) for finder in sys.meta_path):
        sys.meta_path.append(SettingsFinder())
