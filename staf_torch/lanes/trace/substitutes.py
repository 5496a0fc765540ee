"""Substitutes for operations without a scalar form, for the log line that names one."""

from __future__ import annotations

_CHOOSE = "write `torch.where(condition, a, b)`, or `lanes.repeat(..., where=)` for a loop that rows leave"
_MASKED = "write `y = torch.where(mask, new, y)`: how many entries a mask takes is the row's own"
_LEAST_SQUARES = "write `torch.linalg.solve(A.mT @ A, A.mT @ b)`, if the columns are independent"
_GRAM = "write `torch.linalg.eigh(A.mT @ A)`: its roots are the singular values"
_SLIDING = "write `(x.unfold(-1, width, stride) * weights).sum(-1)`"
_BITS = "write `%`, `//` and comparisons, or keep flags as bool"
_TORCH = "write it with torch, `torch.sin` for `math.sin` or `numpy.sin`"
_DRAWN = "draw the numbers before, and give them to every step as inputs of the times (`now`)"
_REAL = "keep the real and the imaginary part as two real tensors"

_OF: dict[str, str] = {
    **dict.fromkeys(("_local_scalar_dense", "is_nonzero", "equal", "allclose"), _CHOOSE),
    **dict.fromkeys(("nonzero", "masked_select", "masked_scatter", "index", "index_put"), _MASKED),
    **dict.fromkeys(("linalg_lstsq", "linalg_pinv"), _LEAST_SQUARES),
    "_linalg_svd": _GRAM,
    "linalg_eig": "write `torch.linalg.eigh`, if the matrix is symmetric",
    "linalg_lu_factor_ex": "write `torch.linalg.solve`",
    **dict.fromkeys(("convolution", "avg_pool2d", "max_pool2d_with_indices"), _SLIDING),
    **dict.fromkeys(("__lshift__", "__rshift__", "bitwise", "gcd"), _BITS),
    **dict.fromkeys(("numpy", "__array__", "tolist", "__dlpack__"), _TORCH),
    **dict.fromkeys(("_fft_r2c", "_fft_c2c", "_fft_c2r"), "write the sums of cosines and sines"),
    "gather": "write `gather`, `torch.take_along_dim` or `scatter` along one dimension",
    "scatter_add": "write `scatter_add` along one dimension",
    "scatter_reduce": "write `torch.where(index == k, value, ...)` and `amax` over the entries",
    "random": _DRAWN,
    "complex": _REAL,
    "half": "compute in float32 or float64: `.float()` or `.to(x.dtype)`",
}


def instead_of(name: str) -> str:
    """Return what to write in place of an operation: "" where nothing is known."""
    return _OF.get(name, "")
