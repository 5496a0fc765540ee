"""How streams come, go, are saved and loaded; what shapes they keep to; which arguments decide."""

from __future__ import annotations

import functools
import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from helpers_streams import REGRESSORS, mixture, small_filter
from variants import Cauchy, over

import staf_torch as st
from staf_torch.kernels import NAMED

KINDS = {**REGRESSORS, "filter with units": functools.partial(small_filter, scaling=True)}


def data(steps: int, *streams: int, outputs: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """A stream of two inputs, or several, with one value or several."""
    x = 0.4 * uniform(steps, *streams, 2, seed=1)
    y = (2 * x).sin().sum(-1)
    return x, y if outputs is None else torch.stack([y * (k + 1) for k in range(outputs)], -1)


def test_fit_and_tune_forget_what_was_learned_and_say_so(caplog: pytest.LogCaptureFixture) -> None:
    x, y = data(12)
    model = st.StaFRegressor(radius=0.4)
    fresh = model.fit(x[:6], y[:6]).predict(x[-1])
    assert torch.equal(model.fit(x, y).fit(x[:6], y[:6]).predict(x[-1]), fresh)
    assert int(model.n_samples_seen_) == 6
    with pytest.raises(ValueError, match=r"Regressor.predict` needs a first sample"):
        model.tune(x, y).predict(x[0])
    assert "tune` forgets what was learned before, up to 6 samples a stream: call `fit`" in caplog.text
    mixed = mixture().fit(x, y)  # has nothing to tune
    expected = mixed.predict(x[0])
    assert torch.equal(mixed.tune(x, y).predict(x[0]), expected)


def test_streams_that_are_not_there_cannot_go_come_or_begin_anew() -> None:
    x, y = data(3, 4)
    model = st.StaFRegressor(radius=0.4)
    for name, given in (("reset", ([0],)), ("drop", ([0],)), ("add", (1,)), ("state_dict", ())):
        with pytest.raises(ValueError, match=rf"`StaFRegressor.{name}` needs a first sample: call `fit`"):
            getattr(model, name)(*given)
    model.fit(x, y)
    for wrong in ([4], [-1], [0.5, 1.5], [True], 9):
        for call in (model.reset, model.drop):
            with pytest.raises(ValueError, match=r"must be numbers of streams from 0 to 3; got"):
                call(wrong)
    single = st.StaFRegressor(radius=0.4).fit(x[:, 0], y[:, 0])
    for of, gone in ((model, [0, 1, 2, 3]), (single, [0])):
        with pytest.raises(ValueError, match=r"`StaFRegressor.drop\(streams=...\)` must leave a stream"):
            of.drop(gone)
    with pytest.raises(ValueError, match=r"`StaFRegressor.add` needs streams side by side, x \(S, n\)"):
        single.add()


@over(KINDS, "kind")
def test_streams_keep_their_numbers_outputs_and_order(kind: str) -> None:
    x, y = data(6, 4, outputs=2)
    model = KINDS[kind]().fit(x, y)
    before = model.predict(x[-1])
    assert before.shape == (4, 2)
    assert model.drop([3, 1]) is model
    assert (model.n_streams_, model.n_outputs_, model.n_features_in_) == (2, 2, 2)
    torch.testing.assert_close(model.predict(x[-1, [0, 2]]), before[[0, 2]], rtol=1e-9, atol=1e-12)
    assert model.add() is model
    assert model.n_streams_ == 3
    assert model.n_samples_seen_.tolist() == [6, 6, 0]
    model.partial_fit(x[0, :3], y[0, :3])
    assert model.reset(streams=np.array([2, 0, 0])) is model
    assert model.n_samples_seen_.tolist() == [0, 7, 0]
    assert model.n_skipped_.tolist() == [0, 0, 0]
    assert model.predict(x[:0, :3].transpose(0, 1)).shape == (3, 0, 2)
    several = model.predict(x[:, :3].transpose(0, 1), return_std=True)
    for k in range(6):
        for whole, part in zip(several, model.predict(x[k, :3], return_std=True), strict=True):
            assert torch.equal(whole[:, k], part)
    assert model.reset(streams=1).n_samples_seen_.tolist() == [0, 0, 0]


@over(REGRESSORS, "kind")
def test_samples_of_another_shape_are_refused_and_leave_the_streams_alone(kind: str) -> None:
    cases: list[tuple[tuple[Any, ...], list[tuple[tuple[int, ...], tuple[int, ...]]]]] = [
        (((2,), ()), [((2,), (1,)), ((3,), ()), ((1, 2), (1,))]),
        (((2,), (2,)), [((2,), ()), ((2,), (3,))]),
        (((3, 2), (3,)), [((3, 2), (3, 1)), ((4, 2), (4,)), ((3, 3), (3,)), ((2,), ())]),
        (((3, 2), (3, 1)), [((3, 2), (3,)), ((3, 2), (3, 2)), ((3, 3), (3, 1))]),
    ]
    for (of_x, of_y), wrong in cases:
        model = REGRESSORS[kind]().partial_fit(torch.rand(of_x).double(), torch.rand(of_y).double())
        for other_x, other_y in wrong:
            x, y = torch.rand(other_x).double(), torch.rand(other_y).double()
            with pytest.raises(ValueError, match=r"Regressor.partial_fit\(x=...\)` must have") as told:
                model.partial_fit(x, y)
            assert f"the shape {of_x} of the first sample" in str(told.value)
            assert f"got the shape {other_x} and y's {other_y}" in str(told.value)
            if other_x != of_x and len(other_x) <= len(of_x):  # one more is of several points
                with pytest.raises(ValueError, match=r"predict\(x=...\)` must have the shape"):
                    model.predict(x)
        points = (*of_x[:-1], 5, of_x[-1])
        assert model.predict(torch.zeros(points)).shape == (*of_x[:-1], 5, *of_y[len(of_x) - 1 :])
        for other in ((*points[:-1], 4), (7, *points)):
            with pytest.raises(ValueError, match=r"predict\(x=...\)` must have the shape"):
                model.predict(torch.zeros(other))
        assert int(model.n_samples_seen_.sum()) == (of_x[0] if len(of_x) == 2 else 1)


@over(KINDS, "kind")
def test_samples_in_any_form_are_the_same_samples(kind: str) -> None:
    """Rows of a transposed tensor, arrays, single precision."""
    x, y = (part.float().double() for part in data(14, 3))
    across = x.transpose(1, 2).contiguous().transpose(1, 2)
    forms: dict[str, Any] = {
        "rows": lambda k: (across[k], y[k]),
        "arrays": lambda k: (x[k].numpy(), y[k].numpy()),
        "single": lambda k: (x[k].float(), y[k].float()),
        "targets every other": lambda k: (x[k], torch.stack((y[k], y[k]), -1)[:, 0]),
        "lists": lambda k: (x[k].tolist(), y[k].tolist()),
    }
    plain = KINDS[kind]()
    for k in range(13):
        plain.partial_fit(x[k], y[k])
    wanted = plain.predict(x[13], return_std=True)
    for form in forms.values():
        model = KINDS[kind]().partial_fit(x[0], y[0])
        for k in range(1, 13):
            model.partial_fit(*form(k))
        for one, other in zip(model.predict(form(13)[0], return_std=True), wanted, strict=True):
            found = torch.as_tensor(one)  # in the caller's precision
            assert torch.equal(found, other.to(found.dtype))
    half = KINDS[kind]().partial_fit(x[0].half(), y[0].half())
    assert half.state_dict()["dtype"] == "torch.float64"


def test_times_and_lapses_are_the_same_thing() -> None:
    x, y = data(9, 2)
    time = torch.tensor([0.0, 1.0, 1.5, 4.0, 4.0, 9.0, 9.5, 30.0, 31.0]).double()
    settings: dict[str, Any] = {"radius": 0.4, "forgetting": 0.8}
    whole = st.StaFRegressor(**settings).fit(x, y, time=time)
    even = st.StaFRegressor(**settings).fit(x, y)
    each = st.StaFRegressor(**settings)
    for k in range(9):
        each.partial_fit(x[k], y[k], lapse=1.0 if k == 0 else time[k] - time[k - 1])
    assert torch.equal(whole.predict(x[0]), each.predict(x[0]))
    assert float((whole.predict(x[0]) - even.predict(x[0])).abs().min()) > 1e-6
    several = st.StaFRegressor(**settings).fit(x, y, time=torch.stack((time, torch.arange(9.0)), 1))
    torch.testing.assert_close(
        several.predict(x[0]), torch.stack((whole.predict(x[0])[0], even.predict(x[0])[1]))
    )
    for lapse in (-0.5, [0.0, -1e-9], math.inf, [1.0, math.nan], [1.0, 2.0, 3.0], [[1.0]]):
        with pytest.raises(ValueError, match=r"lapse=...\)` must be finite and not negative"):
            even.partial_fit(x[0], y[0], lapse=lapse)
    mean, _ = even.smooth(x[:1], y[:1])
    assert mean.shape == (1, 2)  # a record of one sample


def test_a_state_is_that_of_the_last_arguments_and_of_nothing_before() -> None:
    x, y = data(40)
    wide = st.StaFRegressor(radius=0.5).fit(x[:9], y[:9])
    model = st.StaFRegressor(radius=0.4).fit(x, y).set_params(radius=0.5)
    assert model.load_state_dict(wide.state_dict()) is model
    assert torch.equal(model.centers_offsets_, wide.centers_offsets_)
    assert torch.equal(model.predict(x[9]), wide.predict(x[9]))
    plain = st.StaFRegressor(radius=0.4).fit(x, y)
    tuned = st.StaFRegressor(radius=0.4).tune(x, y)
    saved = tuned.fit(x, y).state_dict()
    tuned.load_state_dict(plain.state_dict())
    assert tuned.tuning is None
    assert torch.equal(tuned.predict(x[9]), plain.predict(x[9]))
    for other, told in (
        ({"radius": 0.3}, "radius=0.4, this one 0.3"),
        ({"radius": 0.4, "kernel": "matern"}, "Matern"),
    ):
        with pytest.raises(ValueError, match=f"same arguments: it has .*{told}"):
            st.StaFRegressor(**other).load_state_dict(saved)
    with pytest.raises(
        ValueError, match="it has n_features_in_=2, this one has learned with 1: call `reset`"
    ):
        st.StaFRegressor(radius=0.4).fit(x[:, :1], y).load_state_dict(saved)
    less = {name: part for name, part in saved["tuning"].items() if name != "ratio"}
    with pytest.raises(ValueError, match="must be what `state_dict` returned; its 'tuning' has"):
        st.StaFRegressor(radius=0.4).load_state_dict(saved | {"tuning": less})
    unfitted = pickle.loads(pickle.dumps(st.StaFRegressor(radius=0.3)))
    assert repr(unfitted) == repr(st.StaFRegressor(radius=0.3))
    assert (unfitted.__sklearn_is_fitted__(), plain.__sklearn_is_fitted__()) == (False, True)


def test_a_state_that_lacks_something_is_refused_by_what_it_lacks() -> None:
    x, y = data(5, 2)
    for model in (small_filter(), mixture()):
        state = model.fit(x, y).state_dict()
        told = r"load_state_dict\(state=...\)` must"
        for name in ("dtype", "n_streams_", "arguments", "table"):
            less = {key: value for key, value in state.items() if key != name}
            with pytest.raises(
                ValueError, match=rf"{told} be what `state_dict` returned; it has no \['{name}'\]"
            ):
                model.load_state_dict(less)
        with pytest.raises(ValueError, match=rf"{told} be what .* returned; its dtype is 'torch.int8'"):
            model.load_state_dict(state | {"dtype": "torch.int8"})
        with pytest.raises(ValueError, match=rf"{told} have a tensor 'table'"):
            model.load_state_dict(state | {"table": None})
        for table in (state["table"][0], state["table"][:, :-1], state["table"][:-1]):
            with pytest.raises(ValueError, match=rf"{told} have"):
                model.load_state_dict(state | {"table": table.contiguous()})
        other = {**state["arguments"], "robust": 3.0}
        with pytest.raises(ValueError, match=rf"{told} be of .* it has robust=3.0, this one None"):
            model.load_state_dict(state | {"arguments": other})
    assert all(value is None or type(value) in (float, str) for value in state["arguments"].values())


def model_of(**given: Any) -> Any:
    return st.StaFRegressor(**given).partial_fit(tensor([0.0, 0.1]), tensor(1.0))


def test_what_was_tuned_holds_for_as_many_streams_coordinates_and_outputs_alone() -> None:
    x, y = data(30)
    tuned = st.StaFRegressor(radius=0.4).tune(x, y)
    assert tuned.tuning is not None
    tuned.fit(x, y)
    torch.testing.assert_close(tuned.centers_offsets_, tuned.tuning.radius[0] * st.rings(6))
    assert torch.equal(tuned.state_dict()["ratio"], tuned.tuning.ratio)
    others = (x[:, None].repeat(1, 2, 1), y[:, None].repeat(1, 2)), (x, torch.stack((y, y), 1)), (x[:, :1], y)
    both = x[:, :1], torch.stack((y, y), 1)  # as many columns in all
    for of_x, of_y in (*others, both):
        for call in (tuned.fit, tuned.smooth, tuned.forecast):
            with pytest.raises(
                ValueError, match=r"was tuned for 1 .* of 2 .* and 1 output\(s\); got .*: call `tune`"
            ):
                call(of_x, of_y)


@pytest.mark.parametrize("kernel", [*map(str, NAMED), Cauchy()], ids=str)
@pytest.mark.parametrize("dim", [2])
def test_a_kernel_that_is_narrow_for_its_ball_is_told(
    kernel: st.Kernel | str, dim: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Against the variance that is left by values at the centers, by dense algebra."""
    told = []
    for radius in (0.5, 1.5, 2.5, 4.0):
        caplog.clear()
        model = st.StaFRegressor(kernel, radius=radius)
        model.partial_fit(torch.zeros(dim).double(), 1.0)
        own = NAMED[kernel]().double() if isinstance(kernel, str) else kernel.double()
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
