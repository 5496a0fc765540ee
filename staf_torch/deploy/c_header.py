"""A C header: the arithmetic of one call and its constants, nothing else."""

from __future__ import annotations

import ctypes
import logging
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from ..adp import Controller, SafetyFilter
from ..lanes import Program
from ..lanes.compilation.compiler import run
from ..lanes.emit.c import checked_names, commented, guarded
from ..lanes.emit.row_c import RowC, wide
from ..lanes.per_row.objects import refuse_rows, row_of
from ..lanes.trace.step import Step
from ..lanes.trace.tracer import NotLoweredError
from ..lanes.tree import Tree, flatten, labels
from ..numerics.checks import fail
from ..signs import Sign
from .controllers import (
    GuardedPolicy,
    check_bounded,
    check_count,
    check_dtype,
    function_name,
    in_dtype,
    listed_names,
    searches,
)
from .data_sheet import Latency, Source, counted
from .formats import Run, as_tuple, found_compiler
from .remembered_policy import RememberedPolicy

_log = logging.getLogger(__name__)


@Sign("export to C")
def export_c(
    module: nn.Module,
    example: Tensor,
    path: Path,
    outputs: Sequence[str],
    *,
    name: str | None = None,
    note: str = "",
) -> Source:
    """Write a module at one row as ``static inline void NAME(const T state[n], T value[...], ...)``.

    Headers of different names go into one program, in C99 and in C++; two of one name are an error there.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> source = deploy.export_c(policy, torch.zeros(1, 2).double(), Path("policy.h"), ["control"])
        >>> "control" in Path("policy.h").read_text()
        True

        Shown by `staf-export RUN --to c`.

    Args:
        module: (1, n) -> a tensor or a tuple of tensors (1, ...).
        example: an input (1, n); float64 makes T double, float32 float.
        path: of the header.
        outputs: the names of the outputs, free in C and C++ (`exp` and `class` are not).
        name: of the function, and before whatever else the header defines; that of the policy by default
            (`lqr`, `near_optimal`).
        note: lines for the comment at its head.

    Raises:
        ValueError: if a name is taken, or given twice, their number is wrong, or an operation of the module
            has no C here.
    """
    path, outputs = Path(path), listed_names("export_c", outputs)
    name = function_name("export_c", name, module, ["state", *outputs])
    checked_names("export_c", "outputs", outputs, ["state"])
    check_dtype("export_c", module, example)
    guards = [part.guard for part in module.modules() if isinstance(part, GuardedPolicy)]
    ahead = any(isinstance(guard, SafetyFilter) and guard.follows for guard in guards)
    if isinstance(module, RememberedPolicy) or searches(module):
        check_count("export_c", outputs, 1)
        body, source, compared = _searching(module, example[:1], name, outputs[0])
        said = _said(note, source, f"compares {compared} states and takes at most")
        path.write_text(commented(said) + guarded(name, body), encoding="utf-8")
        return _warned(source, path, ahead)
    given = _row_c((), {"state": example[:1]}, _step_of, module)
    return _warned(_write(path, given, name, outputs, note), path, ahead)


def _step_of(module: nn.Module) -> Step:
    return lambda carry, now, row: (carry, as_tuple(module(row["state"])))


def _warned(source: Source, path: Path, ahead: bool) -> Source:
    """Return what a header costs; with a line in the log where a filter in it follows its policy ahead."""
    if ahead:
        _log.warning(
            "%s has a filter that follows its policy ahead at some states: a call there can take all of its "
            "%d additions and the like and %d calls of exp and the like, far more than most calls take.",
            path.name,
            source.flops,
            source.functions,
        )
    return source


@Sign("export to C")
def export_learning_c(
    controller: Controller,
    x0: Tensor,
    path: Path,
    *,
    dt: float,
    name: str | None = None,
    note: str = "",
    row: int | None = None,
) -> Source:
    """Write a controller that learns: a structure ``NAME_state``, ``NAME_start`` that fills it, and

        static inline void NAME(NAME_state *state, const T x[n], const T uniform[...], T u[m]);

    which returns the control to hold for ``dt`` seconds and moves the weights. ``uniform`` are random numbers
    of [-1, 1] that the caller draws; the argument is missing where the controller needs none.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> points = adp.RandomPoints(1, half_width=0.5)
        >>> learner = adp.ActorCritic(adp.QuadraticBasis(2), plant, cost, points)
        >>> x0 = torch.tensor([[-1.0, 1.0]]).double()
        >>> source = deploy.export_learning_c(learner, x0, Path("learner.h"), dt=0.01)
        >>> Path("learner.h").exists()
        True

        Shown by `staf-export RUN --to c`.

    Args:
        controller: of `adp`.
        x0: the first state, (1, n); float64 makes T double, float32 float.
        path: of the header.
        dt: s.
        name: as in `export_c`; that of the controller by default.
        note: lines for the comment at its head.
        row: which one, of a controller with numbers of rows (`staf_torch.rows`).

    Raises:
        ValueError: if the controller optimises on the way, the name is taken, or an operation has no C here.
    """
    name = function_name("export_learning_c", name, controller, ["state", "x", "uniform", "u"])
    controller = controller if row is None else row_of(controller, row)
    refuse_rows("export_learning_c", "name its `row`", controller=controller)
    check_bounded("export_learning_c", controller)
    controller = in_dtype(controller, x0.dtype)
    carry = controller.init(x0[:1])
    fields = labels(flatten(carry)[1], "carry")
    checked_names("export_learning_c", "controller", fields, field=True)  # what its state is made of
    inputs = {"x": x0[:1]}
    if controller.draws:
        inputs["uniform"] = x0.new_zeros(1, controller.draws, x0.shape[-1])

    def make(learner: Controller) -> Step:
        def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
            uniform = row.get("uniform", x0.new_zeros(1, 0, x0.shape[-1]))
            u, after = learner.step(row["x"], carry, uniform, dt)
            return after, (u,)

        return step

    return _write(path, _row_c(carry, inputs, make, controller), name, ["u"], note)


