"""Encoders of other people: opened by name, and probed beside our runs under the same protocol.

Nothing here or below imports what opens them (``bench.external``). Another package plugs in by one entry of ``OPENERS``.
"""

import importlib
from collections.abc import Sequence
from typing import Any

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask
from mvitac.evaluation.controls import Records
from mvitac.evaluation.leaks import declared_leak
from mvitac.evaluation.probe import probe_model, probes_of
from mvitac.registry import unknown
from mvitac.system.progress import work

OPENERS = {"external": "mvitac.bench.external"}
"""How the text that names an encoder begins, before ":" -> the module whose ``open_model`` opens it."""
Bound = tuple[Any, Pack]  # an encoder, as ``bench.external.ExternalModel``, and the data, bound to each other


def is_encoder(text: object) -> bool:
    return isinstance(text, str) and text.partition(":")[0] in OPENERS


def open_encoder(text: str) -> Any:
    """The encoder that ``text`` names, a model; ValueError if there is none."""
    if not is_encoder(text):
        raise unknown("encoder", text, [f"{start}:..." for start in OPENERS])
    return importlib.import_module(OPENERS[text.partition(":")[0]]).open_model(text)


def open_encoders(texts: Sequence[str], pack: Pack | None) -> list[Bound]:
    """Open the encoders that ``texts`` name, for ``pack``; ValueError if two have one title and seed."""
    if texts and pack is None:
        raise ValueError("an encoder has no data of its own: name a pack with --on PACK")
    found: list[Bound] = []
    for model in map(open_encoder, texts):
        if any((model.title, model.seed) == (other.title, other.seed) for other, _ in found):
            who = f"{model.title!r} with seed {model.seed}"
            raise ValueError(f"{model.text}: {who} is given twice: give it a title=NAME")
        assert pack is not None
        found.append(model.on(pack))
    return found


def probe_encoders(
    encoders: Sequence[Bound],
    tasks: Sequence[AnyTask],
    modalities: Sequence[str],
    probes: Sequence[str],
    *,
    controls: bool,
) -> Records:
    """Records of each encoder and, with ``controls``, of the same networks with random weights."""
    records: Records = []
    for model, pack in encoders:
        random = model.untrained() if controls else None
        num = (2 if random else 1) * len(modalities) * sum(len(probes_of(task, probes)) for task in tasks)
        with work(f"probing {model.title}", num, "probes"):
            for each, own in ((model, {"encoder": model.text}), *(((random, {}),) if random else ())):
                leak = declared_leak(each.trained_on, [pack.spec.name.split(" (")[0]])
                known = {"source": each.title, "seed": each.seed, **own, "leak": leak}
                records += [{**known, **record} for record in probe_model(each, pack, tasks, modalities, probes)]
    return records


def about_lines(described: Sequence[dict[str, Any]]) -> list[str]:
    """What stands below a table about its encoders (``ExternalModel.describe``): licence, parameters, training data."""
    modalities: dict[str, list[str]] = {}
    for model in described:
        for modality, encoder in model["encoders"].items():
            use = ", no commercial use" if encoder["noncommercial"] else ""
            line = (
                f"{encoder['title']}: {encoder['parameters'] / 1e6:.3g} M parameters; licence {encoder['licence']}{use};"
                f" trained on {encoder['trained_on']}; {encoder['source']}; {encoder['features']} features of"
            )
            modalities.setdefault(line, []).append(modality)
    lines = [f"{line} {' and '.join(dict.fromkeys(found))}" for line, found in modalities.items()]
    return [*lines, *dict.fromkeys(f"{model['title']}: {note}" for model in described for note in model["notes"])]
