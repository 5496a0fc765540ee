"""What every test starts from. torch is imported where tests run, and not by a process that starts others."""

from __future__ import annotations

import os

# One thread a process: small tensors gain nothing from two, and beside any other program the barriers
# between threads cost tenfold. Before torch is imported, and inherited by the commands that tests run.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
import logging
import random
import shutil
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from absent_extras import pytest_make_collect_report, pytest_runtest_makereport

if TYPE_CHECKING:
    from recorded import Record

__all__ = ["pytest_make_collect_report", "pytest_runtest_makereport"]

TESTS = Path(__file__).parent
COMPILED = {"adp", "deploy", "envs", "lanes", "online", "systems"}
"""Rooms whose tests leave the choice to compile to the library."""

LINKER = "-fuse-ld=gold" if shutil.which("ld.gold") else ""
QUICK = f"{LINKER} -fno-asynchronous-unwind-tables -O0"
"""Options by which programs are built in a third of the time; no number of a program depends on them."""
OWN = os.environ.get("CXXFLAGS", "")
os.environ["CXXFLAGS"] = f"{OWN} {QUICK}"

OPTIMISED = {"engine", "lanes", "online"}
AS_FOR_USERS = (
    *("have_the_same_bits", "has_the_same_bits", "the_bits_that", "change_bits", "continue_to_the_bit"),
    *("test_compiled_is_the_definition", "compiled_filter_is_its", "within_their_bounds"),
)
"""Tests of those rooms, by parts of their names, whose programs are built as users have them: bits of rows
beside others or rounding are the matter. A filter of streams then takes 8 s to build, and 1 s otherwise."""

logging.getLogger("staf_torch.lanes.calls.choice").setLevel("ERROR")  # the suite is many short calls


def pytest_addoption(parser: pytest.Parser) -> None:
    """An order of the tests by chance: folders, files and the tests of a file; numbers recorded anew."""
    parser.addoption("--order", type=int, default=None, metavar="SEED", help="shuffle the tests by a seed")
    parser.addoption("--record", action="store_true", help="write what `recorded.py` holds anew")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Two processes where there are two cores and whole folders are asked for; `-n` says otherwise."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        return  # a worker of pytest-xdist, which calls this too, starts none of its own: they would never end
    option = config.option
    if getattr(option, "numprocesses", 0) is not None:
        return  # as the command line says; without pytest-xdist there is no such option
    folders = any(Path(each.partition("::")[0]).is_dir() for each in config.args)
    alone = option.usepdb or option.collectonly or option.record or option.capture == "no"
    alone = alone or getattr(option, "cov_source", None)  # pytest-cov has chosen how it collects by now
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if folders and not alone and cores > 1:
        option.numprocesses, option.dist = 2, "worksteal"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Shuffle, but leave files in one piece: what the tests of a file share is made once."""
    seed = config.getoption("--order")
    if seed is not None:
        rank = {path: random.Random(f"{seed} {path}").random() for path in {item.path for item in items}}
        own = {item.nodeid: random.Random(f"{seed} {item.nodeid}").random() for item in items}
        items.sort(key=lambda item: (rank[item.path], own[item.nodeid]))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what is about compiled programs where nothing can be compiled."""
    if item.get_closest_marker("needs_compiler") is not None:
        from staf_torch.lanes.compilation import compiler

        if not compiler.compiler():
            pytest.skip("needs a C++ compiler")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Say how examples of `hypothesis` are drawn, before any are collected."""
    if getattr(session.config.option, "numprocesses", None) and "PYTEST_XDIST_WORKER" not in os.environ:
        return  # others run the tests
    import hypothesis

    hypothesis.settings.register_profile("suite", max_examples=25, deadline=None, derandomize=True)
    hypothesis.settings.load_profile("suite")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect tests without looking for garbage, a quarter of that time: all of them stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()  # nor is what was there before looked through again
        gc.enable()
        gc.set_threshold(10_000, 20, 20)  # a twelfth of the time of sweeps was looking for garbage


@pytest.fixture(autouse=True, scope="session")
def _settings_are_trusted_as_by_the_command() -> Iterator[None]:
    """Hydra 1.4 builds only what a program trusts: here the package, and what tests define.

    It also reads `conf/` anew for each of some hundred commands, faster by the parser in C.
    """
    import yaml

    from staf_torch.sweeps.hydra_compat import trusted

    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger) and logger.name.startswith("torch"):
            # Else pytest adds its handlers to each of fifty and takes them off again, six times a test.
            logger.propagate = True
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    with trusted(path.stem for path in Path(__file__).parent.rglob("*.py")):
        yield


@pytest.fixture(autouse=True, scope="session")
def _figures_are_finished_in_their_own_room() -> Iterator[None]:
    """Where panels lie, and what a PDF holds, take three quarters of a figure's time; forks inherit this."""
    figures, layouts = (sys.modules.get(f"matplotlib.{name}") for name in ("figure", "layout_engine"))
    with pytest.MonkeyPatch.context() as patch:
        if figures is not None and layouts is not None:
            laid_out, saved = layouts.ConstrainedLayoutEngine.execute, figures.Figure.savefig

            def at_home() -> bool:
                return os.environ.get("PYTEST_CURRENT_TEST", "").startswith("tests/figures")

            def execute(engine: object, figure: object) -> None:
                if at_home():
                    laid_out(engine, figure)

            def savefig(figure: object, file: Any, **given: Any) -> None:
                if given.get("format") == "pdf" and not at_home():
                    file.write(b"%PDF-1.4 not rendered")
                else:
                    saved(figure, file, **given)

            patch.setattr(layouts.ConstrainedLayoutEngine, "execute", execute)
            patch.setattr(figures.Figure, "savefig", savefig)
        yield


@pytest.fixture(autouse=True)
def _alike_in_every_order(
    request: pytest.FixtureRequest, quick_cc: Path | None, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Random numbers, the log, Hydra's variable, what is compiled and how: one fixture, as each takes time.

    Nothing compiles by itself but in the rooms of `COMPILED` and where a test is marked `compiled`: a build
    is a second a program.
    """
    import torch

    from staf_torch import lanes

    # `torch.manual_seed` also writes down, for every kind of device and with the stack, what is to be done
    # when it begins to be used: a third of what pytest itself takes of a test, and a list that grows.
    torch.default_generator.manual_seed(0)
    if logging.root.level != logging.WARNING:  # a command that a test ran in this process has set it
        logging.root.setLevel(logging.WARNING)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)  # `main` sets it for Hydra
    room = request.path.relative_to(TESTS).parts[0]
    if room in OPTIMISED and any(words in request.node.name for words in AS_FOR_USERS):
        monkeypatch.setenv("CXXFLAGS", OWN)
    if room in ("adp", "deploy") and quick_cc is not None:
        monkeypatch.setenv("CC", str(quick_cc))
    compiled = room in COMPILED or request.node.get_closest_marker("compiled") is not None
    with lanes.compiling("auto" if compiled else "never"):
        yield


@pytest.fixture(scope="session")
def quick_cc(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """The C compiler, by `QUICK`."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "g++", "clang"))), None)
    if compiler is None:
        return None
    path = Path(tmp_path_factory.mktemp("compiler") / "quick-cc")
    path.write_text(f'#!/bin/sh\nexec {compiler} "$@" {QUICK}\n')
    path.chmod(0o755)
    return path


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Record:
    """Compares with what is recorded."""
    from recorded import Record

    return Record(request)
