"""scikit-learn's and river's tools around the regressor, where these are installed."""

from __future__ import annotations

import math
import sys
import types
from typing import Any

import numpy as np
import pytest

import staf_torch as st
from staf_torch.online import MixtureRegressor, RiverRegressor
from staf_torch.online.scikit_estimator import NotFittedError

EXPECTED = {
    "check_fit2d_predict1d": "a single point (n,) is a prediction of one stream",
    "check_supervised_y_no_nan": "a target that is not finite is skipped and counted",
    "check_fit_score_takes_y": "partial_fit of (T, n) means T streams, fit one stream in time",
}


def series(steps: int) -> tuple[np.ndarray, np.ndarray]:
    time = 0.15 * np.arange(steps)
    x = np.stack((np.sin(time), 3 + 2 * np.cos(1.3 * time)), 1)
    return x, np.sin(2 * x[:, 0]) + 0.5 * x[:, 1]


def test_an_argument_of_the_kernel_is_set_by_its_name_and_others_are_refused() -> None:
    model = st.StaFRegressor(st.GaussianKernel(0.5)).set_params(kernel__width=0.8)
    assert isinstance(model.kernel, st.GaussianKernel)
    assert float(model.kernel.width) == 0.8
    for name in ("kernel__length_scale", "radius__width", "centres"):
        with pytest.raises(ValueError, match=name):
            model.set_params(**{name: 1.0})


@pytest.mark.filterwarnings("ignore:Estimator MixtureRegressor does not inherit", "ignore:Skipping check")
def test_check_estimator_passes_but_for_what_the_manual_names() -> None:
    checks = pytest.importorskip("sklearn.utils.estimator_checks")
    model = MixtureRegressor(128, 8)
    found = checks.check_estimator(model, expected_failed_checks=EXPECTED, on_fail=None)
    assert {check["check_name"] for check in found if check["status"] == "xfail"} == set(EXPECTED)
    assert [check["check_name"] for check in found if check["status"] == "failed"] == []


def test_pipelines_searches_and_several_targets_work() -> None:
    pytest.importorskip("sklearn")
    from sklearn.base import clone
    from sklearn.model_selection import GridSearchCV, TimeSeriesSplit, cross_val_score
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    x, y = series(120)
    pipe = make_pipeline(StandardScaler(), st.StaFRegressor(st.GaussianKernel(1.0), noise=0.05))
    settings = {"stafregressor__kernel__width": [0.05, 1.0], "stafregressor__radius": [0.4]}
    search = GridSearchCV(pipe, settings, cv=TimeSeriesSplit(3)).fit(x, y)
    assert search.best_params_["stafregressor__kernel__width"] == 1.0
    assert search.best_estimator_.score(x[-5:], y[-5:]) > 0.9
    assert np.isfinite(cross_val_score(clone(pipe), x, y, cv=TimeSeriesSplit(3))).all()
    several = MultiOutputRegressor(st.StaFRegressor(scaling=True)).fit(x, np.stack((y, -y), 1))
    found = several.predict(x[-1:])
    np.testing.assert_allclose(found[:, 0], -found[:, 1], atol=1e-9)


def test_river_adapter_takes_features_by_name() -> None:
    x, y = series(150)
    errors = []
    model = RiverRegressor(MixtureRegressor(128, 8))
    assert model.predict_one({"a": 1.0, "b": 2.0}) == 0.0
    for k, (row, value) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        sample = {"a": row[0], "b": row[1]} if k % 2 else {"b": row[1], "a": row[0]}
        errors.append(model.predict_one(sample) - value)
        model.learn_one(sample, value)
    assert math.isfinite(model.predict_one({"b": 3.0}))  # one that is missing was not measured
    told = model.predict_one({"a": x[-1, 0], "b": x[-1, 1]}, with_dist=True)
    mean, deviation = (float(part) for part in model.model.predict(x[-1, ::-1], return_std=True))
    assert (told.mu, told.sigma) == (mean, deviation)
    assert told(told.mu) == pytest.approx(1 / (deviation * math.sqrt(2 * math.pi)))
    assert told.cdf(told.inv_cdf(0.05)) == pytest.approx(0.05)
    assert RiverRegressor().predict_one({"a": 1.0}, with_dist=True).sigma == math.inf
    with pytest.raises(ValueError, match=r"learn_one\(x\['b'\]\)` must be a number, or None.*'wet'"):
        model.learn_one({"a": 1.0, "b": "wet"}, 1.0)
    with pytest.raises(ValueError, match=r"learn_one\(y\)` must be a number.*'no'"):
        model.learn_one({"a": 1.0, "b": 2.0}, "no")
    assert np.sqrt(np.mean(np.square(errors[75:]))) < 0.05 * y.std()


