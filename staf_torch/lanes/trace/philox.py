"""Random numbers that are a function of a seed and a counter: the same on every back end, for every batch.

Philox 4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) is ten rounds of
products of 32-bit words. Nothing is carried from number to number, so that a row has its own whatever the
others do, and a step of a row program draws them where it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..calls.inputs import seen_by_others

_WORD, _HALF = 0xFFFFFFFF, 0xFFFF
_FACTORS, _WEYL, ROUNDS = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85), 10


def words(counter: Sequence[Tensor], key: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return four random words of 32 bits, each (...), int64.

    Example:
        >>> from staf_torch.lanes.trace.philox import words
        >>> zero = torch.zeros((), dtype=torch.int64)
        >>> [f"{int(word):08x}" for word in words([zero] * 4, [zero] * 2)]
        ['6627e8d5', 'e169c58d', 'bc57ac4c', '9b00dbd8']

    Args:
        counter: four words, (...), int64.
        key: two words.
    """
    a, b, c, d = _mixed(counter, key, _product)
    return a, b, c, d


def _mixed(counter: Sequence[Any], key: Sequence[Any], product: Callable[[Any, int], tuple[Any, Any]]) -> Any:
    a, b, c, d = counter
    one, other = key
    for _ in range(ROUNDS):
        (high, low), (high_, low_) = product(a, _FACTORS[0]), product(c, _FACTORS[1])
        a, b, c, d = high_ ^ b ^ one, low_, high ^ d ^ other, low
        one, other = (one + _WEYL[0]) & _WORD, (other + _WEYL[1]) & _WORD
    return a, b, c, d


def _product(word: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """High and low word of a product, without an overflow of 64 bits."""
    high, low = word * (factor >> 16), word * (factor & _HALF)
    return (high + (low >> 16)) >> 16, (low + ((high & _HALF) << 16)) & _WORD


def _unsigned_product(word: Any, factor: int) -> tuple[Any, Any]:
    """Return the product of NumPy arrays, whose 64 bits have no sign: three operations in place of nine."""
    whole = word * np.uint64(factor)
    return whole >> np.uint64(32), whole & np.uint64(_WORD)


def seed_parts(seeds: Sequence[int], like: Tensor) -> Tensor:
    """Return the four 16-bit parts of seeds, (B, 4), which every float holds."""
    if isinstance(seeds, range) and seeds and max(seeds[0], seeds[-1]) < 2**63:  # of a million rows, say
        whole = torch.arange(seeds.start, seeds.stop, seeds.step, device=like.device)
        rows = (whole.unsqueeze(-1) >> torch.arange(0, 64, 16, device=like.device)) & _HALF
    else:
        parts = [[(seed >> (16 * k)) & _HALF for k in range(4)] for seed in seeds]
        rows = torch.tensor(parts, dtype=torch.int64, device="cpu")
    return rows.to(like.device, like.dtype)


def uniform(seed: Tensor, step: Tensor, count: int) -> Tensor:
    """Return numbers uniform on [-1, 1) from 53 random bits each, (B, count), of the dtype of ``step``.

    In float32 the largest are rounded to 1.

    Args:
        seed: of `seed_parts`, (B, 4).
        step: whole numbers from 0 to 2^32 - 1, (B,).
        count: of numbers.
    """
    at = step.detach()
    looked = seen_by_others() or torch._C._len_torch_function_stack() or torch.compiler.is_compiling()
    if type(at) is Tensor and at.is_cpu and not looked:
        return _by_numpy(seed.detach(), at, count)
    high = (at / 65536).floor()
    parts = [*seed.detach().unbind(-1), at - 65536 * high, high]
    block = torch.arange((count + 1) // 2, dtype=at.dtype, device=at.device)
    given = [part.unsqueeze(-1).expand(*part.shape, len(block)) for part in parts]
    both = [
        torch.ops.staf_torch.philox(*given, block.expand_as(given[0]), second) for second in (False, True)
    ]
    return torch.stack(both, dim=-1).flatten(-2)[..., :count]


def _by_numpy(seed: Tensor, step: Tensor, count: int) -> Tensor:
    """Return `uniform` where nobody looks at the operations: a plain loop of few rows draws at every step."""
    parts, at = (each.numpy().astype(np.uint64) for each in (seed, step))
    key = [parts[..., k : k + 1] + (parts[..., k + 1 : k + 2] << np.uint64(16)) for k in (0, 2)]
    block = np.arange((count + 1) // 2, dtype=np.uint64)
    counter = at[..., None], block, np.zeros_like(block), np.zeros_like(block)
    found = np.stack(_mixed(counter, key, _unsigned_product), axis=-1)
    whole = (found[..., ::2] << np.uint64(21)) + (found[..., 1::2] >> np.uint64(11))
    return (torch.from_numpy(whole.astype(np.int64)) - 2**52).flatten(-2)[..., :count].to(
        step.dtype
    ) * 2.0**-52


def _numbers(halves: Sequence[Tensor], block: Tensor, second: bool) -> Tensor:
    """The first or second number of a block: key (a, b), (c, d), counter (low, high), block, 0, 0, of
    halves a, b, c, d, low, high, each below 2^16."""
    low, place = halves[4], block.long()
    *key, step = (
        one.long() + (other.long() << 16) for one, other in zip(halves[::2], halves[1::2], strict=True)
    )
    none = torch.zeros_like(place)
    counter, chosen = (step, place, none, none), slice(2 * second, 2 * second + 2)
    one, other = words(counter, key)[chosen]
    found: Tensor = ((one << 21) + (other >> 11) - 2**52).to(low.dtype) * 2.0**-52
    return found


_LIBRARY = torch.library.Library("staf_torch", "FRAGMENT")
_PARTS = ", ".join(f"Tensor {name}" for name in ("a", "b", "c", "d", "low", "high", "block"))
_LIBRARY.define(f"philox({_PARTS}, bool second) -> Tensor")
_LIBRARY.impl("philox", lambda *parts: _numbers(parts[:6], *parts[6:]), "CompositeExplicitAutograd")


def _of_rows(info: object, dims: Sequence[int | None], *args: object) -> tuple[Tensor, int]:
    given = list(args)
    deep = max(x.dim() - (at is not None) for x, at in zip(given, dims, strict=True) if isinstance(x, Tensor))
    for k, (x, at) in enumerate(zip(given, dims, strict=True)):
        if isinstance(x, Tensor) and at is not None:
            x = x.movedim(at, 0)
            given[k] = x.reshape(len(x), *[1] * (deep + 1 - x.dim()), *x.shape[1:])
    return torch.ops.staf_torch.philox(*given), 0


torch.library.register_vmap("staf_torch::philox", _of_rows, lib=_LIBRARY)
