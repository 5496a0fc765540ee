"""river's regressors, one stream each."""

from __future__ import annotations

import numpy as np
from river import linear_model, neighbors, optim, tree


class River:
    """A regressor of river by name."""

    def __init__(self, kind: str) -> None:
        makers = {
            "linear": lambda: linear_model.LinearRegression(optim.SGD(0.03)),
            "passive-aggressive": lambda: linear_model.PARegressor(C=0.1),
            "bayesian": lambda: linear_model.BayesianLinearRegression(),
            "neighbours": lambda: neighbors.KNNRegressor(5, engine=neighbors.LazySearch(window_size=500)),
            "hoeffding tree": lambda: tree.HoeffdingAdaptiveTreeRegressor(grace_period=50, seed=1),
        }
        self.model = makers[kind]()

    def predict(self, x: np.ndarray) -> float:
        return float(self.model.predict_one(dict(enumerate(x.tolist()))) or 0.0)

    def learn(self, x: np.ndarray, y: float) -> None:
        self.model.learn_one(dict(enumerate(x.tolist())), y)