def _row_c(carry: Tree, row: Tree, make: Callable[..., Step], part: object) -> RowC:
    """Return the step that is made of a part, traced for C.

    Raises:
        ValueError: if it has no C.
    """
    try:
        found = Program(make(part), name="the header").row_c(carry, (), row, [part], make)
    except NotLoweredError as error:
        raise ValueError(f"This has no C here, export it as ONNX, pt2 or aoti: {error}") from error
    if wide(found.traced):
        raise ValueError("This needs float64 inside, or float32 loses its digits: use --dtype float64.")
    return found


def _write(path: Path, given: RowC, name: str, outputs: Sequence[str], note: str) -> Source:
    source = counted(given.traced)
    check_count("export_c", outputs, len(given.traced.outputs))
    path.write_text(given.text(name, outputs, _said(note, source, "takes at most")), encoding="utf-8")
    return source


def _searching(module: nn.Module, x: Tensor, name: str, output: str) -> tuple[str, Source, int]:
    """Return the text of a policy that searches a memory, or is around one, its cost, and states compared."""
    if isinstance(module, RememberedPolicy):
        given = _row_c((), module.row(x), type(module).step, module)
        follow, one = given.text(f"{name}_follow", ["cost", "control"]), counted(given.traced)
        return module.c_text(name, follow, output), module.source(one), len(module.searched)
    assert isinstance(module, GuardedPolicy)
    inner = module.plant_state(x)
    body, source, compared = _searching(module.policy, inner, f"{name}_policy", "control")
    row = {"state": x, "wanted": module.policy(inner)}
    given = _row_c((), row, _restraint_of, module)
    text, more = given.text(f"{name}_restrained", ["control"]), counted(given.traced)
    real, size, inputs = _c_type(x.dtype), x.shape[-1], row["wanted"].shape[-1]
    lines = [
        f"static inline void {name}(const {real} state[{size}], {real} {output}[{inputs}])",
        f"{{\n    {real} wanted[{inputs}];",
        f"    {name}_policy(state, wanted);\n    {name}_restrained(state, wanted, {output});\n}}",
    ]
    whole = Source(*(a + b for a, b in zip(source, more, strict=True)))
    return "\n".join([body, text, *lines]), whole, compared


def _restraint_of(module: GuardedPolicy) -> Step:
    return lambda carry, _, row: (carry, (module.restrained(row["state"], row["wanted"]),))


def _said(note: str, source: Source, takes: str) -> str:
    """The note and what a call costs: loops have fixed lengths, and both sides of a choice are computed."""
    most = f"A call {takes} {source.flops} additions and the like,"
    return f"{note}\n{most}\n{source.functions} calls of exp and the like, whatever the state is.".lstrip()


def runner_c(path: Path, sizes: Sequence[int | None], dtype: torch.dtype) -> Run:
    """The header, compiled with -O2 and called a row at a time, with as many entries of every output, None
    for a scalar.

    Raises ValueError if there is no C compiler.
    """
    kind = _c_type(dtype)
    names = ", ".join(f"o{k}" for k in range(len(sizes)))
    declared = ", ".join(f"{kind} *o{k}" for k in range(len(sizes)))
    call = _built(path, f"void call(const {kind} *state, {declared}) {{ {_name(path)}(state, {names}); }}")

    def run(x: Tensor) -> tuple[Tensor, ...]:
        outs = tuple(
            torch.empty(len(x), *([] if size is None else [size]), dtype=dtype, device=x.device)
            for size in sizes
        )
        for k in range(len(x)):
            call(*(ctypes.c_void_p(t[k].data_ptr()) for t in (x, *outs)))
        return outs

    return run


