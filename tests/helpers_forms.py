"""Every operation of torch that has a scalar form, in lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from staf_torch import lanes

# fmt: off
ONE = (
    'neg', 'abs', 'sqrt', 'exp', 'expm1', 'log', 'log1p', 'sin', 'cos', 'tan', 'tanh', 'asin', 'acos',
    'atan', 'sinh', 'cosh', 'asinh', 'acosh', 'atanh', 'log2', 'log10', 'exp2', 'erf', 'erfc', 'lgamma',
    'floor', 'ceil', 'trunc', 'reciprocal', 'rsqrt', 'sigmoid', 'round', 'frac', 'sign', 'isnan', 'isinf',
    'isfinite', 'square', 'relu', 'logical_not', 'positive', 'deg2rad', 'sinc',
)
TWO = (
    'add', 'sub', 'rsub', 'mul', 'div', 'fmod', 'remainder', 'atan2', 'hypot', 'copysign', 'maximum',
    'minimum', 'pow', 'lt', 'le', 'gt', 'ge', 'eq', 'ne', 'logical_and', 'logical_or', 'logical_xor',
    'floor_divide', 'true_divide', 'fmin', 'fmax', 'max', 'min', 'xlogy', 'logaddexp',
)
POWERS = (0.5, 0, 1, 2, 3, 5, -1, -2, -0.5, 2.5, 64, 65, -64, 63.0)


def by_name(names: Sequence[str], *given: Tensor) -> list[Tensor]:
    return [getattr(torch, name)(*given) for name in names]


def powers(a: Tensor, b: Tensor) -> list[Tensor]:
    found = [a.pow(power) for power in POWERS]
    exponents = torch.tensor([2.0, -1.0, 0.5], dtype=a.dtype)
    return [
        *found, a.pow(exponents), a.pow(torch.tensor(3.0)), torch.pow(2.0, a), a.pow(b), a.pow(b.round()),
    ]


def arithmetic(a: Tensor, b: Tensor) -> list[Tensor]:
    return [
        a.add(b, alpha=2), a.sub(b, alpha=2), a.add(1.0, alpha=3), torch.rsub(a, 2.0), 3.0 - a, 1 / a,
        *(torch.div(a, b, rounding_mode=mode) for mode in (None, 'floor', 'trunc')),
        torch.round(a, decimals=2), torch.round(a, decimals=-1), torch.round(a, decimals=0), a.clamp(-1, 1),
        a.clamp(min=0.5), a.clamp(max=0.25), a.clamp(b, b + 1), a.clamp_min(b), a.clamp_max(2.0),
        a.clamp_min(-2.0), torch.addcmul(a, b, b), torch.addcmul(a, a, b, value=0.5),
        torch.addcdiv(a, b, a), torch.addcdiv(a, a, b, value=2.0), torch.lerp(a, b, 0.25),
        torch.lerp(a, b, a), a.masked_fill(a > b, 2.0), torch.where(a > 0, a, 0.5),
        torch.where(a > 0, 1.0, b), torch.where(a > b, b, a), a.sign(), a * 1, a / 4, a / -1, a.neg().neg(),
        (-a).abs(), a.sub(-b), a + -b, a * 0, a + 0.0, a - 0.0, -0.0 - a, 0.0 - a, a * -1.0, a / 1, a / 3,
        a.abs().abs(), 2.0 * a + 2.0 * a,
    ]


def logic(a: Tensor, b: Tensor) -> list[Tensor]:
    p, q = (a > 0, b > 0)
    return [
        p & q, p | q, p ^ q, ~p, p & p, p | p, p * q, p.logical_and(q), p.logical_or(a), ~~p, p & ~q,
        p & True, p | True, p & False, p | False, p ^ True, p == q, p != q, p + q, p.to(a) - 1, a.bool(),
        torch.where(p, True, False) & q, torch.where(p, False, True), torch.where(p, q, False),
        torch.where(~p, a, b), torch.where(p, a, a), p < q, p.sum(-1), p.long().sum(-1), p.any(-1),
        p.all(-1),
    ]


def integers(a: Tensor, k: Tensor) -> list[Tensor]:
    return [
        k + 1, k * 2, k // 2, k % 2, k - a, k.to(a.dtype), a.long(), a.int() + k, k.float(), k / 2, -k,
        k.abs(), k.clamp(0, 1), k.sign(), k == 1, k < a, k.bool(), (a > 0).long() * k, torch.fmod(k, 2),
        k.pow(2), torch.remainder(k, 2), k.sum(-1), k.prod(-1), k.cumsum(-1), k.max(-1)[0], k.argmax(-1),
        k.floor(), torch.div(k, 2, rounding_mode='trunc'), torch.div(k, 2), k.ceil(), k.trunc(), k.round(),
        k.square(), torch.maximum(k, k.flip(-1)), torch.where(k > 1, k, 0), k.to(torch.bool) & (a > 0),
    ]


def blank(a: Tensor) -> list[Tensor]:
    filled, zeroed = (a.clone(), a.clone())
    (filled.fill_(2.0), zeroed.zero_())
    return [
        torch.zeros_like(a) + a, torch.ones_like(a) * a, torch.full_like(a, 2.0) * a, a.new_zeros(3) + a,
        a.new_ones(3) + a, a.new_full((3,), 0.5) * a, filled + a, zeroed + a, a.clone(), a.contiguous(),
        a.to(torch.float64), a.detach() + 1, torch.zeros_like(a, dtype=torch.int64),
        torch.ones_like(a, dtype=torch.bool),
    ]


def reductions(a: Tensor) -> list[Tensor]:
    """Of (B, 2, 3, 2)."""
    found = [a.sum(), a.sum(1), a.sum((1, 3)), a.sum(-1, keepdim=True), a.sum((1, 2, 3), keepdim=True)]
    found += [a.mean(), a.mean(2), a.mean((1, -1), keepdim=True), a.mean((1, 2, 3))]
    for name in ('amax', 'amin'):
        found += [getattr(a, name)(dims, keepdim=keep) for dims in (1, (1, 3), ()) for keep in (True, False)]
    for name in ('max', 'min', 'argmax', 'argmin'):
        found += [getattr(a, name)()]
        for dim in (1, -1):
            one, other = (getattr(a, name)(dim), getattr(a, name)(dim, keepdim=True))
            found += [*one, *other] if isinstance(one, tuple) else [one, other]
    found += [
        (a > 0).all(), (a > 0).all(1), (a > 0).any(-1, keepdim=True), (a > 0).any(), a.prod(), a.prod(2),
    ]
    found += [a.prod(-1, keepdim=True), a.cumsum(1), a.cumsum(-1), a.flatten(1).cumsum(1), a[:, :0].sum(1)]
    for order in (1, 2, float('inf')):
        found.append(torch.linalg.vector_norm(a, order, (1, 2)))
    return [
        *found, torch.linalg.vector_norm(a, 2, -1, keepdim=True), a.norm(), a.norm(dim=(1, 2)), a.std(1),
        a.var(-1),
    ]


def products(a: Tensor, b: Tensor) -> list[Tensor]:
    """Of (B, 3, 2) and (B, 2, 3)."""
    return [
        a @ b, b @ a, a @ b[..., 0:1], torch.linalg.vecdot(a, b.mT), torch.mv(a[0], b[0, :, 0]),
        torch.addmm(b[0] @ a[0], b[0], a[0]), torch.baddbmm(b @ a, b, a), torch.dot(a[0, 0], b[0, :, 0]),
        torch.addmv(a[0, :, 0], a[0], b[0, :, 0]), torch.vdot(a[0, 0], a[0, 1]),
        torch.einsum('bij,bjk->bik', a, b), torch.outer(a[0, 0], b[0, 0]), torch.cdist(a, b.mT),
        torch.cdist(a, b.mT, p=1.0), torch.trace(a[0, :2]), torch.cdist(a, b.mT, p=float('inf')),
        torch.linalg.cross(a.mT, b), torch.kron(a[0], b[0]), a.mT.matmul(b.mT),
    ]


def slopes(a: Tensor, b: Tensor) -> list[Tensor]:
    """Derivatives, which read entries back: of (B, 3, 2) and (B, 2, 3)."""
    of = [
        lambda z: torch.cdist(z, b.mT).sum(), lambda z: z.prod(1).sum(),
        lambda z: z[:, [0, 0, 2]].square().sum(), lambda z: (z.amax(1) * z.logsumexp(1)).sum(),
        lambda z: z.cumsum(1).sin().sum() + z.diagonal(dim1=1, dim2=2).prod(-1).sum(),
        lambda z: torch.where(z > 0, z, z * z).mean() + z.clamp(-1, 1).sum(),
        lambda z: z.roll(1, 1).select(1, 0).exp().sum(),
        lambda z: (z[:, 1:] / z[:, :-1]).atan().sum() + z.norm(dim=1).sum() + z.abs().sqrt().sum(),
        lambda z: torch.nn.functional.softplus(z).sum() + z.softmax(1).square().sum() + z.tanh().sum(),
    ]
    return [torch.func.grad(f)(a) for f in of] + [torch.func.jvp(f, (a,), (a.sin(),))[1] for f in of[1:5]]


def movements(a: Tensor) -> list[Tensor]:
    """Of (B, 3, 3)."""
    at, column = (torch.tensor([2, 0]), a[:, :, 0])
    filled, second, third = (a.clone(), a.clone(), a.clone())
    filled[:, 1], second[:, :, 1:] = (column, 0.25)
    third[:, at] = third[:, [0, 1]] * 2
    third[:, 0, 0] += 1
    return [
        torch.cat((a, a[:, :1]), 1), torch.cat((a, torch.zeros_like(a)), 2),
        torch.stack((column, column + 1), 1), a[:, at], a[:, [1, 1], [0, 2]], a[:, at[:, None], at],
        a.flip(1), a.flip((1, 2)), a.roll(1, 2), a.roll(-1, 1), a.repeat(1, 2, 1), a.tril(), a.triu(1),
        a.tril(-1), torch.diag_embed(column), a.diagonal(dim1=1, dim2=2) + 1,
        torch.nn.functional.pad(a, (1, 2, 0, 1)), torch.nn.functional.pad(a, (0, 1), value=2.0), filled,
        second, third, a.index_select(2, at), a.index_add(1, at, a[:, 1:]),
        a.index_copy(2, at, a[:, :, :2]), a.index_fill(1, at, 2.0),
        a.index_put((torch.arange(1), at[:1]), a[:, 1]),
        torch.take_along_dim(a, at.view(1, 2, 1).expand(1, 2, 3), 1),
        a.index_put((torch.tensor([0, 0]), torch.tensor([1, 1])), a[:, 0], accumulate=True),
        a.unfold(1, 2, 1) + 1, a.gather(1, at.view(1, 2, 1).expand(1, 2, 3)),
        a.scatter(2, at.view(1, 1, 2).expand(1, 3, 2), a[:, :, 1:]),
        a.scatter(1, at.view(1, 1, 2).expand(1, 1, 2), 2.0),
        a.scatter_add(1, at.view(1, 2, 1).expand(1, 2, 2), a), torch.select_scatter(a, column, 2, 1),
        torch.slice_scatter(a, a[:, :2], 1, 1, 3), a.mT + a, a.movedim(1, 2) - a,
        torch.diagonal_scatter(a, column, 0, 1, 2), a.reshape(-1, 9).unsqueeze(1) * 2,
        a.narrow(1, 1, 2) - 1, a.rot90(1, (1, 2)),
    ]


def choices(a: Tensor, k: Tensor) -> list[Tensor]:
    """Of (B, n, n), at places (B, n) that a row computes."""
    wide = k.unsqueeze(-1).expand_as(a)
    return [
        a.gather(1, wide), a.gather(2, wide.mT), a.gather(1, wide[:, :2]), a.gather(1, wide[:, :2, :2]),
        a.scatter(2, wide[:, :2], a), a.scatter(1, wide, a.sin()), a.scatter(2, wide, 0.5),
        a.scatter_add(1, wide, a * a), a.scatter_add(2, wide[:, :2], a),
        torch.arange(a.shape[-1], dtype=a.dtype)[k] * a[:, 0], a[0, k[0]], a[0][:, k[0]],
        a[0].index_select(1, k[0]), (a > 0).gather(1, wide), a.scatter(1, wide[:, :1, :2], a),
        torch.func.grad(lambda z: z.gather(1, wide).square().sum())(a),
    ]


def replaced(a: Tensor) -> list[Tensor]:
    """Of (B, 4)."""
    edges = torch.tensor([-0.5, 0.0, 0.5], dtype=a.dtype)
    found = [
        *a.sort(-1), *a.sort(-1, descending=True), *a.topk(2), *a.topk(2, largest=False), *a.kthvalue(2),
        *a.kthvalue(3, keepdim=True), *a.median(-1), *a.median(-1, keepdim=True), a.median(), *a.cummax(-1),
        *a.cummin(-1), a.cumprod(-1), a.var(-1), a.std(-1), a.angle(), torch.fmin(a, a.flip(-1)),
        a.argsort(-1), torch.searchsorted(edges, a.contiguous()), torch.bucketize(a, edges, right=True),
        torch.searchsorted(edges, a.contiguous(), side='right', out_int32=True), a.quantile(0.25, -1),
        a.nanmean(-1), torch.fmax(a, a.flip(-1)),
    ]
    return [*found, torch.nn.functional.one_hot(a.argmax(-1), 4), a.cumprod(0), a.nan_to_num(0.5)]


def large(a: Tensor) -> list[Tensor]:
    """Of (B, n): maps, sums and products that are loops from 65 entries on."""
    n = a.shape[-1]
    table = torch.arange(n, dtype=a.dtype) / n
    matrix = torch.arange(3 * n, dtype=a.dtype).reshape(n, 3)
    y = a.sin() * 0.5 + a.roll(1, -1)
    return [
        y, y.sum(-1), y @ matrix, (y * table).sum(-1), y.amax(-1), y.amin(-1), (y > 0).any(-1),
        (y > 0).all(-1), y.mean(-1), y.prod(-1), y.norm(dim=-1), torch.where(y > 0, y, 0.0),
        y.cumsum(-1)[:, -1], a * a[:, :1], a.flip(-1) + 1, (y.square() * table).sum(-1),
        torch.linalg.vecdot(a, y), a[:, ::2] * 2, torch.cat((a, y), 1).exp(), a + table, -a.abs(),
        table * 2 + a, a.clamp(-1, 1), a.long(), (a > 0).to(a), a.unsqueeze(-1) * a[:, :2].unsqueeze(1),
        a.max(-1)[0], a.argmax(-1), torch.stack((a, y), -1).sum(-1),
        a.reshape(-1, n).exp().sum(-1) * y[:, 0], (a != a).any(-1), a.cos().flip(-1).tanh(),
    ]


def decomposed(a: Tensor) -> list[Tensor]:
    """Of (B, n, n): every factorisation."""
    gram = a @ a.mT + torch.eye(a.shape[-1], dtype=a.dtype)
    factor, failed = torch.linalg.cholesky_ex(gram)
    return [
        factor, failed, torch.linalg.cholesky(gram, upper=True), torch.cholesky_solve(a, factor),
        torch.linalg.inv(gram), torch.linalg.solve(a, a[..., :1]), torch.linalg.solve(a, a[..., 0]),
        torch.linalg.solve(a, a[..., :1, :], left=False),
        *(torch.linalg.solve_triangular(a, a, upper=upper, unitriangular=unit)
          for upper in (True, False) for unit in (True, False)),
        torch.linalg.solve_triangular(a, a, upper=True, left=False), *torch.linalg.qr(a),
        *torch.linalg.eigh(gram), torch.linalg.eigvalsh(gram), torch.linalg.det(a),
        *torch.linalg.slogdet(a), torch.logdet(gram), torch.cholesky_solve(a, factor.mT, upper=True),
    ]


def points(a: Tensor, k: int) -> list[Tensor]:
    """Of (B, P, 3)."""
    return [
        *(lanes.reduce(lambda p: p.square().sum(-1), a, operation) for operation in ('sum', 'max', 'min')),
        lanes.each(lambda p: p.exp() * 0.5, a, together=k),
        lanes.reduce(lambda p: p.cos(), a.mT, 'sum', dim=2), lanes.each(lambda p: p.sin(), a.mT, dim=2),
    ]


def loops(a: Tensor, b: Tensor) -> list[Any]:
    """Of (B, P, n) and (B, n): loops in loops, of arrays and numbers, and of what no pass changes."""
    def walk(now: Any, p: Tensor) -> tuple[Any, Any]:
        one, other, count, still = now
        inner = lanes.repeat(3, lambda z: 0.5 * z + p, one)
        return ((other, inner * p.abs(), count + 1, still), (inner, count, p.sum(-1)))
    start = (b, b.abs(), torch.zeros_like(b[:, 0], dtype=torch.int64), b[:, 0] > 0)
    ends, kept = lanes.scan(walk, start, a)
    unrolled = lanes.scan(lambda s, p: (s + p.exp(), s[..., 0]), b, a, unrolled=True)
    constant = lanes.repeat(5, lambda z: (2 * z[0], z[1] + z[0]), (b.sin(), b.cos()))
    masked = lanes.repeat(9, lambda z: (z[0] * 2, z[1] + 1), (b, b[:, 0]), where=lambda z: z[1] < 4)
    unused = lanes.scan(lambda s, p: ((s[0] + p, s[1] * p), (s[0], s[1], p)), (b, b), a)[1][0]
    swapped = lanes.repeat(4, lambda z: (z[1], z[0]), (b, b.exp()))
    return [ends, kept, unrolled, constant, masked, unused, swapped]


def written(a: Tensor, k: Tensor) -> list[Tensor]:
    """Of (B, 3, 4) and (B, 3): entries that are written and added at places that the code or a row says."""
    b, c = (a.clone(), a.clone())
    b[:, 1, 2:] = a[:, 0, :2]
    b[a > 0.5] = 0.25
    c[:, torch.tensor([0, 2, 0])] += 2 * a
    c[..., 1] *= a[..., 0]
    return [
        b, c, a.clone().masked_fill_(a < 0, 3.0), a.index_add(1, torch.tensor([2, 2]), a[:, :2], alpha=3),
        a.index_put((torch.tensor([0]), torch.tensor([2, 2, 0])), a[:, 1, :1].expand(-1, 4), accumulate=True),
        torch.nn.functional.pad(a, [2, 1]), a.index_copy(2, torch.tensor([3]), a[..., :1]),
        torch.nn.functional.one_hot(k, 5), a.take_along_dim(k.unsqueeze(-1), 2), a.roll((1, -1), (1, 2)),
    ]


def rounded(a: Tensor) -> list[Tensor]:
    """Of (B, n): digits that are kept, and running sums, products and extremes of either sign."""
    a = 37.7 * a
    return [
        *(a.round(decimals=d) for d in (-2, -1, 0, 1, 2)), a.fmod(2.5), a.remainder(2.5), a.remainder(-2.5),
        -a % 3, a // 2.5, (a / 9).cumprod(1), *a.cummin(1), a.var(1, correction=0), a ** 64, a.abs() ** 65,
        a.abs() ** torch.tensor([2.0, 0.5, -1.0, 7.0])[:a.shape[1]], 1.5 ** a.sin(),
    ]


def nested(a: Tensor, b: Tensor) -> list[Tensor]:
    """Of (B, 4, 2) and (B, 2): loops that end where a row says, of few passes, in each other."""
    once = lanes.repeat(1, lambda z: z * 2 + b, b)
    none = lanes.repeat(0, lambda z: z * 2 + b, b)
    near = b.abs() + 0.1
    some = [lanes.repeat(k, lambda z: z * 1.5, near, where=lambda z: z.sum(-1) < 2.0) for k in (0, 1, 2, 9)]
    never = lanes.repeat(4, lambda z: z + 1, b, where=lambda z: z[:, 0] > 99)
    flag = b[:, 0] > 0
    held = lanes.repeat(3, lambda z: z + 1, b, where=lambda z: flag)
    twice = lanes.repeat(2, lambda z: lanes.repeat(3, lambda y: 0.5 * y + z, z), b)


    def inner(s: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return lanes.repeat(2, lambda y: 0.5 * y + p, s), lanes.scan(lambda c, q: (c + q, c), s, a)[1]

    ends, kept = lanes.scan(inner, b, a)
    operations = ('sum', 'max', 'min')
    least = [lanes.reduce(lambda p: p.cos().sum(-1), a[:, :n], o) for n in (1, 2, 3, 4) for o in operations]
    sizes = ((4, 1), (4, 3), (3, 4), (4, 4))
    every = [lanes.each(lambda p: p * b.unsqueeze(1), a[:, :n], together=k) for n, k in sizes]
    along = lanes.scan(lambda s, p: (s + p, s * p), b[:, :1].expand(-1, 4), a, dim=2)
    still = lanes.repeat(3, lambda z: (z[0] + 1, z[1]), (b, b.sin()))
    return [once, none, *some, never, held, twice, ends, kept, *least, *every, *along, *still]
