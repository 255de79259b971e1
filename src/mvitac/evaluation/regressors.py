"""Regressors fitted on frozen features: ridge, nearest neighbours, and a curve through a few columns.

Shapes: features [N, D], values [N, T] in the task's units, NaN = not measured. Each target is fitted on the rows that have
it. A fitted regressor is a function from features to values [N, T].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import SplineTransformer, StandardScaler

from mvitac.evaluation.classifiers import threadpools

Regressor = Callable[[np.ndarray], np.ndarray]

ALPHAS = tuple(10.0**k for k in range(-1, 6))
"""Candidate strengths of ridge regularisation, on standardised features and targets."""
NEIGHBOURS = 20
RARE = 0.003
"""A feature that has one value in all but this share of the rows is left out of ridge regression."""


class FeatureScaler(StandardScaler):
    """Zero mean and unit variance; a feature that has one value in nearly all rows becomes 0.

    After a ReLU, a feature may be 0 in all rows but one. Its standard deviation is then so small that an ordinary value in
    another row comes to thousands of them, and to predictions of metres where millimetres are measured.
    """

    def fit(self, X: np.ndarray, y: Any = None, sample_weight: Any = None) -> "FeatureScaler":
        super().fit(X, y, sample_weight)
        usual = np.median(X[:: len(X) // 1000 + 1], axis=0)  # of some rows, which is much faster and as good
        rare = (usual != X).mean(axis=0) < RARE
        self.scale_ = np.where(rare, np.inf, self.scale_)
        return self


def fit_ridge(x: np.ndarray, y: np.ndarray, num_val: int) -> "tuple[Joined, list[float]]":
    """Fit ridge regression on standardised features and targets; returns the regressor and each target's alpha.

    Each alpha is chosen on the last ``num_val`` rows, which hold groups of their own. The final fit uses all rows.
    """
    fitted = _fit_each(x, y, num_val, lambda: [FeatureScaler()])
    return Joined(fitted), [float(pipeline[-1].alpha_) for pipeline, _, _ in fitted]


def fit_curve(x: np.ndarray, y: np.ndarray, num_val: int) -> Regressor:
    """Fit a smooth curve: ridge on cubic splines of each column of ``x``, for controls of a few columns."""
    return Joined(_fit_each(x, y, num_val, lambda: [StandardScaler(), SplineTransformer(6, extrapolation="linear")]))


def fit_neighbours(x: np.ndarray, y: np.ndarray) -> Regressor:
    """Mean value of the 20 nearest rows by cosine."""
    fitted = []
    for target in y.T:
        have = ~np.isnan(target)
        model = KNeighborsRegressor(n_neighbors=min(NEIGHBOURS, int(have.sum())), metric="cosine")
        fitted.append((model.fit(x[have], target[have]), 0.0, 1.0))
    return Joined(fitted)


Fitted = tuple[Any, float, float]
"""A scikit-learn regressor of one standardised target, and the target's mean and standard deviation."""


def _fit_each(x: np.ndarray, y: np.ndarray, num_val: int, before: Callable[[], list[Any]]) -> list[Fitted]:
    x = x.astype(np.float64)  # in float32 the normal equations of correlated features are ill-conditioned
    held = np.where(np.arange(len(x)) < len(x) - num_val, -1, 0)  # -1: always fitted on, 0: held out
    fitted = []
    for target in y.T:
        have = ~np.isnan(target)
        mean, std = target[have].mean(), target[have].std() + 1e-12
        both = len(set(held[have])) == 2
        ridge = RidgeCV(ALPHAS, cv=PredefinedSplit(held[have]) if both else None)
        with threadpools().limit(limits=1):  # as for logistic regression: threads wait longer than they compute
            pipeline = make_pipeline(*before(), ridge).fit(x[have], (target[have] - mean) / std)
        fitted.append((pipeline, mean, std))
    return fitted


@dataclass(frozen=True)
class Joined:
    """The regressors of all targets as one: features [N, D] to values [N, T]."""

    fitted: list[Fitted]

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return np.stack([model.predict(z) * std + mean for model, mean, std in self.fitted], axis=1)

    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Weight [T, D] and bias [T] of ridge regression, with all scaling folded in: values = x W^T + b."""
        weights, biases = [], []
        for (scaler, ridge), mean, std in self.fitted:
            weights.append(ridge.coef_ / scaler.scale_ * std)
            biases.append(ridge.intercept_ * std + mean - weights[-1] @ scaler.mean_)
        return np.stack(weights), np.array(biases)
