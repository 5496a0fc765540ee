"""Operations that people write in plants, laws and values, compiled, are those of torch; derivatives too."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from typing import Any

import helpers_forms as forms
import numpy as np
import pytest
import torch
from helpers import uniform
from torch import Tensor
from torch.nn import functional

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

SIZE = 3
LIST = torch.tensor([2, 0])
COMPARISONS = (torch.lt, torch.le, torch.gt, torch.ge, torch.eq, torch.ne)
EDGES = (-0.8, -0.1, 0.4, 1.1)


def slope(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return torch.func.grad(lambda x: function(x).sin().sum())


def matrix(x: Tensor) -> Tensor:
    return torch.eye(SIZE) * 2 + x.unsqueeze(-1) * x.unsqueeze(-2).flip(-1)


def wrapped(x: Tensor) -> Tensor:
    """An angle between -pi and pi."""
    return torch.remainder(5 * x + torch.pi, 2 * torch.pi) - torch.pi


def lookup(x: Tensor) -> Tensor:
    """A table interpolated linearly."""
    edges = torch.tensor(EDGES, dtype=x.dtype)
    at = torch.searchsorted(edges, x.contiguous()).clamp(1, len(EDGES) - 1)
    low, high = edges[at - 1], edges[at]
    return (at - 1) + (x - low) / (high - low)


def compared(x: Tensor) -> Tensor:
    """Of numbers that are often equal."""
    a = (2 * x).round()
    found = [compare(a, other) for compare in COMPARISONS for other in (a.flip(-1), 1.0)]
    return torch.cat(found, dim=-1).to(x)


def masked(x: Tensor) -> Tensor:
    y = x.clone()
    y[y > 0.5] = 0.25
    y[y[:, 0] < 0] = torch.tensor(-1.0, dtype=x.dtype)
    return y


OPERATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "remainder": wrapped,
    "remainder by a row": lambda x: torch.remainder(x * 30, x.flip(-1)),
    "fmod": lambda x: torch.fmod(x * 40, -0.3),
    "floor division": lambda x: (x * 9) // 0.7,
    "hypot": lambda x: torch.hypot(x, x.roll(1, -1)),
    "asinh": torch.asinh,
    "acosh": lambda x: torch.acosh(1 + x.abs()),
    "atanh": lambda x: torch.atanh(x / (1 + x.abs())),
    "erfc": torch.erfc,
    "erfinv": lambda x: torch.erfinv(x / (1 + x.abs())),
    "lgamma": lambda x: torch.lgamma(x.abs() + 0.1),
    "digamma": lambda x: torch.digamma(x - 0.05),
    "copysign": lambda x: torch.copysign(x, -x.flip(-1)),
    "angle": torch.angle,
    "a norm of order 3": lambda x: torch.linalg.vector_norm(x, 3, -1),
    "a norm of order 0": lambda x: torch.linalg.vector_norm(x.round(), 0, -1),
    "the least size": lambda x: torch.linalg.vector_norm(x, -math.inf, -1),
    "distances of order 3": lambda x: torch.cdist(x.unsqueeze(1), matrix(x), p=3),
    "sums of exponentials": lambda x: x.logcumsumexp(-1),
    "the sign of zeros": lambda x: torch.signbit(torch.cat((x, 0 * x, -x), dim=-1)).to(x),
    "a scaled product": lambda x: torch.addmm(x, x, matrix(torch.ones_like(x))[0], beta=0.5, alpha=2),
    "rsub": lambda x: torch.rsub(x, x.flip(-1), alpha=2),
    "matrix exponential": lambda x: torch.linalg.matrix_exp(matrix(3 * x)),
    "its slope": slope(lambda x: torch.linalg.matrix_exp(matrix(x.tanh()) / 4)),
    "round to decimals": lambda x: torch.round(x, decimals=2),
    "sort": lambda x: x.sort(-1)[0],
    "argsort": lambda x: x.argsort(dim=-1, stable=True).to(x),
    "sort descending": lambda x: x.sort(-1, descending=True)[0],
    "top": lambda x: x.topk(2, -1)[0],
    "median": lambda x: x.median(-1, keepdim=True)[0],
    "second smallest": lambda x: x.kthvalue(2, -1, keepdim=True)[0],
    "quantile": lambda x: x.nan_to_num(0.0, 1.0, -1.0).quantile(0.3, -1, keepdim=True),
    "cummax": lambda x: x.cummax(-1)[0],
    "cummin": lambda x: x.cummin(-1)[0],
    "cumprod": lambda x: x.cumprod(-1),
    "std": lambda x: x.std(-1, keepdim=True),
    "layer norm": lambda x: functional.layer_norm(x, (SIZE,)),
    "cross": lambda x: torch.linalg.cross(x, x.flip(-1)),
    "det": lambda x: torch.linalg.det(matrix(x)).unsqueeze(-1),
    "slogdet": lambda x: torch.stack(tuple(torch.linalg.slogdet(matrix(x))), dim=-1),
    "logdet": lambda x: torch.logdet(matrix(x)).unsqueeze(-1),
    "lookup table": lookup,
    "searched from the right": lambda x: torch.searchsorted(
        torch.tensor(EDGES, dtype=x.dtype), (5 * x).round() / 10, right=True
    ).to(x),
    "searched from the left": lambda x: torch.searchsorted(
        torch.tensor((-0.1, 0.1, 0.3), dtype=x.dtype), (5 * x).round() / 10, side="left"
    ).to(x),
    "one hot": lambda x: functional.one_hot(x.argmax(-1), SIZE).to(x),
    "distances": lambda x: torch.cdist(x.unsqueeze(-2), x.flip(-1).unsqueeze(-2)).squeeze(-1),
    "constant of float32": lambda x: x + torch.eye(SIZE)[1],
    "an index from the end": lambda x: torch.tensor(EDGES).to(x)[torch.where(x > 0, -2, 0)],
    "index_select": lambda x: x.index_select(-1, LIST),
    "index_copy": lambda x: x.index_copy(-1, LIST, x[:, 1:]),
    "index_fill": lambda x: x.index_fill(-1, LIST, 0.25),
    "index_add": lambda x: x.index_add(-1, LIST, x[:, 1:], alpha=2.0),
    "squeezed in place": lambda x: x.clone().unsqueeze_(-1).squeeze_(-1),
    "chosen by a mask": masked,
    "fmin": lambda x: torch.fmin(x, torch.fmax(x.flip(-1), torch.tensor(0.1))),
    "compared": compared,
    "slope of digamma": slope(lambda x: torch.digamma(x.abs() + 0.1)),
    "slopes of what shrinks": slope(lambda x: functional.softshrink(x, 0.1) + functional.hardshrink(x, 0.2)),
    "slope of a bilinear form": slope(
        lambda x: functional.bilinear(x, x.sin(), torch.ones(2, SIZE, SIZE).to(x).tril())
    ),
    "slope of a list": slope(lambda x: x[:, [1, 0, 1, 1]].cumprod(-1)),
    "slope of a product": slope(lambda x: x.prod(-1)),
    "slope of a sort": slope(lambda x: x.sort(-1)[0] * torch.arange(SIZE)),
    "slope of gather": slope(lambda x: x.gather(-1, x.argsort(-1)[:, :2]).prod(-1)),
    "slope of det": slope(lambda x: torch.linalg.det(matrix(x))),
    "slope of a remainder": slope(lambda x: wrapped(x).square()),
    "slope of distances": slope(lambda x: torch.cdist(x.unsqueeze(-1), x.flip(-1).unsqueeze(-1))),
    "slope of a table": slope(lookup),
}  # fmt: skip


ORDERED = (
    "sort",
    "argsort",
    "sort descending",
    "top",
    "median",
    "second smallest",
    "cummax",
    "cummin",
    "copysign",
)


def both(operations: dict[str, Callable[[Tensor], Tensor]]) -> Callable[[Tensor], list[dict[str, Tensor]]]:
    """A function of x (B, n): the operations of every row, compiled, and by torch."""

    def step(carry: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return carry, {name: operation(row) for name, operation in operations.items()}

    program = lanes.Program(step)

    def run(x: Tensor) -> list[dict[str, Tensor]]:
        assert program.compiles(x, x.unsqueeze(1), x)
        return [call(x, x.unsqueeze(1), x)[1] for call in (program, program.definition)]

    return run


def drawn(dtype: torch.dtype) -> Tensor:
    return torch.randn(41, SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(3)).to(dtype)


def close(found: Tensor, wanted: Tensor, name: str) -> None:
    bound = 2**9 * torch.finfo(wanted.dtype).eps
    torch.testing.assert_close(
        found, wanted, rtol=bound, atol=bound, equal_nan=True, msg=lambda said: f"{name}: {said}"
    )


@pytest.fixture(scope="module")
def every() -> lanes.Program:
    """The program of all operations."""

    def step(carry: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return carry, {name: operation(row) for name, operation in OPERATIONS.items()}

    return lanes.Program(step)


def test_compiled_operations_are_those_of_torch(every: lanes.Program) -> None:
    x = drawn(torch.float64)
    assert every.compiles(x, x.unsqueeze(1), x)
    found, wanted = (run(x, x.unsqueeze(1), x)[1] for run in (every, every.definition))
    for name in OPERATIONS:
        close(found[name], wanted[name], name)


def test_order_is_that_of_torch_for_what_is_no_number(every: lanes.Program) -> None:
    x = drawn(torch.float64)
    x[::2, 0] = torch.tensor([0.0, -0.0, torch.inf, -torch.inf, torch.nan, 5e-324, 1e30]).double().repeat(3)
    x[::3, 1] = x[::3, 0]
    assert every.compiles(x, x.unsqueeze(1), x)
    found = every(x, x.unsqueeze(1), x)[1]
    for name in ORDERED:
        close(found[name][:, 0], OPERATIONS[name](x), name)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_remainders_are_exact_whatever_the_quotient(dtype: torch.dtype) -> None:
    """Beside NumPy: `torch.fmod` itself errs by a divisor where that is nearly subnormal (2.13, x86)."""
    run = both(
        {
            "fmod": lambda x: torch.fmod(x[:, :1], x[:, 1:2]),
            "remainder": lambda x: torch.remainder(x[:, :1], x[:, 1:2]),
        }
    )
    info = torch.finfo(dtype)
    for scale in (info.tiny, 1.0, 1e3, 2 / info.eps, 1e30):
        x = drawn(dtype)
        x[:20, 0] *= scale
        x[20:, 1] *= scale
        x[:4, 1] = torch.tensor([0.0, torch.inf, torch.nan, 1.0])
        x[4, 0] = 3 * x[4, 1]
        found = run(x)[0]
        with np.errstate(invalid="ignore"):
            for name, exact in (("fmod", np.fmod), ("remainder", np.remainder)):
                wanted = torch.from_numpy(exact(x[:, 0].numpy(), x[:, 1].numpy()))
                torch.testing.assert_close(
                    found[name][:, 0, 0], wanted, rtol=0, atol=0, equal_nan=True, msg=name
                )


# Every operation as C, by one call of a C compiler.


def x(*shape: int) -> Tensor:
    return uniform(2, *shape, seed=1)


def i(*shape: int) -> Tensor:
    return torch.arange(torch.Size(shape).numel()).reshape(1, *shape).repeat(2, *[1] * len(shape)) % 3


def at(*shape: int, of: int) -> Tensor:
    """Places that rows have: (2, ...), of which some are equal."""
    return (7 * torch.arange(2 * torch.Size(shape).numel()) % 5 % of).view(2, *shape)


def without_signs(a: Tensor) -> list[Tensor]:
    """Factorisations, of eigenvectors the sizes of their entries."""
    return [part.abs() if k == 16 else part for k, part in enumerate(forms.decomposed(a))]


def captured(a: Tensor) -> list[Tensor]:
    """Numbers that are found outside."""
    gain = torch.tensor([2.0, -0.5, 3.0], dtype=torch.float64)
    chosen = torch.where(torch.tensor([True, False, True]), a, gain[0])
    return [a * gain + gain.exp(), chosen, (a @ gain).unsqueeze(-1), a.abs() ** gain.abs()]


FORMS: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
    "of one": (lambda a: forms.by_name(forms.ONE, a), (x(3),)),
    "of two": (lambda a, b: forms.by_name(forms.TWO, a, b), (x(3), x(3) + 2)),
    "powers": (forms.powers, (x(3), x(3) + 2)),
    "arithmetic": (forms.arithmetic, (x(3), x(3) + 2)),
    "logic": (forms.logic, (x(3), x(3) + 2)),
    "integers": (forms.integers, (x(3).float(), i(3))),
    "blank": (forms.blank, (x(3),)),
    "reductions": (forms.reductions, (x(2, 3, 2),)),
    "products": (forms.products, (x(3, 2), x(2, 3))),
    "slopes": (forms.slopes, (x(3, 2), x(2, 3))),
    "movements": (forms.movements, (x(3, 3),)),
    "choices": (forms.choices, (x(3, 3), i(3))),
    "replaced": (forms.replaced, (x(4),)),
    "large": (forms.large, (x(65),)),
    "decomposed": (without_signs, (x(3, 3) + 3 * torch.eye(3),)),
    "writes": (forms.written, (x(3, 4), at(3, of=4))),
    "digits": (forms.rounded, (x(4),)),
    "nested": (forms.nested, (x(4, 2), x(2))),
    "points": (lambda a: forms.points(a, 2), (x(5, 3),)),
    **{f"loops of {n}": (forms.loops, (x(4, n), x(n))) for n in (2, 65)},
    "captured": (captured, (x(3),)),
}  # fmt: skip
ORDER = {name: f"form{k}" for k, name in enumerate(FORMS)}


def leaves(found: Any) -> list[Tensor]:
    """A nested tree of results as a list, each with a dimension of one row."""
    if isinstance(found, Tensor):
        return [found if found.shape[:1] == (1,) else found.unsqueeze(0)]
    return [leaf for part in found for leaf in leaves(part)]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """All forms as functions of C, unoptimised."""
    compiler = next(filter(None, map(shutil.which, ("gcc", "cc", "clang"))), None)
    if compiler is None:
        pytest.skip("needs a C compiler")
    texts, folder = [], tmp_path_factory.mktemp("forms")
    for name, (body, rows) in FORMS.items():
        program = lanes.Program(lambda carry, now, row, body=body: ((), leaves(body(*row))))
        one = tuple(row[:1] for row in rows)
        count = len(one) + len(leaves(body(*one)))
        texts.append(program.c_source(ORDER[name], row=one))
        words = ", ".join(f"p[{k}]" for k in range(count))
        texts.append(f"void call_{ORDER[name]}(void **p) {{ {ORDER[name]}({words}); }}\n")
    (folder / "forms.c").write_text("".join(texts))
    out = folder / "forms.so"
    subprocess.run(
        [compiler, "-std=c99", "-O0", "-shared", "-fPIC", folder / "forms.c", "-o", out, "-lm"], check=True
    )
    return ctypes.CDLL(str(out))


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
@pytest.mark.parametrize("name", FORMS)
def test_c_of_an_operation_computes_what_torch_does(name: str, library: ctypes.CDLL) -> None:
    body, rows = FORMS[name]
    real = torch.float32 if rows[0].dtype == torch.float32 else torch.float64
    bound = 1e-11 if real == torch.float64 else 1e-5
    for k in range(2):
        alone = [row[k : k + 1] for row in rows]
        wanted = leaves(body(*alone))
        outs = [torch.empty(leaf.shape[1:], dtype=real) for leaf in wanted]
        given = [part.to(real).contiguous() for part in alone]
        places = [part.data_ptr() for part in (*given, *outs)]
        library[f"call_{ORDER[name]}"]((ctypes.c_void_p * len(places))(*places))
        for at, (found, leaf) in enumerate(zip(outs, wanted, strict=True)):
            torch.testing.assert_close(
                found.to(leaf.dtype).double(),  # of a flag, what is not 0 is true
                leaf[0].double(),
                rtol=bound,
                atol=bound,
                equal_nan=True,
                msg=lambda text, at=at: f"result {at}: {text}",
            )
