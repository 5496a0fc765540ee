"""The texts of every operation, size and kind of loop, recorded: an operation more, or another, is seen.

Sizes stand at both sides of what decides between numbers that are written out and loops over arrays. All
numbers in the texts are exact in every dtype.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import uniform
from helpers_forms import (
    ONE,
    TWO,
    arithmetic,
    blank,
    by_name,
    choices,
    integers,
    logic,
    movements,
    powers,
    products,
    reductions,
    replaced,
    slopes,
)
from lanes.test_recorded_texts import VERSION, said
from recorded import Record
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.pivoted_cholesky import newton_basis, pivoted_cholesky

Body = Callable[..., Any]


def of_a_row(found: Any, rows: int) -> Any:
    """Results with a dimension of rows, also those that have none."""
    if not isinstance(found, Tensor):
        return found if found == () else type(found)(of_a_row(part, rows) for part in found)
    return found if found.shape[:1] == (rows,) else found.unsqueeze(0)


def cpp(body: Body, *rows: Tensor, dtype: torch.dtype = torch.float64, copies: int = 0) -> Any:
    """What is said of the C++ of a function of what a row has once, computed anew at every step."""
    given = tuple(row.to(dtype) if row.is_floating_point() else row for row in rows)

    def step(carry: Tensor, now: Any, row: tuple[Tensor, ...]) -> tuple[Tensor, Any]:
        moved = (carry.reshape(-1, *[1] * (part.dim() - 1)) + part for part in row)
        return 0.5 * carry, of_a_row(body(*moved), len(carry))

    carry = torch.zeros(len(rows[0]), dtype=dtype)
    return said(lanes.Program(step, copies=copies).text(carry, (), given, steps=1))


def of_rows(body: Body, *rows: Tensor, dtype: torch.dtype = torch.float64, copies: int = 0) -> Any:
    """The same of what is computed once."""
    given = tuple(row.to(dtype) if row.is_floating_point() else row for row in rows)
    program = lanes.Program(lambda carry, now, row: (carry, of_a_row(body(*row), len(carry))), copies=copies)
    return said(program.text(torch.zeros(len(rows[0]), dtype=dtype), (), given, steps=1))


def c(body: Body, *rows: Tensor, dtype: torch.dtype = torch.float64) -> Any:
    """What is said of the C of a function of rows."""
    given = tuple(row[:1].to(dtype) if row.is_floating_point() else row[:1] for row in rows)
    program = lanes.Program(lambda carry, now, row: ((), of_a_row(body(*row), len(row[0]))))
    return said(program.c_source("f", row=given))


def x(*shape: int) -> Tensor:
    return uniform(2, *shape, seed=1)


def i(*shape: int) -> Tensor:
    return torch.arange(torch.Size(shape).numel()).reshape(1, *shape).repeat(2, *[1] * len(shape)) % 3


def large(a: Tensor) -> list[Tensor]:
    """Of (B, n): maps, sums and products that are loops from 65 entries on."""
    n = a.shape[-1]
    table = torch.arange(n, dtype=a.dtype) / n
    matrix = torch.arange(3 * n, dtype=a.dtype).reshape(n, 3)
    y = a.sin() * 0.5 + a.roll(1, -1)
    return [
        *(
            y,
            y.sum(-1),
            y @ matrix,
            (y * table).sum(-1),
            y.amax(-1),
            y.amin(-1),
            (y > 0).any(-1),
            (y > 0).all(-1),
        ),
        *(
            y.mean(-1),
            y.prod(-1),
            y.norm(dim=-1),
            torch.where(y > 0, y, 0.0),
            y.cumsum(-1)[:, -1],
            a * a[:, :1],
            a.flip(-1) + 1,
        ),
        *(
            (y.square() * table).sum(-1),
            torch.linalg.vecdot(a, y),
            a[:, ::2] * 2,
            torch.cat((a, y), 1).exp(),
            a + table,
            -a.abs(),
        ),
        *(
            table * 2 + a,
            a.clamp(-1, 1),
            a.long(),
            (a > 0).to(a),
            a.unsqueeze(-1) * a[:, :2].unsqueeze(1),
            a.max(-1)[0],
            a.argmax(-1),
        ),
        *(
            torch.stack((a, y), -1).sum(-1),
            a.reshape(-1, n).exp().sum(-1) * y[:, 0],
            (a != a).any(-1),
            a.cos().flip(-1).tanh(),
        ),
    ]


def decomposed(a: Tensor) -> list[Tensor]:
    """Of (B, n, n): every factorisation."""
    gram = a @ a.mT + torch.eye(a.shape[-1], dtype=a.dtype)
    factor, failed = torch.linalg.cholesky_ex(gram)
    return [
        *(
            factor,
            failed,
            torch.linalg.cholesky(gram, upper=True),
            torch.cholesky_solve(a, factor),
            torch.linalg.inv(gram),
        ),
        *(
            torch.linalg.solve(a, a[..., :1]),
            torch.linalg.solve(a, a[..., 0]),
            torch.linalg.solve(a, a[..., :1, :], left=False),
        ),
        *(
            torch.linalg.solve_triangular(a, a, upper=upper, unitriangular=unit)
            for upper in (True, False)
            for unit in (True, False)
        ),
        *(
            torch.linalg.solve_triangular(a, a, upper=True, left=False),
            *torch.linalg.qr(a),
            *torch.linalg.eigh(gram),
        ),
        *(torch.linalg.eigvalsh(gram), torch.linalg.det(a), *torch.linalg.slogdet(a), torch.logdet(gram)),
        torch.cholesky_solve(a, factor.mT, upper=True),
    ]


def pivoted(gram: Tensor) -> list[Tensor]:
    found = pivoted_cholesky(gram)
    return [
        *found,
        found.kept(),
        found.solve_lower(gram[..., 0]),
        found.solve_upper(gram[..., 1]),
        newton_basis(gram),
    ]


def points(a: Tensor, k: int) -> list[Tensor]:
    """Of (B, P, 3)."""
    return [
        *(lanes.reduce(lambda p: p.square().sum(-1), a, operation) for operation in ("sum", "max", "min")),
        *(
            lanes.each(lambda p: p.exp() * 0.5, a, together=k),
            lanes.reduce(lambda p: p.cos(), a.mT, "sum", dim=2),
        ),
        lanes.each(lambda p: p.sin(), a.mT, dim=2),
    ]


def loops(a: Tensor, b: Tensor) -> list[Any]:
    """Of (B, P, n) and (B, n): loops in loops, of arrays and numbers, and of what no pass changes."""

    def walk(now: Any, p: Tensor) -> tuple[Any, Any]:
        one, other, count, still = now
        inner = lanes.repeat(3, lambda z: 0.5 * z + p, one)
        return (other, inner * p.abs(), count + 1, still), (inner, count, p.sum(-1))

    start = b, b.abs(), torch.zeros_like(b[:, 0], dtype=torch.int64), b[:, 0] > 0
    ends, kept = lanes.scan(walk, start, a)
    unrolled = lanes.scan(lambda s, p: (s + p.exp(), s[..., 0]), b, a, unrolled=True)
    constant = lanes.repeat(5, lambda z: (2 * z[0], z[1] + z[0]), (b.sin(), b.cos()))
    masked = lanes.repeat(9, lambda z: (z[0] * 2, z[1] + 1), (b, b[:, 0]), where=lambda z: z[1] < 4)
    unused = lanes.scan(lambda s, p: ((s[0] + p, s[1] * p), (s[0], s[1], p)), (b, b), a)[1][0]
    swapped = lanes.repeat(4, lambda z: (z[1], z[0]), (b, b.exp()))
    return [ends, kept, unrolled, constant, masked, unused, swapped]


def carried(state: Any, now: Tensor, row: Any) -> Any:
    """A carry of 64 and of 65 entries, numbers, a flag and a count; outputs of eight and of nine entries."""
    few, many, flag, count = state
    u, gain = now.unsqueeze(-1), row
    moved = torch.where(flag.unsqueeze(-1), many.roll(1, -1) * u + gain, many)
    fine = torch.isfinite(few).all(-1) & (now > 0)
    new = torch.where(fine.unsqueeze(-1), 0.5 * few + u * gain[:, :64], few)
    count = torch.where(fine, count + 1, count)
    return (new, moved, moved[:, 0] > 0, count), (few[:, :8], many[:, :9], flag, count, now.exp().sin() * now)


SMALL, FLAT = (3,), (2, 3, 2)
CASES: dict[str, Callable[[], Any]] = {
    **{
        f"of one in {d}": lambda d=d: [
            cpp(lambda a: by_name(ONE, a), x(3), dtype=d),
            c(lambda a: by_name(ONE, a), x(3), dtype=d),
        ]
        for d in (torch.float64, torch.float32)
    },
    **{
        f"of two in {d}": lambda d=d: [
            cpp(lambda a, b: by_name(TWO, a, b), x(3), x(3) + 2, dtype=d),
            c(lambda a, b: by_name(TWO, a, b), x(3), x(3) + 2, dtype=d),
        ]
        for d in (torch.float64, torch.float32)
    },
    "powers": lambda: [
        cpp(powers, x(3), x(3) + 2),
        c(powers, x(3), x(3) + 2),
        c(powers, x(3), x(3) + 2, dtype=torch.float32),
    ],
    "arithmetic": lambda: [
        cpp(arithmetic, x(3), x(3) + 2),
        c(arithmetic, x(3), x(3) + 2),
        cpp(arithmetic, x(3), x(3), dtype=torch.float32, copies=2),
    ],
    "logic": lambda: [
        cpp(logic, x(3), x(3) + 2),
        c(logic, x(3), x(3) + 2),
        of_rows(logic, x(3), x(3), copies=3),
    ],
    "integers": lambda: [
        of_rows(integers, x(3), i(3), dtype=torch.float32),
        c(integers, x(3), i(3), dtype=torch.float32),
    ],
    "blank": lambda: [of_rows(blank, x(3)), c(blank, x(3))],
    "reductions": lambda: [cpp(reductions, x(*FLAT)), c(reductions, x(*FLAT))],
    "products": lambda: [cpp(products, x(3, 2), x(2, 3)), c(products, x(3, 2), x(2, 3))],
    "slopes": lambda: [cpp(slopes, x(3, 2), x(2, 3)), c(slopes, x(3, 2), x(2, 3))],
    "movements": lambda: [cpp(movements, x(3, 3)), c(movements, x(3, 3))],
    **{
        f"choices of {n}": lambda n=n: [of_rows(choices, x(n, n), i(n)), c(choices, x(n, n), i(n))]
        for n in (3, 4, 6)
    },
    "replaced": lambda: [cpp(replaced, x(4)), c(replaced, x(4))],
    **{
        f"large, {n}": lambda n=n: [
            cpp(large, x(n)),
            of_rows(large, x(n), copies=2),
            c(large, x(n)),
            cpp(large, x(n), dtype=torch.float32),
        ]
        for n in (64, 65)
    },
    **{
        f"products of {n}": lambda n=n: [
            cpp(
                lambda a: [a @ a, a @ a[..., :1], a.mT @ a.exp(), a @ torch.ones(n, 2, dtype=a.dtype)],
                x(n, n),
                copies=k,
            )
            for k in (0, 1, 2)
        ]
        for n in (4, 8, 9)
    },
    **{
        f"decomposed, {n}": lambda n=n: [of_rows(decomposed, x(n, n)), c(decomposed, x(n, n))] for n in (1, 3)
    },
    **{f"decomposed, {n}": lambda n=n: [of_rows(decomposed, x(n, n))] for n in (8, 9)},
    **{f"pivoted, {n}": lambda n=n: [of_rows(pivoted, x(n, n)), cpp(pivoted, x(n, n))] for n in (2, 8, 9)},
    **{
        f"points, {p} by {k}": lambda p=p, k=k: [
            cpp(lambda a: points(a, k), x(p, 3)),
            c(lambda a: points(a, k), x(p, 3)),
        ]
        for p, k in ((1, 4), (2, 1), (3, 2), (4, 4), (5, 4), (30, 8))
    },
    **{
        f"loops of {n}": lambda n=n: [
            cpp(loops, x(4, n), x(n)),
            of_rows(loops, x(4, n), x(n), copies=2),
            c(loops, x(4, n), x(n)),
        ]
        for n in (2, 64, 65)
    },
    "a carry": lambda: [
        said(
            lanes.Program(carried, copies=k).text(
                (x(64).to(d), x(65).to(d), x(1)[:, 0] > 0, torch.zeros(2, dtype=torch.int64)),
                x(4).to(d),
                x(65).to(d),
            )
        )
        for k, d in ((0, torch.float64), (1, torch.float64), (3, torch.float32))
    ],
    "a carry in c": lambda: said(
        lanes.Program(carried).c_source(
            "f",
            (x(64)[:1].round(), x(65)[:1].round(), x(1)[:1, 0] > 0, torch.zeros(1, dtype=torch.int64)),
            x(4)[:1],
            x(65)[:1],
            note="of\na */ test",
        )
    ),
}


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
@pytest.mark.parametrize("name", CASES)
def test_the_text_of_a_form_is_the_recorded(name: str, record: Record) -> None:
    if record.known().get("torch", VERSION) == VERSION:
        record({"torch": VERSION, "text": CASES[name]()})
