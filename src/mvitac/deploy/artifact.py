"""The artifact: one folder with a trained model and everything needed to use it correctly.

    <artifact>/artifact.json       format, preprocessing, probes with class names or units and scores, data, digests
               model.safetensors   encoders and heads into the shared space
               probes.safetensors  trained linear probes (absent where the data has no labels)
               run.json            provenance: method, data, optimiser, seed, versions, commit
               README.md           the model card

``load`` takes a run's folder, an artifact or an id on the Hugging Face Hub. Nothing is unpickled, every file is checked
against its digest before it is parsed, and no file with another name is opened.
"""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import safetensors.torch
from huggingface_hub import ModelHubMixin
from torch import nn

from mvitac import model_files
from mvitac.evaluation.encoders import is_encoder, open_encoder
from mvitac.model import Model
from mvitac.nn.linear_probe import LinearProbe, ProbeInfo, ValueInfo
from mvitac.registry import from_json, to_json
from mvitac.system.files import brief, digest, digest_file, read_json
from mvitac.transforms.random_views import IMAGENET_MEAN, IMAGENET_STD

FORMAT, FORMAT_VERSION = "mvitac-artifact", 1
MANIFEST = "artifact.json"
FILES = ("model.safetensors", "probes.safetensors", "run.json", "trained_on.safetensors", "README.md")
"""The only names an artifact may use."""
PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".bin", ".ckpt", ".npy", ".npz", ".joblib")
"""Suffixes of files that some program may unpickle. An artifact has none: one that does was changed."""
MAX_HEADER, MAX_MANIFEST = 4 << 20, 1 << 20
"""Maximum bytes: the safetensors header of a ResNet takes some 20 kB; one of gigabytes would fill the memory."""
AS_GIVEN = "none is subtracted: tactile images are used as the sensor gives them"
SUBTRACTED = (
    "subtracted: touch is (touch - background) / 2 + 128, the background being what the sensor shows without contact;"
    " `mvitac live` learns it and does this, `embed` and `predict` do it given background=..., whoever calls an export"
    " does it first"
)
LAYOUT = (
    "channels are those of the newest frame first, then of older ones; frames are `stride` units of column `order` apart"
    " (time: seconds, else: frames); at the start of a touch its first frame repeats; minus_first: each frame is"
    " (frame - first frame of the touch) / 2 + 128"
)
HUB_ID = re.compile(r"(?P<repo>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(@(?P<revision>[\w./-]+))?")


class PublishedModel(Model, ModelHubMixin):
    """A model from an artifact, with the Hub's usual ``from_pretrained``, ``save_pretrained`` and ``push_to_hub``.

    An upload copies the artifact file by file; a download is checked like a local artifact.
    """

    def __init__(self, model: Model, folder: Path) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(vars(model))
        self.folder = folder
        self._hub_mixin_config = None  # run.json and artifact.json hold all of it: no config.json

    @classmethod
    def from_pretrained(
        cls, pretrained_model_name_or_path: str | Path, *, revision: str | None = None, **options: Any
    ) -> "PublishedModel":
        """The artifact in a folder, or of "owner/name" on the Hub.

        Args:
            pretrained_model_name_or_path: folder or Hub id.
            revision: branch, tag or commit on the Hub.
            options: those of ``huggingface_hub.snapshot_download`` (token, cache_dir, local_files_only, force_download).
        """
        local = Path(pretrained_model_name_or_path)
        return read(local if local.is_dir() else pull(str(pretrained_model_name_or_path), revision, **options))

    def _save_pretrained(self, save_directory: Path) -> None:
        for name in (MANIFEST, *read_manifest(self.folder)["files"]):
            shutil.copyfile(self.folder / name, save_directory / name)


def load(path: str | Path, which: model_files.Which = "last") -> Model:
    """Load a trained model, in eval mode; from an artifact with its probes (``Model.predict``).

    Args:
        path: folder of a run or an artifact, "external:..." for an encoder of other people (``bench.external``), or
            "owner/name[@revision]" on the Hugging Face Hub. Only a ``str`` that is no folder here is looked up there.
        which: weights of a run: "last", or "best" on split val (kept with ``--eval-every``).

    Raises:
        ValueError: nothing is there, or it is damaged.

    Examples:
        model = mvitac.load("artifacts/first")
        probabilities = model.predict(vision=photo, touch=press)
    """
    if is_encoder(path):
        return open_encoder(str(path))
    local = Path(path)
    found = HUB_ID.fullmatch(path) if isinstance(path, str) else None
    # "runs/frist" beside a folder runs/ is a typing mistake, not a repository.
    if found and not local.exists() and not local.parent.is_dir():
        return read(pull(found["repo"], found["revision"]))
    return read(local) if (local / MANIFEST).is_file() else model_files.load(local, which)


def pull(repo: str, revision: str | None = None, **options: Any) -> Path:
    """Download the artifact ``repo`` into the local cache of the Hub; only files that an artifact may have are fetched."""
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repo, revision=revision, allow_patterns=[MANIFEST, *FILES], **options))
    except Exception as error:  # offline, not found, no access: the client has an exception for each
        raise ValueError(
            f"there is no folder {repo} here, and it could not be downloaded from the Hugging Face Hub ({brief(error)}):"
            " give the folder of a run or an artifact, or check the id, the network and the login (`hf auth login`)"
        ) from None


