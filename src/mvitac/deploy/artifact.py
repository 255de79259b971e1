"""The artifact: one folder with a trained model and everything needed to use it correctly.

    <artifact>/artifact.json       format, preprocessing, probes with class names or units and scores, data, digests
               model.safetensors   encoders and heads into the shared space
               probes.safetensors  trained linear probes (absent where the data has no labels)
               run.json            provenance: method, data, optimiser, seed, versions, commit
               README.md           the model card

Nothing is unpickled, each file is checked by its digest before it is parsed, and no file of another name is opened.
"""

import re
from pathlib import Path
from typing import Any

from mvitac import model as models
from mvitac.evaluation.encoders import is_encoder, open_encoder
from mvitac.model import Model
from mvitac.nn.encoders import num_features
from mvitac.nn.linear_probe import LinearProbe, ProbeInfo, ValueInfo
from mvitac.nn.weights import read_safetensors
from mvitac.registry import from_json, to_json
from mvitac.shipped import named
from mvitac.system.files import brief, fields_of
from mvitac.system.sealed_folder import ARTIFACT

AS_GIVEN = "none is subtracted: tactile images are used as the sensor gives them"
SUBTRACTED = (
    "subtracted: touch is (touch - background) / 2 + 128, the background being the sensor without contact; `mvitac live`"
    " does this itself, `embed` and `predict` given background=..., and whoever calls an export does it first"
)
FIRST_SUBTRACTED = SUBTRACTED.replace("the sensor without contact", "the first frame of the touch")
LAYOUT = (
    "channels of the newest frame first; frames are `stride` units of column `order` apart (time: seconds); at the start"
    " of a touch its first frame repeats; minus_first: (frame - first frame of the touch) / 2 + 128"
)
HUB_ID = re.compile(r"(?P<repo>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(@(?P<revision>[\w./-]+))?")


def load(path: str | Path, which: models.Which = "last") -> Model:
    """Load a trained model, in eval mode; from an artifact with its probes (``Model.predict``).

    Args:
        path: "base" (the model that the package brings), folder of a run or an artifact, "external:..." for an encoder of
            other people (``bench.external``), or "owner/name[@revision]" on the Hugging Face Hub. Only a ``str`` that is no
            folder here is looked up there.
        which: weights of a run: "last", or "best" on split val (kept with ``--eval-every``).

    Raises:
        ValueError: nothing is there, or it is damaged.

    Examples:
        model = mvitac.load("artifacts/first")
        probabilities = model.predict(vision=photo, touch=press)
    """
    if is_encoder(path):
        return open_encoder(str(path))
    if not ((local := folder_of(path)) / ARTIFACT.name).is_file():
        return models.load(local, which)
    if which != "last":
        raise ValueError(f"{path} is an artifact, which has one set of weights: leave out {which!r}")
    return read(local)


def folder_of(path: str | Path) -> Path:
    """The folder that ``load`` reads; one on the Hub is fetched."""
    local = Path(named(path) if isinstance(path, str) else path)
    found = HUB_ID.fullmatch(path) if isinstance(path, str) else None
    # "runs/frist" beside a folder runs/ is a typing mistake, not a repository.
    if found and not local.exists() and not local.parent.is_dir():
        return pull(found["repo"], found["revision"])
    return local


def pull(repo: str, revision: str | None) -> Path:
    """Download the artifact ``repo`` into the local cache of the Hub; only files that an artifact may have are fetched."""
    from huggingface_hub import snapshot_download

    allowed = sorted({ARTIFACT.name, *ARTIFACT.required, *ARTIFACT.optional})
    try:
        return Path(snapshot_download(repo, revision=revision, allow_patterns=allowed))
    except Exception as error:  # offline, not found, no access: the client has an exception for each
        raise ValueError(f"no folder {repo} here, and no download from the Hugging Face Hub: {brief(error)}") from None


def preprocessing(model: Model) -> dict[str, Any]:
    """Description of the preprocessing from a camera's frame to the encoders' input, JSON-ready."""
    given = FIRST_SUBTRACTED if model.spec.window.minus_first and "touch" in model.spec.window.of else AS_GIVEN
    return {
        "input": "uint8 RGB [H, W, C]; OpenCV's frames are BGR: reverse their channels",
        "colour_order": "RGB",
        "channels": {m: model.spec.channels(m) for m in model.encoders},
        "stored": model.stored,
        "size": {m: model.image_sizes(m)[0] for m in model.encoders},
        "resize": "squash to stored (Pillow bilinear), then to size (antialiased bilinear)",
        "mean": {m: list(model.run.encoder[m].mean_std[0]) for m in model.encoders},
        "std": {m: list(model.run.encoder[m].mean_std[1]) for m in model.encoders},
        "difference": model.spec.difference,
        "background": SUBTRACTED if model.spec.difference else given,
        "crop": model.spec.crop,
        "sensors": list(model.spec.sensors),
        **({"window": {**to_json(model.spec.window), "layout": LAYOUT}} if model.spec.window.active else {}),
    }


def read(folder: Path) -> Model:
    """The model in the artifact ``folder``, with its probes; ValueError if anything was changed since it was published."""
    about = ARTIFACT.read(folder)
    model = models.load(folder / "model.safetensors")
    with fields_of(folder / ARTIFACT.name):
        asked, given = preprocessing(model), about["preprocessing"]
        for name in ("colour_order", "mean", "std", "stored", "size", "channels", "window"):
            if given.get(name) != asked.get(name):
                raise ValueError(f"{folder}: {name} is {given.get(name)}, its model was trained with {asked.get(name)}")
        classes = from_json(tuple[ProbeInfo, ...], about["probes"], f"{folder / ARTIFACT.name}: probes")
        values = from_json(tuple[ValueInfo, ...], about["values"], f"{folder / ARTIFACT.name}: values")
        path = folder / "probes.safetensors"
        tensors = read_safetensors(path)[1] if classes or values else {}
        for info in (*classes, *values):
            probe = LinearProbe(info, *(tensors[f"{info.name}.{part}"] for part in info.parts))
            dim, reads = sum(num_features(model.encoders[m]) for m in info.modalities), probe.weight.shape[1]
            if reads != dim:
                raise ValueError(f"{path}: probe {info.name} reads {reads} features, the model gives {dim}")
            model.probes[info.name] = probe
    return model.eval()
