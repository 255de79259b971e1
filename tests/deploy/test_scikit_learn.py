"""The encoders as a scikit-learn transformer."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import mvitac
from mvitac import ImageFeatures
from mvitac.data.pack import Pack

NUM = 72


@pytest.fixture(scope="module")
def files(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    folder = tmp_path_factory.mktemp("images")
    paths = {m: [folder / f"{m}{i}.png" for i in range(NUM)] for m in ("vision", "touch")}
    for modality, names in paths.items():
        for row, name in enumerate(names):
            Image.fromarray(pack.images[modality][row]).save(name)
    return paths


def test_a_pipeline_learns_from_paths(smoke_run: Path, pack: Pack, files: dict[str, list[Path]]) -> None:
    labels = pack.column("label_bright")[:NUM]
    pipeline = make_pipeline(ImageFeatures(smoke_run), StandardScaler(), LogisticRegression(max_iter=1000))
    split = {"cv": GroupKFold(3), "groups": pack.column("group")[:NUM]}
    assert cross_val_score(pipeline, files["touch"], labels, **split).mean() > 0.75  # chance is .5
    fitted = clone(pipeline).fit(files["touch"], labels)
    assert (fitted.predict(np.array([str(f) for f in files["touch"]])) == labels).mean() > 0.9


def test_features_are_the_models(smoke_run: Path, pack: Pack, files: dict[str, list[Path]]) -> None:
    model = mvitac.load(smoke_run)
    embedded = model.embed(vision=pack.images["vision"][:NUM], touch=pack.images["touch"][:NUM])
    both = np.concatenate([embedded["vision"], embedded["touch"]], axis=1)
    for modality, expected in [("touch", both[:, 64:]), ("vision", both[:, :64])]:
        found = clone(ImageFeatures(model, modality)).fit_transform(files[modality])
        np.testing.assert_array_equal(found, expected)
    pairs = list(zip(files["vision"], files["touch"], strict=True))
    frame = pytest.importorskip("pandas").DataFrame({"touch": files["touch"], "vision": files["vision"], "other": 0})
    each = ImageFeatures(smoke_run, "both").fit(pairs)
    assert len(each.get_feature_names_out()) == 128
    for given in (pairs, frame, np.array(pairs).astype(str)):
        np.testing.assert_array_equal(each.transform(given), both)
