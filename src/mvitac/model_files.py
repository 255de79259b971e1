"""Models of runs: before training, or from the file with their weights."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from mvitac.data.spec import DataSpec
from mvitac.model import ABOUT, Model
from mvitac.nn.weights import misfit, read_model
from mvitac.registry import from_json
from mvitac.run import Run
from mvitac.system.files import brief, parse_json

MAX_STORED = 1024  # px: no pack holds larger images (``data.storage``)
BEST = "model.best.safetensors"  # weights of a run that were best on split val, kept with ``Run.eval_every``
Which = Literal["last", "best"]


def weights_file(folder: Path, which: Which) -> Path:
    """The file of a run's weights; ValueError if the best ones were not kept."""
    if which == "best" and not (folder / BEST).is_file():
        raise ValueError(f"{folder} has no {BEST}: train with --eval-every N to keep the best weights, or use the last")
    return folder / (BEST if which == "best" else "model.safetensors")


def is_foreign(folder: Path) -> bool:
    """Whether ``folder`` is an artifact, which may be a stranger's: no place that its run names is opened."""
    return (folder / "artifact.json").exists()


def fresh(run: Run, spec: DataSpec, stored: int) -> Model:
    """The model of ``run`` before training, initialised from its seed. Used as a control, and to load weights into."""
    torch.manual_seed(run.seed)
    return Model(run.method.build(spec, run.encoder), run, spec, stored)


def load(path: str | Path, which: Which = "last") -> Model:
    """Load a trained model from the folder of a run or from its model.safetensors. Never unpickles.

    ``which`` weights of a folder: those after its last step, or the best on split val (``Run.eval_every``). ValueError if
    there is no such model, or the file is damaged or was changed.
    """
    path = Path(path)
    file = weights_file(path, which) if path.is_dir() else path
    if not file.is_file():
        hint = "; the run is not finished: `mvitac pretrain --resume`" if (path / "checkpoint.pt").exists() else ""
        raise ValueError(f"no trained model at {file}{hint}")
    header, tensors = read_model(file, ABOUT)
    try:
        run = Run.load(parse_json(header["run"]))
        spec: DataSpec = from_json(DataSpec, parse_json(header["spec"]), "spec")
        stored = int(from_json(int, parse_json(header["stored"]), "stored"))
        if not 1 <= stored <= MAX_STORED:
            raise ValueError(f"stored {stored}: expected 1 to {MAX_STORED} px")
    except (KeyError, ValueError) as error:
        raise ValueError(f"{file} has a damaged header ({brief(error)}): copy it again or re-train") from None
    # The file has all weights, so the empty model needs no pretrained ones, and no download.
    empty = run.fresh()
    # Check shapes before allocating: a damaged header may describe a network larger than the memory.
    with torch.random.fork_rng(devices=[]):  # keep the caller's random state
        with torch.device("meta"):
            if why := misfit(fresh(empty, spec, stored).state_dict(), tensors):
                raise ValueError(f"{file} holds other weights than its run describes: {why}")
        model = fresh(empty, spec, stored)
    model.foreign = is_foreign(file.parent)
    if model.foreign and run.init:
        run = replace(run, init=replace(run.init, path=None, digest=run.init.digest or "unknown"))
    model.run = run
    model.load_state_dict(tensors)
    return model
