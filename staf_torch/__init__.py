"""State Following (StaF) kernel approximation as a batched PyTorch engine.

The sentence of the library, and where each of its words is: state (`staf_torch.systems`), centers
(`staf_torch.centers`), Gram matrix (`staf_torch.kernels`), target values (`staf_torch.targets`), weights
(`staf_torch.optim`, `staf_torch.engine`), estimate (`StaF`, `StaFBasis`), metrics (`staf_torch.metrics`),
table (`staf_torch.tables`). Closed loops are in `staf_torch.adp`, streams in `staf_torch.online`, devices in
`staf_torch.deploy`, environments in `staf_torch.envs`, the theorems in `staf_torch.theory`, the compiler in
`staf_torch.lanes`, experiments from Python in `staf_torch.sweeps.python_api`.

Every name below is imported when it is first used (PEP 562): `staf-table` needs none of them, and no torch.
"""

import importlib
from typing import TYPE_CHECKING

from . import _conf
from ._version import __version__ as __version__
from .results import pictures as _pictures

if TYPE_CHECKING:  # for type checkers and editors; the tables below say it again for Python
    from . import adp as adp
    from . import optim as optim
    from . import systems as systems
    from . import targets as targets
    from . import theory as theory
    from .approximation import conditioning as conditioning
    from .approximation import sensitivity as sensitivity
    from .approximation.basis import StaFBasis as StaFBasis
    from .approximation.staf import StaF as StaF
    from .centers import ConstantRadius as ConstantRadius
    from .centers import StateFollowingCenters as StateFollowingCenters
    from .centers import StateRadius as StateRadius
    from .centers import ball as ball
    from .centers import cross_polytope as cross_polytope
    from .centers import polygon as polygon
    from .centers import rings as rings
    from .centers import simplex as simplex
    from .engine import ChaseResult as ChaseResult
    from .engine import ChaseWeights as ChaseWeights
    from .engine import chase as chase
    from .engine import chase_weights as chase_weights
    from .engine import predictors as predictors
    from .kernels import AnchoredKernel as AnchoredKernel
    from .kernels import ExponentialKernel as ExponentialKernel
    from .kernels import GaussianKernel as GaussianKernel
    from .kernels import InverseMultiquadricKernel as InverseMultiquadricKernel
    from .kernels import Kernel as Kernel
    from .kernels import MaternKernel as MaternKernel
    from .kernels import PolynomialKernel as PolynomialKernel
    from .kernels import RationalQuadraticKernel as RationalQuadraticKernel
    from .lanes.per_row.objects import rows as rows
    from .online import ExperienceMemory as ExperienceMemory
    from .online import MixtureRegressor as MixtureRegressor
    from .online import StaFRegressor as StaFRegressor
    from .sweeps.python_api import read_runs as read_runs
    from .sweeps.python_api import run as run
    from .sweeps.python_api import sweep as sweep
else:
    _MODULES = {
        **{
            room: room
            for room in (
                *("adp", "approximation", "centers", "deploy", "engine", "envs", "experiments", "figures"),
                *("kernels", "lanes", "local_basis", "metrics", "numerics", "online", "optim", "results"),
                *("settings", "sweeps", "systems", "tables", "targets", "theory"),
            )
        },
        "conditioning": "approximation.conditioning",
        "sensitivity": "approximation.sensitivity",
        "predictors": "engine.predictors",
    }
    _NAMES = {
        "approximation.basis": ("StaFBasis",),
        "approximation.staf": ("StaF",),
        "centers": (
            *("ConstantRadius", "StateFollowingCenters", "StateRadius"),
            *("ball", "cross_polytope", "polygon", "rings", "simplex"),
        ),
        "engine": ("ChaseResult", "ChaseWeights", "chase", "chase_weights"),
        "kernels": (
            *("AnchoredKernel", "ExponentialKernel", "GaussianKernel", "InverseMultiquadricKernel"),
            *("Kernel", "MaternKernel", "PolynomialKernel", "RationalQuadraticKernel"),
        ),
        "lanes.per_row.objects": ("rows",),
        "online": ("ExperienceMemory", "MixtureRegressor", "StaFRegressor"),
        "sweeps.python_api": ("read_runs", "run", "sweep"),  # not for `import *`: they import Hydra
    }
    _HOMES = {name: module for module, names in _NAMES.items() for name in names}
    __all__ = sorted(
        {
            *(set(_HOMES) - {"read_runs", "run", "sweep"}),
            "adp",
            "conditioning",
            "optim",
            "predictors",
            "sensitivity",
            "systems",
            "targets",
            "theory",
        }
    )

    def __getattr__(name):
        """Import what is asked for, and keep it as an attribute of the package."""
        if name in _HOMES:
            value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        elif name in _MODULES:
            value = importlib.import_module(f"{__name__}.{_MODULES[name]}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *_HOMES, *_MODULES})


_conf.install()
_pictures.drawn_by(lambda: importlib.import_module(f"{__name__}.figures.loop").draw_loop)
