"""Regressors fitted on frozen features: ridge, nearest neighbours, and a curve through a few columns.

Shapes: features [N, D], values [N, T] in the task's units, NaN = not measured. Each target is fitted on the rows that have
it. A fitted regressor is a function from features to values [N, T].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.linear_model import Ridge, RidgeCV
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import SplineTransformer

from mvitac.evaluation.classifiers import NEIGHBOURS, one_blas_thread, spread
from mvitac.evaluation.diagnostics import BEYOND

Regressor = Callable[[np.ndarray], np.ndarray]

ALPHAS = tuple(10.0**k for k in range(-1, 6))
"""Candidate strengths of ridge regularisation, on standardised features and targets."""


class Scaler(TransformerMixin, BaseEstimator):
    """Zero mean and unit variance over the fitted rows; others are first clipped at ``low_`` and ``high_`` (``BEYOND``)."""

    def fit(self, x: np.ndarray, y: None = None) -> "Scaler":
        least, most = x.min(0), x.max(0)
        self.low_, self.high_ = least - BEYOND * (most - least), most + BEYOND * (most - least)
        self.mean_, self.scale_ = x.mean(0), spread(x)
        return self

    def transform(self, x: np.ndarray) -> np.ndarray:
        return (x.clip(self.low_, self.high_) - self.mean_) / self.scale_


@dataclass(frozen=True)
class Linear:
    """Ridge regression of each target on what ``before`` makes of the features."""

    before: Pipeline  # a fitted ``Scaler``, and what follows it
    ridges: list[tuple[Ridge, float, float]]  # of each standardised target, and its mean and standard deviation

    @property
    def scaler(self) -> Scaler:
        return self.before[0]  # type: ignore[return-value]

    def __call__(self, z: np.ndarray) -> np.ndarray:
        x = self.before.transform(z)
        return np.stack([ridge.predict(x) * std + mean for ridge, mean, std in self.ridges], axis=1)

    @property
    def bounds(self) -> np.ndarray:
        """[2, D]: features are clipped at these."""
        return np.stack([self.scaler.low_, self.scaler.high_])

    def clipped(self, z: np.ndarray) -> list[int]:
        """How many features are clipped in any row of ``z``, and of how many."""
        low, high = self.bounds
        return [int(((z < low) | (z > high)).any(0).sum()), z.shape[1]]

    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Weight [T, D] and bias [T], with all scaling folded in: values = x W^T + b of features clipped at ``bounds``."""
        weights = np.stack([ridge.coef_ / self.scaler.scale_ * std for ridge, _, std in self.ridges])
        biases = np.array([ridge.intercept_ * std + mean for ridge, mean, std in self.ridges])
        return weights, biases - weights @ self.scaler.mean_


def fit_ridge(x: np.ndarray, y: np.ndarray, num_val: int) -> tuple[Linear, list[float]]:
    """Fit ridge regression on standardised features and targets; returns the regressor and each target's alpha.

    Each alpha has the least squared error on the last ``num_val`` rows, which are whole groups; the final fit uses all.
    """
    fitted = _fit_each(x, y, num_val, make_pipeline(Scaler()))
    return fitted, [float(ridge.alpha) for ridge, _, _ in fitted.ridges]


def fit_curve(x: np.ndarray, y: np.ndarray, num_val: int) -> Regressor:
    """Fit a smooth curve: ridge on cubic splines of each column of ``x``, for controls of a few columns."""
    return _fit_each(x, y, num_val, make_pipeline(Scaler(), SplineTransformer(6, extrapolation="linear")))


def fit_neighbours(x: np.ndarray, y: np.ndarray) -> Regressor:
    """Mean value of the 20 nearest rows by cosine."""
    fitted = []
    for target in y.T:
        have = ~np.isnan(target)
        model = KNeighborsRegressor(n_neighbors=min(NEIGHBOURS, int(have.sum())), metric="cosine")
        fitted.append(model.fit(x[have], target[have]))
    return lambda z: np.stack([model.predict(z) for model in fitted], axis=1)


def _fit_each(x: np.ndarray, y: np.ndarray, num_val: int, before: Pipeline) -> Linear:
    x = x.astype(np.float64)  # in float32 the normal equations of correlated features are ill-conditioned
    first = np.arange(len(x)) < len(x) - num_val
    ridges = []
    with one_blas_thread():
        part = before.fit(x[first]).transform(x) if first.any() else x
        whole = before.fit(x).transform(x)
        for target in y.T:
            have = ~np.isnan(target)
            mean, std = float(target[have].mean()), float(target[have].std()) or 1.0
            scaled = (target - mean) / std
            alpha = _strength(part, scaled, have & first, have & ~first)
            ridges.append((Ridge(alpha).fit(whole[have], scaled[have]), mean, std))
    return Linear(before, ridges)


def _strength(x: np.ndarray, y: np.ndarray, fitted: np.ndarray, held: np.ndarray) -> float:
    """The alpha with the least squared error on the rows ``held``; without such rows, by leaving out row by row."""
    if not fitted.any() or not held.any():
        chosen: Any = RidgeCV(ALPHAS).fit(x[fitted | held], y[fitted | held])
        return float(chosen.alpha_)
    each = Ridge().set_params(alpha=ALPHAS).fit(x[fitted], np.tile(y[fitted, None], len(ALPHAS)))  # x'x but once
    return ALPHAS[int(((each.predict(x[held]) - y[held, None]) ** 2).mean(0).argmin())]
