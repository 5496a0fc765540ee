"""What is written down of a step, computed node by node in Python, is what torch computes."""

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
from helpers_interpreter import check
from lanes.test_recorded_forms import decomposed, large, loops, points
from torch import Tensor

from staf_torch import lanes


def x(*shape: int) -> Tensor:
    return uniform(2, *shape, seed=1)


def i(*shape: int) -> Tensor:
    return torch.arange(torch.Size(shape).numel()).reshape(1, *shape).repeat(2, *[1] * len(shape)) % 3


def leaves(found: Any) -> list[Tensor]:
    """A nested tree of results as a list."""
    return [found] if isinstance(found, Tensor) else [leaf for part in found for leaf in leaves(part)]


def without_signs(a: Tensor) -> list[Tensor]:
    """Factorisations, of eigenvectors the sizes of their entries."""
    return [part.abs() if k == 16 else part for k, part in enumerate(decomposed(a))]


def at(*shape: int, of: int) -> Tensor:
    """Places that rows have: (2, ...), of which some are equal."""
    return (7 * torch.arange(2 * torch.Size(shape).numel()) % 5 % of).view(2, *shape)


def more_choices(a: Tensor, k: Tensor) -> list[Tensor]:
    """Of (B, 3, 4, 5) and (B, 2, 2, 2): an index that is smaller than the tensor in every dimension."""
    return [
        *(a.gather(dim, k) for dim in (1, 2, 3, -1, -2)),
        *(a.scatter(dim, k, a[:, 1:, 1:, 2:]) for dim in (1, 2, 3, -1)),
        *(a.scatter(dim, k, 0.5) for dim in (1, 3)),
        *(a.scatter_add(dim, k, a[:, :2, :2, :2]) for dim in (1, 2, 3, -1)),
        *(torch.take_along_dim(a[:, :2, :2, :2], k, dim) for dim in (1, 2, 3)),
        a[:, k[0, 0, 0]],
        a[:, :, k[0, 0]],
        a.index_select(3, k[0, 1, 1]),
        torch.index_select(a, -1, k[0, 0, 0]).sin(),
    ]


def written(a: Tensor, k: Tensor) -> list[Tensor]:
    """Of (B, 3, 4) and (B, 3): entries that are written and added at places that the code or a row says."""
    b, c = a.clone(), a.clone()
    b[:, 1, 2:] = a[:, 0, :2]
    b[a > 0.5] = 0.25
    c[:, torch.tensor([0, 2, 0])] += 2 * a
    c[..., 1] *= a[..., 0]
    return [
        *(b, c, a.clone().masked_fill_(a < 0, 3.0)),
        a.index_put((torch.tensor([0]), torch.tensor([2, 2, 0])), a[:, 1, :1].expand(-1, 4), accumulate=True)
        if len(a) == 1
        else a,
        *(torch.nn.functional.pad(a, pad, value=v) for pad, v in (([1, 2], 0.0), ([0, 1, 2, 0], 1.5))),
        torch.nn.functional.pad(a, [2, 1]),
        *(
            a.index_add(1, torch.tensor([2, 2]), a[:, :2], alpha=3),
            a.index_copy(2, torch.tensor([3]), a[..., :1]),
        ),
        *(torch.nn.functional.one_hot(k, 5), a.take_along_dim(k.unsqueeze(-1), 2)),
        *(a.tril(-1), a.triu(1), a.roll((1, -1), (1, 2)), a.flip(1, 2), a.diagonal(1, 1, 2).diag_embed(1)),
    ]


def rounded(a: Tensor) -> list[Tensor]:
    """Of (B, n): digits that are kept, and running sums, products and extremes of either sign."""
    a = 37.7 * a
    return [
        *(a.round(decimals=d) for d in (-2, -1, 0, 1, 2)),
        *(
            a.fmod(2.5),
            a.remainder(2.5),
            a.remainder(-2.5),
            -a % 3,
            a // 2.5,
            torch.div(a, 3, rounding_mode="trunc"),
        ),
        *(a.cumsum(1), (a / 9).cumprod(1), *a.cummax(1), *a.cummin(1), *a.max(1), *a.min(1)),
        *(a.argmax(1), a.argmin(1), a.amax(1, keepdim=True), a.std(1), a.var(1, correction=0), a.mean(1)),
        *(a.norm(p, 1) for p in (1, 2, float("inf"))),
        *(torch.add(a, a.cos(), alpha=3), torch.sub(a, a.cos(), alpha=0.5), torch.rsub(a, 2.0)),
        *(torch.addcmul(a, a, a.sin(), value=0.3), torch.addcdiv(a, a, a.exp() + 1, value=-2.0)),
        *(a.lerp(a.sin(), 0.3), a**64, a**3, a.abs() ** 65, a.abs() ** -0.5, a**-3, a**0, a.abs() ** 0.5),
        *(
            a.abs() ** torch.tensor([2.0, 0.5, -1.0, 7.0])[: a.shape[1]],
            1.5 ** a.sin(),
            a.clamp(min=0.5),
            a.clamp(max=1.0),
        ),
    ]


