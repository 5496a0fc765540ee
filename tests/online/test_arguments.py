"""Errors name the call, the rule and the value."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from variants import Cauchy

import staf_torch as st
from staf_torch.online.filter_arguments import KERNELS, directions


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "cubic"}, "kernel.*must be one of"),
        ({"kernel": st.GaussianKernel(tensor([1.0, 2.0]))}, "kernel.*one value a hyperparameter"),
        ({"radius": 0.0}, "radius.*must be positive"),
        (
            {"radius": 0.5, "kernel": st.GaussianKernel(0.015)},
            "radius.*GaussianKernel does not overflow.*0.5",
        ),
        ({"count": 0}, "count.*at least 1"),
        ({"noise": 1e-9}, "noise.*at least"),
        ({"amplitude": -1.0}, "amplitude.*must be positive"),
        ({"forgetting": 1.5}, r"forgetting.*in \(0, 1\]"),
        ({"follow": -1.0}, "follow.*must not be negative"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        st.StaFRegressor(**arguments).partial_fit(tensor([0.0, 1.0]), 1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("kernel", [*map(str, KERNELS), Cauchy()], ids=str)
@pytest.mark.parametrize("dim", [1, 2, 4])
def test_a_kernel_that_is_narrow_for_its_ball_is_told(
    kernel: st.Kernel | str, dim: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Against the variance that is left by values at the centers, by dense algebra."""
    told = []
    for radius in (0.5, 1.5, 2.5, 4.0):
        caplog.clear()
        model = st.StaFRegressor(kernel, radius=radius)
        model.partial_fit(torch.zeros(dim).double(), 1.0)
        own = KERNELS[kernel]().double() if isinstance(kernel, str) else kernel.double()
        centers, points = model.centers_offsets_, model.centers_offsets_ / 2
        cross, gram = own(points, centers), own(centers, centers)
        known = cross @ torch.linalg.pinv(gram, rtol=1e-12, hermitian=True) @ cross.mT
        share = float((known.diagonal() / own(points, points).diagonal()).min())
        told.append(bool(caplog.messages))
        assert told[-1] == (share < 0.5)
        if told[-1]:
            assert caplog.messages[0].startswith(f"`StaFRegressor(radius={radius:g})`: half way to a center")
            assert f"explain {share:.2g} of the variance" in caplog.messages[0]
    assert told == ([False] * 4 if kernel == "polynomial" else [False, False, told[2], True])


@pytest.mark.parametrize("centers", [st.rings(6), st.simplex(2), torch.zeros(1, 2).double()])
def test_a_kernel_that_is_zero_at_its_anchor_is_looked_at_too(
    centers: torch.Tensor, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever it says at the origin, where it has no variance."""
    for width, told in ((0.8, False), (0.05, True)):
        caplog.clear()
        kernel = st.AnchoredKernel(st.GaussianKernel(width))
        st.StaFRegressor(kernel, radius=0.3, centers=centers).partial_fit(tensor([0.5, 0.5]), 1.0)
        assert bool(caplog.messages) == (told and len(centers) > 1)


def test_bad_samples_are_named() -> None:
    model = st.StaFRegressor(Cauchy())
    with pytest.raises(ValueError, match="needs a first sample"):
        model.predict(tensor([0.0]))
    with pytest.raises(ValueError, match=r"must have the shape \(n,\) or \(S, n\)"):
        model.partial_fit(uniform(3, 2), uniform(4))
    with pytest.raises(ValueError, match=r"params.*must be one of"):
        model.set_params(width=1.0)
    model.partial_fit(uniform(3, 2), uniform(3))
    with pytest.raises(ValueError, match=r"must have the shape \(3, 2\).*got the shape \(4, 2\)"):
        model.partial_fit(uniform(4, 2), uniform(4))
    with pytest.raises(ValueError, match=r"predict.*must have the shape \(3, 2\)"):
        model.predict(uniform(3, 5))
    with pytest.raises(ValueError, match="array of numbers"):
        model.predict("no")


@pytest.mark.parametrize(("dim", "count"), [(2, 6), (2, 5), (3, 6)])
def test_directions_are_rings_in_the_plane_and_spread_in_a_ball_elsewhere(dim: int, count: int) -> None:
    found = directions(st.StaFRegressor(count=count), dim)
    wanted = st.rings(count) if dim == 2 and count in (3, 6) else st.ball(count, dim)
    assert torch.equal(found, wanted)


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_as_many_directions_as_a_quadratic_function_has_numbers_by_default(dim: int) -> None:
    assert directions(st.StaFRegressor(), dim).shape == ((dim + 1) * (dim + 2) // 2, dim)