def pretend(monkeypatch: pytest.MonkeyPatch, name: str, **names: Any) -> None:
    """A module of another library with these names, which need not be installed."""
    module = types.ModuleType(name)
    vars(module).update(names)
    monkeypatch.setitem(sys.modules, name, module)


def test_a_regressor_without_a_sample_says_so_as_scikit_learn_does_where_that_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class UnfittedError(Exception):
        pass

    pretend(monkeypatch, "sklearn.exceptions", NotFittedError=UnfittedError)
    with pytest.raises(UnfittedError, match=r"`StaFRegressor.predict` needs a first sample"):
        st.StaFRegressor().predict(np.zeros(2))
    monkeypatch.delitem(sys.modules, "sklearn.exceptions")
    with pytest.raises(NotFittedError, match="needs a first sample") as told:
        st.StaFRegressor().predict(np.zeros(2))
    assert isinstance(told.value, ValueError)
    assert isinstance(told.value, AttributeError)


def test_parameters_are_the_arguments_and_those_of_the_kernel() -> None:
    model = st.StaFRegressor(st.PolynomialKernel(3, 0.5), 0.4)
    own = model.get_params(deep=False)
    assert list(own)[:3] == ["kernel", "radius", "count"]
    assert "self" not in own
    assert model.get_params() == own | {"kernel__degree": 3, "kernel__bias": 0.5}
    assert repr(model) == f"StaFRegressor(kernel={model.kernel!r}, radius=0.4)"
    assert repr(st.StaFRegressor(centers=np.zeros((3, 2)))) == "StaFRegressor(centers=<ndarray (3, 2)>)"
    assert repr(RiverRegressor()) == "RiverRegressor(MixtureRegressor(memory=500))"
    assert st.StaFRegressor("matern").get_params() == st.StaFRegressor("matern").get_params(deep=False)
    named = st.StaFRegressor("gaussian").set_params(kernel__width=0.25, noise=0.5)
    assert isinstance(named.kernel, st.GaussianKernel)
    assert (named.get_params()["kernel__width"], named.noise) == (0.25, 0.5)
    grown = model.set_params(kernel__bias=2.0).kernel
    assert isinstance(grown, st.PolynomialKernel)
    assert (grown.degree, float(grown.bias)) == (3, 2.0)


def test_the_adapter_registers_with_river_and_keeps_to_one_model(monkeypatch: pytest.MonkeyPatch) -> None:
    registered: list[type] = []

    class Regressor:
        register = registered.append

    pretend(monkeypatch, "river.base", Regressor=Regressor)
    adapter = RiverRegressor()
    assert registered == [RiverRegressor]
    assert adapter.model.memory == 500
    monkeypatch.delitem(sys.modules, "river.base")
    model = st.StaFRegressor("matern", 0.4)
    adapter = RiverRegressor(model)
    assert registered == [RiverRegressor]
    assert adapter.model is model
    assert adapter.predict_one({"a": 1}) == 0.0
    for k in range(6):
        assert adapter.learn_one({"a": 0.1 * k, 7: 1}, 1e-9 + k) is adapter
    assert adapter.features == ("a", 7)
    assert adapter.predict_one({7: 1.0, "a": 0.25}) == float(model.predict([0.25, 1.0]))
    clone = adapter.clone()
    assert clone.model is not model
    assert (clone.features, clone.predict_one({"a": 1}), clone.model.radius) == ((), 0.0, 0.4)
