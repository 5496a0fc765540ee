"""Every operation of torch that has a scalar form, in lists, for tests of texts and of what they compute."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

ONE = (
    *(
        "neg",
        "abs",
        "sqrt",
        "exp",
        "expm1",
        "log",
        "log1p",
        "sin",
        "cos",
        "tan",
        "tanh",
        "asin",
        "acos",
        "atan",
    ),
    *("sinh", "cosh", "asinh", "acosh", "atanh", "log2", "log10", "exp2", "erf", "erfc", "lgamma", "floor"),
    *(
        "ceil",
        "trunc",
        "reciprocal",
        "rsqrt",
        "sigmoid",
        "round",
        "frac",
        "sign",
        "isnan",
        "isinf",
        "isfinite",
    ),
    *("square", "relu", "logical_not", "positive", "deg2rad", "sinc"),
)
TWO = (
    *(
        "add",
        "sub",
        "rsub",
        "mul",
        "div",
        "fmod",
        "remainder",
        "atan2",
        "hypot",
        "copysign",
        "maximum",
        "minimum",
    ),
    *("pow", "lt", "le", "gt", "ge", "eq", "ne", "logical_and", "logical_or", "logical_xor", "floor_divide"),
    *("true_divide", "fmin", "fmax", "max", "min", "xlogy", "logaddexp"),
)
POWERS = (0.5, 0, 1, 2, 3, 5, -1, -2, -0.5, 2.5, 64, 65, -64, 63.0)


def by_name(names: Sequence[str], *given: Tensor) -> list[Tensor]:
    return [getattr(torch, name)(*given) for name in names]


def powers(a: Tensor, b: Tensor) -> list[Tensor]:
    found = [a.pow(power) for power in POWERS]
    exponents = torch.tensor([2.0, -1.0, 0.5], dtype=a.dtype)
    return [*found, a.pow(exponents), a.pow(torch.tensor(3.0)), torch.pow(2.0, a), a.pow(b), a.pow(b.round())]


def arithmetic(a: Tensor, b: Tensor) -> list[Tensor]:
    return [
        *(a.add(b, alpha=2), a.sub(b, alpha=2), a.add(1.0, alpha=3), torch.rsub(a, 2.0), 3.0 - a, 1 / a),
        *(torch.div(a, b, rounding_mode=mode) for mode in (None, "floor", "trunc")),
        *(torch.round(a, decimals=2), torch.round(a, decimals=-1), torch.round(a, decimals=0)),
        *(a.clamp(-1, 1), a.clamp(min=0.5), a.clamp(max=0.25), a.clamp(b, b + 1), a.clamp_min(b)),
        *(a.clamp_max(2.0), a.clamp_min(-2.0), torch.addcmul(a, b, b), torch.addcmul(a, a, b, value=0.5)),
        *(torch.addcdiv(a, b, a), torch.addcdiv(a, a, b, value=2.0), torch.lerp(a, b, 0.25)),
        *(
            torch.lerp(a, b, a),
            a.masked_fill(a > b, 2.0),
            torch.where(a > 0, a, 0.5),
            torch.where(a > 0, 1.0, b),
        ),
        *(
            torch.where(a > b, b, a),
            a.sign(),
            a * 1,
            a / 4,
            a / -1,
            a.neg().neg(),
            (-a).abs(),
            a.sub(-b),
            a + -b,
        ),
        *(
            a * 0,
            a + 0.0,
            a - 0.0,
            -0.0 - a,
            0.0 - a,
            a * -1.0,
            a / 1,
            a / 3,
            a.abs().abs(),
            2.0 * a + 2.0 * a,
        ),
    ]


def logic(a: Tensor, b: Tensor) -> list[Tensor]:
    p, q = a > 0, b > 0
    return [
        *(p & q, p | q, p ^ q, ~p, p & p, p | p, p * q, p.logical_and(q), p.logical_or(a), ~~p, p & ~q),
        *(p & True, p | True, p & False, p | False, p ^ True, p == q, p != q, p + q, p.to(a) - 1, a.bool()),
        *(torch.where(p, True, False) & q, torch.where(p, False, True), torch.where(p, q, False)),
        *(
            torch.where(~p, a, b),
            torch.where(p, a, a),
            p < q,
            p.sum(-1),
            p.long().sum(-1),
            p.any(-1),
            p.all(-1),
        ),
    ]


def integers(a: Tensor, k: Tensor) -> list[Tensor]:
    return [
        *(
            k + 1,
            k * 2,
            k // 2,
            k % 2,
            k - a,
            k.to(a.dtype),
            a.long(),
            a.int() + k,
            k.float(),
            k / 2,
            -k,
            k.abs(),
        ),
        *(k.clamp(0, 1), k.sign(), k == 1, k < a, k.bool(), (a > 0).long() * k, torch.fmod(k, 2), k.pow(2)),
        *(torch.remainder(k, 2), k.sum(-1), k.prod(-1), k.cumsum(-1), k.max(-1)[0], k.argmax(-1), k.floor()),
        *(
            torch.div(k, 2, rounding_mode="trunc"),
            torch.div(k, 2),
            k.ceil(),
            k.trunc(),
            k.round(),
            k.square(),
        ),
        *(torch.maximum(k, k.flip(-1)), torch.where(k > 1, k, 0), k.to(torch.bool) & (a > 0)),
    ]


def blank(a: Tensor) -> list[Tensor]:
    filled, zeroed = a.clone(), a.clone()
    filled.fill_(2.0), zeroed.zero_()
    return [
        *(torch.zeros_like(a) + a, torch.ones_like(a) * a, torch.full_like(a, 2.0) * a, a.new_zeros(3) + a),
        *(a.new_ones(3) + a, a.new_full((3,), 0.5) * a, filled + a, zeroed + a, a.clone(), a.contiguous()),
        *(a.to(torch.float64), a.detach() + 1, torch.zeros_like(a, dtype=torch.int64)),
        torch.ones_like(a, dtype=torch.bool),
    ]


def reductions(a: Tensor) -> list[Tensor]:
    """Of (B, 2, 3, 2)."""
    found = [a.sum(), a.sum(1), a.sum((1, 3)), a.sum(-1, keepdim=True), a.sum((1, 2, 3), keepdim=True)]
    found += [a.mean(), a.mean(2), a.mean((1, -1), keepdim=True), a.mean((1, 2, 3))]
    for name in ("amax", "amin"):
        found += [getattr(a, name)(dims, keepdim=keep) for dims in (1, (1, 3), ()) for keep in (True, False)]
    for name in ("max", "min", "argmax", "argmin"):
        found += [getattr(a, name)()]
        for dim in (1, -1):
            one, other = getattr(a, name)(dim), getattr(a, name)(dim, keepdim=True)
            found += [*one, *other] if isinstance(one, tuple) else [one, other]
    found += [
        (a > 0).all(),
        (a > 0).all(1),
        (a > 0).any(-1, keepdim=True),
        (a > 0).any(),
        a.prod(),
        a.prod(2),
    ]
    found += [a.prod(-1, keepdim=True), a.cumsum(1), a.cumsum(-1), a.flatten(1).cumsum(1), a[:, :0].sum(1)]
    for order in (1, 2, float("inf")):
        found.append(torch.linalg.vector_norm(a, order, (1, 2)))
    return [
        *found,
        torch.linalg.vector_norm(a, 2, -1, keepdim=True),
        a.norm(),
        a.norm(dim=(1, 2)),
        a.std(1),
        a.var(-1),
    ]


def products(a: Tensor, b: Tensor) -> list[Tensor]:
    """Of (B, 3, 2) and (B, 2, 3)."""
    return [
        *(a @ b, b @ a, a @ b[..., 0:1], torch.linalg.vecdot(a, b.mT), torch.mv(a[0], b[0, :, 0])),
        *(torch.addmm(b[0] @ a[0], b[0], a[0]), torch.baddbmm(b @ a, b, a), torch.dot(a[0, 0], b[0, :, 0])),
        *(
            torch.addmv(a[0, :, 0], a[0], b[0, :, 0]),
            torch.vdot(a[0, 0], a[0, 1]),
            torch.einsum("bij,bjk->bik", a, b),
        ),
        *(
            torch.outer(a[0, 0], b[0, 0]),
            torch.cdist(a, b.mT),
            torch.cdist(a, b.mT, p=1.0),
            torch.trace(a[0, :2]),
        ),
        *(
            torch.cdist(a, b.mT, p=float("inf")),
            torch.linalg.cross(a.mT, b),
            torch.kron(a[0], b[0]),
            a.mT.matmul(b.mT),
        ),
    ]


def slopes(a: Tensor, b: Tensor) -> list[Tensor]:
    """Derivatives, which read entries back: of (B, 3, 2) and (B, 2, 3)."""
    of = [
        lambda z: torch.cdist(z, b.mT).sum(),
        lambda z: z.prod(1).sum(),
        lambda z: z[:, [0, 0, 2]].square().sum(),
        lambda z: (z.amax(1) * z.logsumexp(1)).sum(),
        lambda z: z.cumsum(1).sin().sum() + z.diagonal(dim1=1, dim2=2).prod(-1).sum(),
        lambda z: (
            torch.where(z > 0, z, z * z).mean() + z.clamp(-1, 1).sum() + z.roll(1, 1).select(1, 0).exp().sum()
        ),
        lambda z: (z[:, 1:] / z[:, :-1]).atan().sum() + z.norm(dim=1).sum() + z.abs().sqrt().sum(),
        lambda z: torch.nn.functional.softplus(z).sum() + z.softmax(1).square().sum() + z.tanh().sum(),
    ]
    return [torch.func.grad(f)(a) for f in of] + [torch.func.jvp(f, (a,), (a.sin(),))[1] for f in of[1:4]]


def movements(a: Tensor) -> list[Tensor]:
    """Of (B, 3, 3)."""
    at, column = torch.tensor([2, 0]), a[:, :, 0]
    filled, second, third = a.clone(), a.clone(), a.clone()
    filled[:, 1], second[:, :, 1:] = column, 0.25
    third[:, at] = third[:, [0, 1]] * 2
    third[:, 0, 0] += 1
    return [
        *(
            torch.cat((a, a[:, :1]), 1),
            torch.cat((a, torch.zeros_like(a)), 2),
            torch.stack((column, column + 1), 1),
        ),
        *(
            a[:, at],
            a[:, [1, 1], [0, 2]],
            a[:, at[:, None], at],
            a.flip(1),
            a.flip((1, 2)),
            a.roll(1, 2),
            a.roll(-1, 1),
        ),
        *(
            a.repeat(1, 2, 1),
            a.tril(),
            a.triu(1),
            a.tril(-1),
            torch.diag_embed(column),
            a.diagonal(dim1=1, dim2=2) + 1,
        ),
        *(
            torch.nn.functional.pad(a, (1, 2, 0, 1)),
            torch.nn.functional.pad(a, (0, 1), value=2.0),
            filled,
            second,
            third,
        ),
        *(
            a.index_select(2, at),
            a.index_add(1, at, a[:, 1:]),
            a.index_copy(2, at, a[:, :, :2]),
            a.index_fill(1, at, 2.0),
        ),
        *(
            a.index_put((torch.arange(1), at[:1]), a[:, 1]),
            torch.take_along_dim(a, at.view(1, 2, 1).expand(1, 2, 3), 1),
        ),
        *(
            a.index_put((torch.tensor([0, 0]), torch.tensor([1, 1])), a[:, 0], accumulate=True),
            a.unfold(1, 2, 1) + 1,
        ),
        *(
            a.gather(1, at.view(1, 2, 1).expand(1, 2, 3)),
            a.scatter(2, at.view(1, 1, 2).expand(1, 3, 2), a[:, :, 1:]),
        ),
        *(
            a.scatter(1, at.view(1, 1, 2).expand(1, 1, 2), 2.0),
            a.scatter_add(1, at.view(1, 2, 1).expand(1, 2, 2), a),
        ),
        *(
            torch.select_scatter(a, column, 2, 1),
            torch.slice_scatter(a, a[:, :2], 1, 1, 3),
            a.mT + a,
            a.movedim(1, 2) - a,
        ),
        *(
            torch.diagonal_scatter(a, column, 0, 1, 2),
            a.reshape(-1, 9).unsqueeze(1) * 2,
            a.narrow(1, 1, 2) - 1,
            a.rot90(1, (1, 2)),
        ),
    ]


def choices(a: Tensor, k: Tensor) -> list[Tensor]:
    """Of (B, n, n), at places (B, n) that a row computes."""
    wide = k.unsqueeze(-1).expand_as(a)
    return [
        *(
            a.gather(1, wide),
            a.gather(2, wide.mT),
            a.gather(1, wide[:, :2]),
            a.gather(1, wide[:, :2, :2]),
            a.scatter(2, wide[:, :2], a),
            a.scatter(1, wide, a.sin()),
            a.scatter(2, wide, 0.5),
        ),
        *(
            a.scatter_add(1, wide, a * a),
            a.scatter_add(2, wide[:, :2], a),
            torch.arange(a.shape[-1], dtype=a.dtype)[k] * a[:, 0],
        ),
        *(
            a[0, k[0]],
            a[0][:, k[0]],
            a[0].index_select(1, k[0]),
            (a > 0).gather(1, wide),
            a.scatter(1, wide[:, :1, :2], a),
        ),
        torch.func.grad(lambda z: z.gather(1, wide).square().sum())(a),
    ]


def replaced(a: Tensor) -> list[Tensor]:
    """Of (B, 4)."""
    edges = torch.tensor([-0.5, 0.0, 0.5], dtype=a.dtype)
    found = [*a.sort(-1), *a.sort(-1, descending=True), *a.topk(2), *a.topk(2, largest=False), *a.kthvalue(2)]
    found += [
        *a.kthvalue(3, keepdim=True),
        *a.median(-1),
        *a.median(-1, keepdim=True),
        a.median(),
        *a.cummax(-1),
    ]
    found += [
        *a.cummin(-1),
        a.cumprod(-1),
        a.var(-1),
        a.std(-1),
        a.angle(),
        torch.fmin(a, a.flip(-1)),
        a.argsort(-1),
    ]
    found += [
        torch.searchsorted(edges, a.contiguous()),
        torch.bucketize(a, edges, right=True),
        torch.fmax(a, a.flip(-1)),
    ]
    found += [
        torch.searchsorted(edges, a.contiguous(), side="right", out_int32=True),
        a.quantile(0.25, -1),
        a.nanmean(-1),
    ]
    return [*found, torch.nn.functional.one_hot(a.argmax(-1), 4), a.cumprod(0), a.nan_to_num(0.5)]