def nested(a: Tensor, b: Tensor) -> list[Tensor]:
    """Of (B, 4, 2) and (B, 2): loops that end where a row says, of few passes, in each other."""
    once = lanes.repeat(1, lambda z: z * 2 + b, b)
    none = lanes.repeat(0, lambda z: z * 2 + b, b)
    some = [
        lanes.repeat(k, lambda z: z * 1.5, b.abs() + 0.1, where=lambda z: z.sum(-1) < 2.0)
        for k in (0, 1, 2, 9)
    ]
    never = lanes.repeat(4, lambda z: z + 1, b, where=lambda z: z[:, 0] > 99)
    flag = b[:, 0] > 0
    held = lanes.repeat(3, lambda z: z + 1, b, where=lambda z: flag)
    twice = lanes.repeat(2, lambda z: lanes.repeat(3, lambda y: 0.5 * y + z, z), b)
    ends, kept = lanes.scan(
        lambda s, p: (
            lanes.repeat(2, lambda y: 0.5 * y + p, s),
            lanes.scan(lambda c, q: (c + q, c), s, a)[1],
        ),
        b,
        a,
    )
    least = [
        lanes.reduce(lambda p: p.cos().sum(-1), a[:, :n], o)
        for n in (1, 2, 3, 4)
        for o in ("sum", "max", "min")
    ]
    every = [
        lanes.each(lambda p: p * b.unsqueeze(1), a[:, :n], together=k)
        for n, k in ((4, 1), (4, 3), (3, 4), (4, 4))
    ]
    along = lanes.scan(lambda s, p: (s + p, s * p), b[:, :1].expand(-1, 4), a, dim=2)
    still = lanes.repeat(3, lambda z: (z[0] + 1, z[1]), (b, b.sin()))
    return [once, none, *some, never, held, twice, ends, kept, *least, *every, *along, *still]


FORMS: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
    **{f"{name}": (lambda a, name=name: by_name([name], a), (x(3),)) for name in ONE},
    **{f"{name}": (lambda a, b, name=name: by_name([name], a, b), (x(3), x(3) + 2)) for name in TWO},
    "powers": (powers, (x(3), x(3) + 2)),
    "arithmetic": (arithmetic, (x(3), x(3) + 2)),
    "logic": (logic, (x(3), x(3) + 2)),
    "integers": (integers, (x(3).float(), i(3))),
    "blank": (blank, (x(3),)),
    "reductions": (reductions, (x(2, 3, 2),)),
    "products": (products, (x(3, 2), x(2, 3))),
    "slopes": (slopes, (x(3, 2), x(2, 3))),
    "movements": (movements, (x(3, 3),)),
    **{f"choices of {n}": (choices, (x(n, n), i(n))) for n in (3, 6)},
    "replaced": (replaced, (x(4),)),
    "large": (large, (x(65),)),
    "decomposed": (without_signs, (x(3, 3) + 3 * torch.eye(3),)),
    "choices in three dimensions": (more_choices, (x(3, 4, 5), at(2, 2, 2, of=2))),
    "writes": (written, (x(3, 4), at(3, of=4))),
    "digits": (rounded, (x(4),)),
    "nested": (nested, (x(4, 2), x(2))),
    "points": (lambda a: points(a, 2), (x(5, 3),)),
    **{f"loops of {n}": (lambda a, b: leaves(loops(a, b)), (x(4, n), x(n))) for n in (2, 65)},
}


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
@pytest.mark.parametrize("name", FORMS)
def test_a_program_computes_what_torch_does(name: str) -> None:
    body, rows = FORMS[name]
    check(body, *rows)


def test_numbers_that_are_captured_are_the_same_in_the_text_and_in_the_table() -> None:
    gain, flags = torch.tensor([2.0, -0.5, 3.0], dtype=torch.float64), torch.tensor([True, False, True])

    def body(a: Tensor) -> list[Tensor]:
        return [
            a * gain + gain.exp(),
            torch.where(flags, a, gain[0]),
            (a @ gain).unsqueeze(-1),
            a ** gain.abs(),
        ]

    check(body, x(3).abs())
    check(body, x(3).abs(), folded=True)
