"""exp and tanh of float64 in a kernel, without a branch, so that a compiler computes several side by side.

Those of CUDA branch where an argument is large, and a division where a number is small: a thread with fifteen
exponentials then waits for each in turn. These are the processor's (`_lanes_functions.hpp`), with its bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

PREFIX = "lanes_"
BRANCHLESS = frozenset(("exp", "tanh"))
_TERMS = 13  # of the polynomial of e^r - 1, |r| <= log(2) / 2


def _polynomial() -> str:
    """Statements that find e^r - 1 = r + r^2 (even + r odd) as ``rest``, in two chains."""
    odd, even = (f"{name} = {1 / math.factorial(k)!r}" for name, k in (("odd", _TERMS), ("even", _TERMS - 1)))
    lines = [f"double {odd}, {even};"]
    for k in range(_TERMS - 2, 1, -2):
        lines += [
            f"{name} = fma({name}, square, {1 / math.factorial(at)!r});"
            for name, at in (("odd", k), ("even", k - 1))
        ]
    return "\n    ".join([*lines, "rest = fma(square, fma(r, odd, even), r);"])


_REDUCED = f"""__device__ inline int lanes_reduced(double x, double &rest)
{{
    const double rounded = fma(x, 1.4426950408889634, 0x1.8p52), whole = rounded - 0x1.8p52;
    const double r = fma(-whole, 0x1.a39ef35793c76p-33, fma(-whole, 0x1.62e42feep-1, x)), square = r * r;
    {_polynomial()}
    return __double2loint(rounded);
}}
__device__ inline double lanes_raised(double x, int n)
{{
    return __hiloint2double(__double2hiint(x) + (n << 20), __double2loint(x));
}}
__device__ inline bool lanes_is_nan(int high, int low)
{{
    return (high & 0x7fffffff) > 0x7ff00000 - (low == 0 ? 0 : 1);
}}
"""
_EXP = """__device__ inline double lanes_exp(double x)
{
    const int high = __double2hiint(x);
    double rest;
    const int n = lanes_reduced(x, rest), half = n >> 1;
    const double found = lanes_raised(1.0 + rest, half) * lanes_raised(1.0, n - half);
    const double limit = high < 0 ? 0.0 : __hiloint2double(0x7ff00000, 0);
    const double end = lanes_is_nan(high, __double2loint(x)) ? x : limit;
    return (high & 0x7fffffff) < 0x40877000 ? found : end;
}
"""
_TANH = """__device__ inline double lanes_quotient(double a, double b)
{
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
    double y;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(b));
    double e = fma(-b, y, 1.0);
    e = fma(e, e, e);
    y = fma(e, y, y);
    e = fma(-b, y, 1.0);
    y = fma(e, y, y);
    const double q = a * y;
    return fma(fma(-b, q, a), y, q);
#else
    return a / b;
#endif
}
__device__ inline double lanes_tanh(double x)
{
    const int high = __double2hiint(x), low = __double2loint(x), size = high & 0x7fffffff;
    const bool far = size >= 0x40340000, near = size < 0x03c00000;
    const double at = far ? 20.0 : __hiloint2double(size, low);
    double rest;
    const int n = lanes_reduced(2 * at, rest);
    const double power = lanes_raised(1.0, n), e = fma(power, rest, power - 1);
    const double found = lanes_quotient(e, e + 2);
    const double whole = __hiloint2double(__double2hiint(found) | (high & 0x80000000), __double2loint(found));
    return near || lanes_is_nan(high, low) ? x : whole;
}
"""


def device_functions(lines: Sequence[str]) -> list[str]:
    """Return the functions that statements call."""
    called = {name for name in BRANCHLESS if any(f"{PREFIX}{name}(" in line for line in lines)}
    texts = [_REDUCED if called else "", _EXP if "exp" in called else "", _TANH if "tanh" in called else ""]
    return "".join(texts).splitlines()
