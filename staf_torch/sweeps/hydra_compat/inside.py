"""All that is taken from the inside of Hydra: its search path, its parser of a command line, its trust."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import logging.config
import os
from collections.abc import Callable, Iterable
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.plugins import Plugins
from hydra.core.utils import configure_log
from hydra.errors import SearchPathException
from omegaconf import OmegaConf

from ...settings import config_directory

HAS_WHITELIST = "execution_whitelist" in inspect.signature(hydra.main).parameters
"""Hydra 1.4: only trusted targets are instantiated. That version also ends sweeps that failed by itself."""
if HAS_WHITELIST:
    import hydra._internal.execution_policy as execution_policy

TRUSTED = ("staf_torch.*",)
_configure: Callable[[dict[str, Any]], None] = logging.config.dictConfig
with contextlib.suppress(ImportError):  # of the latest versions
    from hydra._internal.logging_config import configure_logging as _configure


def configure_logging(log: dict[str, Any] | None, verbose: Any) -> None:
    """Set up logging as `hydra.core.utils.configure_log` does, from settings that are plain and resolved."""
    if log is None or verbose is not False:
        given: Any = None if log is None else OmegaConf.create(log)  # which Hydra takes, and does not say
        configure_log(given, verbose)
    elif log["root"] is not None:
        _configure(log)


def arguments(argv: Iterable[str]) -> argparse.Namespace:
    """Return the words of a command line as Hydra reads them; ``unknown`` are those that it does not know."""
    words, unknown = get_args_parser().parse_known_args(list(argv))
    words.unknown = unknown
    return words


def config_loader(folder: str | None = None) -> ConfigLoader:
    """Return Hydra's loader for `conf/`, and for the ``folder`` of `--config-dir`.

    Raises:
        hydra.errors.SearchPathException: if there is no such folder.
    """
    Plugins.instance()  # the sources of configurations are plugins
    searched = create_config_search_path(config_directory())
    if folder is not None:
        if not os.path.isdir(folder):
            raise SearchPathException(f"Additional config directory '{os.path.abspath(folder)}' not found")
        place = f"file://{os.path.abspath(folder)}"
        searched.prepend("command-line", place, SearchPathQuery(provider="schema"))
    return ConfigLoaderImpl(searched)


def trusted(packages: Iterable[str] = ()) -> contextlib.AbstractContextManager[object]:
    """Let settings name objects of this package and of ``packages``: Hydra 1.4 trusts nothing by itself."""
    return _trusting((*TRUSTED, *(f"{name}.*" for name in packages)))


def everything_trusted() -> contextlib.AbstractContextManager[object]:
    """Let settings name any object, as Hydra 1.3 does, where a user has asked for trust."""
    return _trusting(execution_policy.UNSAFE_DISABLE_EXECUTION_CHECKS if HAS_WHITELIST else None)


def _trusting(patterns: object) -> contextlib.AbstractContextManager[object]:
    if not HAS_WHITELIST:
        return contextlib.nullcontext()
    found: contextlib.AbstractContextManager[object] = execution_policy.execution_whitelist(patterns)
    return found


def trusted_packages() -> list[str]:
    """Return the packages that settings may name at present, beside this one; workers get them."""
    active = execution_policy._get_active_execution_whitelist() if HAS_WHITELIST else None
    return [pattern.removesuffix(".*") for pattern in active or () if pattern not in TRUSTED]
