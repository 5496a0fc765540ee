"""Public names: they are there, their examples do what they say, and `staf docs` has a page for each.

An example begins where a reader does: after `import torch`, `from pathlib import Path`,
`from staf_torch import *`, and the names of the package that the name itself is in.
"""

from __future__ import annotations

import ast
import doctest
import functools
import html
import importlib
import inspect
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import ROOT, environment

import staf_torch
from staf_torch.cli.site import build
from staf_torch.cli.site.formulas import typeset
from staf_torch.cli.site.pages import public_names
from staf_torch.lanes.compilation import compiler
from staf_torch.sweeps.python_api import Runs, sweep

CONTRACT = """
    StaF StaFBasis StaFRegressor ExperienceMemory
    ExponentialKernel GaussianKernel MaternKernel InverseMultiquadricKernel RationalQuadraticKernel
    PolynomialKernel AnchoredKernel StateFollowingCenters ConstantRadius StateRadius
    rings polygon simplex cross_polytope ball chase ChaseResult optim systems targets theory adp
    systems.StepPlant systems.RatePlant systems.Barrier systems.simulate optim.ChaseOptimizer
    adp.QuadraticCost adp.simulate adp.near_optimal online.StaFRegressor online.MixtureRegressor
    adp.DirectShooting adp.SafetyFilter rows lanes.Program
"""
"""What users import (DESIGN.md, section 4)."""
PACKAGES = [
    *("adp", "centers", "deploy", "engine", "envs", "kernels", "lanes", "metrics", "online", "optim"),
    *("systems", "tables", "targets", "theory"),
]
API = ("read_runs", "run", "sweep")  # not in `__all__`: they import Hydra
TOP = re.findall(r"^(\w+):", (ROOT / "conf" / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE)
RUNS = ("results", "sweeps", "tables")  # examples of these rooms run simulations of hundreds of steps
COMPILE = (
    "staf_torch.deploy.c_header.time_c",
    *(f"staf_torch.lanes.compiled_methods.{name}" for name in ("compiled", "ready")),
)  # their examples do
SHOWN = ("kernels",)  # all pages take a third of a minute
ATTRIBUTE = re.compile(r'\b(id|href|src)="([^"]*)"')


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


PUBLIC = public()


# --- names --------------------------------------------------------------------------------------------------


def test_every_name_that_type_checkers_see_is_listed_and_can_be_had() -> None:
    tree = ast.parse(Path(staf_torch.__file__).read_text(encoding="utf-8"))
    (block,) = [
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    named = {str(a.asname) for node in block.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert named - set(API) == set(staf_torch.__all__) <= set(dir(staf_torch))
    assert all(getattr(staf_torch, name) is not None for name in named)
    for name in CONTRACT.split():
        assert functools.reduce(getattr, name.split("."), staf_torch) is not None, name
    with pytest.raises(AttributeError, match="has no attribute 'Staf'"):
        _ = staf_torch.Staf


@pytest.mark.parametrize("package", [name for name in PACKAGES if name != "targets"])
def test_all_lists_what_a_package_hands_on(package: str) -> None:
    module = importlib.import_module(f"staf_torch.{package}")
    assert all(hasattr(module, name) for name in module.__all__)
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    handed = {
        alias.asname
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name and not inspect.ismodule(getattr(module, alias.name))
    }
    assert handed <= set(module.__all__)


@pytest.mark.parametrize(
    ("program", "wanted", "unwanted"),
    [
        (
            "from staf_torch import *\nimport torch\nplant = systems.Pendulum()\n"
            "cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-8.0, high=8.0)\n"
            "x = torch.ones(1, 2).double() / 9\nadp.near_optimal(plant, cost, dt=0.05)(x)\n"
            "adp.SafetyFilter(adp.LQR(plant, cost), plant, lambda x, t: x[:, 0] + 1, dt=0.05)(x)",
            {"torch"},
            {"hydra", "omegaconf", "matplotlib", "sympy"},  # the last with torch's compiler, 2 s for nothing
        ),
        (
            "from staf_torch.cli.table import main\ntry: main(['--help'])\nexcept SystemExit: pass",
            {"staf_torch"},
            {"torch", "numpy", "hydra", "omegaconf", "matplotlib", "pandas", "jinja2"},
        ),
        (
            "import sys; from staf_torch.cli.staf import main\n"
            "for words in ('--version', '--help', 'doctro', '-sc query=bash', '--cfg job dt=0.1'):\n"
            "    sys.argv = ['staf', *words.split()]\n"
            "    try: main()\n"
            "    except SystemExit: pass",
            {"staf_torch"},
            {"torch", "matplotlib", "pandas"},
        ),
    ],
    ids=["two controllers", "staf-table", "version, help, no command, completion and settings"],
)
def test_an_import_brings_nothing_that_it_does_not_need(
    program: str, wanted: set[str], unwanted: set[str]
) -> None:
    program += "\nimport sys; print('loaded:', *{name.partition('.')[0] for name in sys.modules})"
    line = [sys.executable, "-W", "error", "-c", program]
    ended = subprocess.run(
        line, env=environment() | {"COMP_LINE": "staf ker"}, capture_output=True, text=True, check=True
    )
    loaded = set(ended.stdout.rpartition("loaded:")[2].split())
    assert wanted <= loaded
    assert loaded.isdisjoint(unwanted)


# --- examples -----------------------------------------------------------------------------------------------


def asked(name: str) -> object:
    """A name, whose chases are compiled where its example has long ones."""
    compiled = name in COMPILE or name.split(".")[1] in RUNS
    return pytest.param(name, marks=[pytest.mark.compiled] if compiled else [])


@functools.cache
def kept(*lines: str) -> Runs:
    """What examples of tables and runs begin with: they only read it."""
    return sweep(*lines)


def swept(*lines: str, **places: str) -> Runs:
    return sweep(*lines, **places) if places else kept(*lines)


@pytest.mark.parametrize("name", [asked(name) for name in PUBLIC])
def test_the_example_of_a_name_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if name in COMPILE and not compiler.compiler():
        pytest.skip("needs a C++ compiler")
    thing, names = PUBLIC[name]
    if names.get("sweep") is sweep:
        names = {**names, "sweep": swept}
    text = inspect.cleandoc(thing.__doc__ or "")
    assert ">>> " in text, f"the docstring of {name} needs an example"
    test = doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)
    said: list[str] = []
    doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS).run(test, out=said.append)
    assert said == [], "".join(said)


def is_there(place: str) -> bool:
    """Whether there is such a configuration, command, or file."""
    program, *words = shlex.split(place)
    if program != "staf":
        return program in ("staf-table", "staf-export") or (ROOT / place).is_file()
    groups = [word.split("=") for word in words if (ROOT / "conf" / word.partition("=")[0]).is_dir()]
    known = groups or all("." in word or word.split("=")[0] in TOP for word in words)
    return bool(known) and all((ROOT / "conf" / g / f"{option}.yaml").is_file() for g, option in groups)


def test_every_name_says_where_it_is_shown_and_that_is_there() -> None:
    for name, (thing, _) in PUBLIC.items():
        shown = re.findall(r"Shown by `([^`]+)`", " ".join((thing.__doc__ or "").split()))
        assert shown, f"the docstring of {name} needs a line: Shown by `staf experiment=...`."
        assert [place for place in shown if not is_there(place)] == [], name


# --- pages of `staf docs` -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manuals and the pages of a room, made without a warning."""
    pytest.importorskip("material")
    pytest.importorskip("mkdocstrings_handlers")
    folder = tmp_path_factory.mktemp("site")
    program = "import sys; from staf_torch.cli.site.build import main; "
    program += "print(main(sys.argv[1:]), 'torch' in sys.modules)"
    line = [sys.executable, "-c", program, str(folder), *SHOWN]
    said = subprocess.run(line, capture_output=True, text=True, check=False)
    assert said.stdout == f"site: {folder / 'index.html'} False\n", said.stdout + said.stderr
    return folder


def test_every_public_name_has_a_page_and_every_link_leads_somewhere(site: Path) -> None:
    for room in PACKAGES:
        module = importlib.import_module(f"staf_torch.{room}")
        names = (name for name in module.__all__ if callable(getattr(module, name)))
        assert {found.name for found in public_names(room)} == set(names), room
    attributes = {page: ATTRIBUTE.findall(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}
    ids = {page: {value for kind, value in found if kind == "id"} for page, found in attributes.items()}
    lost, count = [], 0
    for page, found in attributes.items():
        for kind, value in found:
            if kind == "id" or value.startswith(("https:", "data:")) or page.name == "404.html":
                continue
            file, _, anchor = value.partition("#")
            target = (page.parent / file).resolve() if file else page
            count += 1
            if not target.exists() or (
                anchor and target in ids and anchor not in {*ids[target], "__codelineno"}
            ):
                lost.append(f"{page.name}: {value}")
    assert count > 200
    assert lost == []
    for room in SHOWN:
        for each in public_names(room):
            (page,) = site.glob(f"*.*/reference/{room}/{each.name}.html")
            text = page.read_text(encoding="utf-8")
            assert "&gt;&gt;&gt;" in text, "a page has the example of its name"
            assert "Initialize internal Module state" not in text


@pytest.mark.parametrize(
    ("text", "typeset_as"),
    [
        ("V^(y; x) = w_1 k(y, c_1(x)).", "V ^ ( y ; x ) = w 1 k ( y , c 1 ( x ) ) ."),
        ("the rate e^{-|z|^2 / 2 width^2} of it", "the rate e \u2212 | z | 2 / 2 width 2 of it"),
        ("M &lt;= 6, V* and (B, T, n)", "M ≤ 6 , V* and (B, T, n)"),
        ("a plain sentence: near_optimal (see torch>=2.6)", ""),
    ],
)
def test_formulas_in_text_are_typeset_and_keep_every_sign(text: str, typeset_as: str) -> None:
    shown = typeset(text)
    assert ("<math>" in shown) == bool(typeset_as)
    if typeset_as:
        assert html.unescape(re.sub(r"(<[^>]*>|\s)+", "", shown)) == typeset_as.replace(" ", "")


def test_without_its_generator_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mkdocs", None)
    with pytest.raises(ValueError, match=r"install the extra, pip install 'staf_torch\[docs\]'"):
        build.main([])
    with pytest.raises(ValueError, match=r"takes rooms of .*; got 'b'"):
        build.main(["a", "b"])


@pytest.mark.parametrize("name", ["latest/mine.txt", "index.html"])
def test_nothing_but_an_earlier_site_is_replaced(name: str, tmp_path: Path) -> None:
    pytest.importorskip("mkdocstrings")
    own = tmp_path / name
    own.parent.mkdir(exist_ok=True)
    own.write_text("mine")
    with pytest.raises(ValueError, match="takes the place of an earlier site alone"):
        build.main([str(tmp_path)])
    assert own.read_text() == "mine"
