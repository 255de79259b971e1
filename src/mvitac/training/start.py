"""Start weights from another model (``Run.init``): read them, load what fits, and say what that model learned from."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from mvitac.data.pack import Pack
from mvitac.evaluation import leaks
from mvitac.methods.base import Method
from mvitac.model import BEST, Model, load
from mvitac.nn.encoders import within
from mvitac.nn.initial import Init
from mvitac.nn.momentum import Momentum
from mvitac.nn.weights import State, below, load_weights, misfit
from mvitac.run import Run


@dataclass(frozen=True)
class Start:
    init: Init
    model: Model
    sources: list[leaks.Source]  # what its weights were trained on


def read_start(init: Init) -> Start | None:
    """Read the model of ``init``; None if it names none."""
    if not init:
        return None
    model, folder = load(init.file), init.file.parent
    # Only the folder of a run or an artifact knows what its model learned from: a copied file is unknown.
    own = init.file.name.startswith("model.") and (folder / "run.json").exists()
    found = leaks.read_sources(folder, "best" if init.file.name == BEST else "last") if own else None
    learned = [leaks.unknown_source(folder.name if own else init.file.name)] if found is None else found
    # Those that chose the best weights here taught whatever starts from them, its last weights, too.
    learned = [replace(s, name=f"{s.name} of {folder.name}") if s.name.endswith(leaks.CHOSE) else s for s in learned]
    return Start(init, model, learned)


def load_trunk(trunk: nn.Module, state: State, file: Path | str = "it") -> None:
    """Load ``state``, the state dict of a trunk from ``build_trunk`` or timm, into another trunk (``load_weights``).

    How frames and stages are combined does not matter. ValueError, which names ``file``, if they are different networks;
    ``trunk`` is then unchanged.
    """
    while inside := below("trunk.", state):
        state = inside
    load_weights(within(trunk), state, file)


def load_start(start: Start, method: Method) -> dict[str, Any]:
    """Load start weights into a new method, by modality, and into its momentum copies.

    Returns what was taken, for the record: name, digest, modality -> parts, names of what the weights were trained on,
    and why a modality was not taken. ValueError if nothing fits, or a modality that was asked for does not.
    """
    init, given, taken, reasons = start.init, start.model, {}, {}
    trunks, heads = method.encoders(), method.projectors()
    for modality in init.modalities or trunks:
        if modality not in given.encoders:
            reasons[modality] = f"it has {' and '.join(given.encoders)} only"
            continue
        try:
            load_trunk(trunks[modality], given.encoders[modality].state_dict(), init.path or "")
        except ValueError as error:
            reasons[modality] = f"its trunk is {given.run.encoder.named(given.encoders)}, {error}"
            continue
        taken[modality] = ["trunk"]
        head = given.projectors[modality].state_dict() if modality in given.projectors else {}
        if init.heads and modality in heads and not misfit(heads[modality].state_dict(), head):
            heads[modality].load_state_dict(head)
            taken[modality].append("head")
    if reasons and (init.modalities or not taken):
        why = "; ".join(f"{modality}: {reason}" for modality, reason in reasons.items())
        raise ValueError(f"init {init.path} does not fit this run ({why}): give weights of the same --encoder.trunk")
    for module in method.modules():
        if isinstance(module, Momentum):
            module.follow(0.0)  # a copy of what was loaded
    names = list(dict.fromkeys(source.name for source in start.sources))
    assert init.path
    found = {"name": init.path.name, "digest": init.digest, "taken": taken, "trained_on": names}
    return {**found, **({"not_taken": reasons} if reasons else {})}


def describe(record: dict[str, Any]) -> str:
    parts = [f"{modality} {' and '.join(names)}" for modality, names in record["taken"].items()]
    parts += [f"not {modality} ({reason})" for modality, reason in record.get("not_taken", {}).items()]
    return f"starts from {record['name']} (sha256 {record['digest'][:12]}): {', '.join(parts)}"


def warning(run: Run, start: Start | None, sources: list[leaks.Source], pack: Pack) -> str:
    """A line on rows of split test that start weights were trained on (``sources``), or may have been; "" if none."""
    if not sources:
        return ""
    tested = [pack.rows("test", only=task.only, by=task.split) for task in pack.spec.all_tasks] or [pack.rows("test")]
    rows = np.unique(np.concatenate(tested))
    leak = leaks.Scored(pack).leak(sources, rows) if len(rows) else ""
    path = start.init.path if start else ", ".join(map(str, leaks.weights_files(run)))
    if leak == leaks.UNKNOWN:
        return f"nothing says what {path} was trained on: leaks of test rows cannot be excluded"
    return leak and f"{path} has seen what this data tests: {leak}; `mvitac probe` will need --allow-leak"