@Sign("timing the C")
def time_c(path: Path, states: Tensor, outputs: Sequence[int]) -> Latency:
    """Time every call of a header of `export_c`, compiled with -O2, inside C: median, 99 % and worst.

    It is CPU time of the thread, without what other programs take, and with some tenths of a microsecond
    that asking for it takes. A call takes at most the operations that the head names; that of a filter which
    follows its policy ahead takes far fewer at most states: time it at the states where it acts.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x = torch.rand(1000, 2, dtype=torch.float64)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> source = deploy.export_c(policy, x, Path("policy.h"), ["control"])
        >>> deploy.time_c(Path("policy.h"), x, [1]).worst_us > 0
        True

        Shown by `staf_torch/deploy/README.md`.

    Args:
        path: of the header.
        states: of the calls, (C, n), in the dtype of the header.
        outputs: entries of every output.

    Raises:
        ValueError: if there is no C compiler.
    """
    kind, name = _c_type(states.dtype), _name(path)
    declared = " ".join(f"{kind} o{k}[{size}];" for k, size in enumerate(outputs))
    names = ", ".join(f"o{k}" for k in range(len(outputs)))
    used = " ".join(f"seen += o{k}[0];" for k in range(len(outputs)))
    now = "clock_gettime(CLOCK_THREAD_CPUTIME_ID, &%s);"
    loop = (
        f"for (long r = 0; r < rows; ++r) {{ {now % 'a'} {name}(x + r * n, {names}); {now % 'b'} {used} "
        "us[r] = 1e6 * (double)(b.tv_sec - a.tv_sec) + 1e-3 * (double)(b.tv_nsec - a.tv_nsec); }"
    )
    body = f"struct timespec a, b; volatile double seen = 0; {declared} {loop}"
    given = f"const {kind} *x, double *us, long rows, long n"
    call = _built(path, f"void call({given}) {{ {body} }}", "#include <time.h>\n")
    x, taken = states.contiguous(), torch.empty(len(states), dtype=torch.float64, device=states.device)
    call(*(ctypes.c_void_p(t.data_ptr()) for t in (x, taken)), *map(ctypes.c_long, x.shape))
    return Latency(len(x), float(taken.median()), float(taken.quantile(0.99)), float(taken.max()))


def runner_learning_c(
    path: Path, draws: int, inputs: int, dtype: torch.dtype
) -> Callable[[Tensor, Tensor], Tensor]:
    """The header of a controller that learns, compiled with -O2: it starts anew and follows given states.

    The function that is returned takes states (K, n) and random numbers (K, draws, n) to the controls (K, m);
    m are the ``inputs`` of the plant. Raises ValueError if there is no C compiler.
    """
    kind, name = _c_type(dtype), _name(path)
    step = f"{name}(&s, x + k * n, {f'z + k * n * {draws}, ' if draws else ''}u + k * {inputs})"
    loop = f"{name}_state s; {name}_start(&s); for (long k = 0; k < steps; ++k) {step}; (void)z;"
    given = f"const {kind} *x, const {kind} *z, {kind} *u, long steps, long n"
    call = _built(path, f"void call({given}) {{ {loop} }}")

    def run(states: Tensor, uniform: Tensor) -> Tensor:
        x, z, u = states.contiguous(), uniform.contiguous(), states.new_empty(len(states), inputs)
        call(*(ctypes.c_void_p(t.data_ptr()) for t in (x, z, u)), *map(ctypes.c_long, x.shape))
        return u

    return run


def _name(path: Path) -> str:
    """Return the name of the function of a header, the last one that it defines.

    Raises:
        ValueError: if there is none.
    """
    found = re.findall(r"^static inline void (\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE)
    if not found:
        raise fail("time_c", "path", "must be a header of export_c", str(path))
    return str(found[-1])


def _c_type(dtype: torch.dtype) -> str:
    return "float" if dtype == torch.float32 else "double"


def _built(path: Path, function: str, head: str = "") -> Callable[..., object]:
    """Compile a header and a function ``call`` that calls what is in it.

    The header is copied: the name of the folder that it lies in, which may be somebody else's, is no C.
    """
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(path, Path(folder) / "exported.h")
        source = f'{head}#include "exported.h"\n{function}\n'
        (Path(folder) / "call.c").write_text(source, encoding="utf-8")
        line = [need_c_compiler(), "-O2", "-shared", "-fPIC", "-x", "c", "call.c", "-o", "call.so", "-lm"]
        run(line, folder=Path(folder))
        return ctypes.CDLL(str(Path(folder) / "call.so")).call


def need_c_compiler() -> str:
    """The C compiler here.

    Raises:
        ValueError: if there is none.
    """
    return found_compiler(
        "CC",
        ("cc", "gcc", "g++", "clang"),
        "The C header is compiled once to compare it with the library, and there is no C compiler here: "
        "install gcc, or name one in the variable CC",
    )
