"""Trained encoders as a scikit-learn transformer: from images to features.

pipeline = make_pipeline(ImageFeatures("artifacts/mine", "touch"), StandardScaler(), LogisticRegression())
pipeline.fit(paths, labels)
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from mvitac.deploy.artifact import load
from mvitac.model import Model
from mvitac.nn.encoders import num_features
from mvitac.transforms.preprocess import ImageInput


class ImageFeatures(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """Features of frozen encoders (``Model.embed``). ``fit`` loads the model and learns nothing.

    Args:
        model: Folder of a run or an artifact, an id on the Hugging Face Hub, or a loaded model. With several processes
            (``n_jobs``) a path is better: a model is copied to each.
        modality: touch, vision, or both (vision's features first).
        background: For models trained on difference images: the touch sensor without contact, one image.

    Attributes:
        model_: The loaded model.
        names_: Its modalities, in the order of their features.

    Examples:
        >>> ImageFeatures("artifacts/mine").fit_transform(["a.png", "b.png"]).shape  # doctest: +SKIP
        (2, 512)
    """

    def __init__(
        self,
        model: str | Path | Model,
        modality: Literal["touch", "vision", "both"] = "touch",
        background: ImageInput | None = None,
    ) -> None:
        self.model = model
        self.modality = modality
        self.background = background

    def fit(self, X: Any, y: Any = None) -> "ImageFeatures":
        """Load the model; ValueError if there is none, or it has no such encoder. ``X`` and ``y`` are not used."""
        self.model_ = self.model if isinstance(self.model, Model) else load(self.model)
        self.names_ = ("vision", "touch") if self.modality == "both" else (self.modality,)
        for name in self.names_:
            self.model_.check_modality(name)
        self._n_features_out = sum(num_features(self.model_.encoders[m]) for m in self.names_)
        return self

    def transform(self, X: Sequence[Any] | np.ndarray) -> np.ndarray:
        """Features [N, D] float32 of N images of any kind that ``Model.embed`` takes; for "both" of N pairs (vision, touch).

        A data frame of paths is read by its columns "vision" and "touch". ValueError if images do not fit the model.
        """
        check_is_fitted(self)
        names = self.names_
        if hasattr(X, "columns"):
            columns = [list(X[name]) for name in names]  # type: ignore[call-overload]
        elif self.modality == "both":
            columns = [[pair[i] for pair in X] for i in (0, 1)]
        else:
            columns = [X]
        given: dict[str, Any] = dict(zip(names, columns, strict=True))
        features = self.model_.embed(**given, background=self.background)
        return np.concatenate([features[name].cpu().numpy() for name in names], axis=1)