def preprocessing(model: Model) -> dict[str, Any]:
    """Description of the preprocessing from a camera's frame to the encoders' input, JSON-ready."""
    return {
        "input": "uint8 RGB [H, W, C]; OpenCV's frames are BGR: reverse their channels",
        "colour_order": "RGB",
        "channels": {m: model.spec.channels(m) for m in model.encoders},
        "stored": model.stored,
        "size": model.run.augment.eval_size,
        "resize": "squash to stored (Pillow bilinear), then to size (antialiased bilinear)",
        "mean": list(IMAGENET_MEAN),
        "std": list(IMAGENET_STD),
        "difference": model.spec.difference,
        "background": SUBTRACTED if model.spec.difference else AS_GIVEN,
        "sensors": list(model.spec.sensors),
        **({"window": {**to_json(model.spec.window), "layout": LAYOUT}} if model.spec.window.active else {}),
    }


def read(folder: Path) -> PublishedModel:
    """The model in the artifact ``folder``, with its probes; ValueError if anything was changed since it was published."""
    manifest = read_manifest(folder)
    model = model_files.load(folder / "model.safetensors")
    asked, given = preprocessing(model), manifest["preprocessing"]
    for name in ("colour_order", "mean", "std", "stored", "size", "channels", "window"):
        if given.get(name) != asked.get(name):
            raise ValueError(
                f"{folder}: artifact.json says {name} {given.get(name)}, its model was trained with {asked.get(name)}:"
                " predictions would be wrong, publish it again"
            )
    # Those of the probes, too; older artifacts name the sensors only here.
    model.spec = replace(model.spec, sensors=from_json(tuple[str, ...], given.get("sensors", []), "sensors"))
    model.probes = read_probes(folder, manifest, model)
    return PublishedModel(model, folder).eval()


def read_manifest(folder: Path) -> dict[str, Any]:
    """artifact.json of ``folder``, after checking every file that it names; ValueError otherwise."""
    path = folder / MANIFEST
    if path.is_file() and path.stat().st_size > MAX_MANIFEST:
        raise ValueError(f"{path} has {path.stat().st_size} bytes: no artifact needs more than {MAX_MANIFEST}, refused")
    manifest = read_json(path, "an artifact's description")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{path} does not describe an artifact: give a folder `mvitac publish` wrote")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format {manifest.get('format_version')}, this version reads {FORMAT_VERSION}: publish it again"
        )
    if manifest.get("digest") != seal(manifest):
        raise ValueError(f"{path} does not match its digest: it was changed or damaged, copy it again")
    files = manifest.get("files")
    if not isinstance(files, dict) or not isinstance(manifest.get("preprocessing"), dict):
        raise ValueError(f"{path} names no files or no preprocessing: it was not written by `mvitac publish`")
    for name in files:
        if name not in FILES:
            raise ValueError(f"{path} names a file {name!r}: an artifact holds only {', '.join(FILES)}, refused")
    if not {"model.safetensors", "run.json"} <= files.keys():
        raise ValueError(f"{path} lacks model.safetensors or run.json: it was not written by `mvitac publish`")
    for there in sorted(folder.iterdir()):
        if there.suffix.lower() in PICKLES:
            raise ValueError(f"{there} is a file that programs unpickle: an artifact has none, refused")
    for name, expected in files.items():
        if not (folder / name).is_file():
            raise ValueError(f"{folder / name} is missing: copy the artifact again")
        if name.endswith(".safetensors"):
            check_header(folder / name)
        if digest_file(folder / name) != expected:
            raise ValueError(f"{folder / name} does not match its digest: it was changed or damaged, copy it again")
    return manifest


def seal(manifest: dict[str, Any]) -> str:
    """The digest of a manifest without its own ``digest`` field."""
    return digest({key: value for key, value in manifest.items() if key != "digest"})


def check_header(path: Path) -> None:
    """ValueError if ``path`` does not begin as a safetensors file of sane size."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        first = file.read(1)
    if length > MAX_HEADER:
        raise ValueError(f"{path} announces a header of {length} bytes: no model needs more than {MAX_HEADER}, refused")
    if first != b"{" or 8 + length > path.stat().st_size:
        raise ValueError(f"{path} is no safetensors file: an artifact holds no other kind of weights, refused")


def read_probes(folder: Path, manifest: dict[str, Any], model: Model) -> dict[str, LinearProbe]:
    """The probes of ``folder`` by name; ValueError if names, shapes or classes do not fit the model."""
    try:
        classes: tuple[ProbeInfo, ...] = from_json(tuple[ProbeInfo, ...], manifest.get("probes"), "probes")
        values: tuple[ValueInfo, ...] = from_json(tuple[ValueInfo, ...], manifest.get("values", []), "values")
    except ValueError as error:
        raise ValueError(f"{folder / MANIFEST} is damaged ({error}): publish it again") from None
    infos = (*classes, *values)
    if not infos:
        return {}
    path = folder / "probes.safetensors"
    if path.name not in manifest["files"]:
        raise ValueError(f"{folder / MANIFEST} describes probes but names no {path.name}: publish it again")
    tensors = safetensors.torch.load_file(path)
    expected = {f"{q.name}.{part}" for q in infos for part in ("weight", "bias")}
    for name in sorted(expected ^ tensors.keys()):
        where = "is missing" if name in expected else "does not belong"
        raise ValueError(f"{path}: tensor {name!r} {where}: publish the artifact again")
    probes = {}
    for info in infos:
        if unknown := set(info.modalities) - set(model.encoders):
            raise ValueError(f"{path}: probe {info.name} needs {unknown}, which this model has no encoder for")
        dim = sum(int(model.encoders[m].num_features) for m in info.modalities)  # type: ignore[arg-type]
        probe = LinearProbe(info, tensors[f"{info.name}.weight"], tensors[f"{info.name}.bias"])
        if probe.weight.shape[1] != dim:
            raise ValueError(f"{path}: probe {info.name} reads {probe.weight.shape[1]} features, the model gives {dim}")
        probes[info.name] = probe
    return probes
