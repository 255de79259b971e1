"""The model card of an artifact: what the model is, an example, scores next to controls, preprocessing, data."""

import json
from typing import Any

from mvitac.data.spec import listed
from mvitac.evaluation.score_text import cell_text, columns_of, covered, pipes, score_name, sources_of, tested_on
from mvitac.model import Model
from mvitac.nn.linear_probe import ValueInfo
from mvitac.system.files import fields_of


def card(model: Model, manifest: dict[str, Any]) -> str:
    """The model card: Markdown with the Hub's front matter."""
    data, learned = manifest["data"], manifest["trained_on"]
    sets = {"Encoders and probes": learned}
    if learned != {key: data[key] for key in learned}:
        sets = {"Encoders": learned, "Probes": data}
    licences = ", and ".join(dict.fromkeys(one["licence"] for one in sets.values()))
    header = [
        "---",
        "library_name: mvitac",
        "tags: [tactile, robotics, self-supervised, visual-tactile]",
        "license: other",
        f"license_name: {json.dumps('weights: as their owner says; trained on data under: ' + licences)}",
        "---",
        "",
    ]
    end = [
        "## Data",
        "",
        *(f"{what}: {one['name']}; source: {one['source']}; licence: {one['licence']}." for what, one in sets.items()),
        *_start(manifest.get("start")),
        "The configuration, library versions and commit are in run.json.",
        "",
    ]
    about = _about(model, learned["name"], data["name"], manifest["scores"])
    return "\n".join(map(_harmless, [*header, *about, *_usage(manifest["preprocessing"]), *end]))


def _harmless(line: str) -> str:
    """One line of Markdown in which labels and notes of the data make no HTML, image, link or terminal escape."""
    text = "".join(c if c.isprintable() else " " for c in line)
    return text.replace("<", "&lt;").replace("](", r"]\(")


def _start(start: dict[str, Any] | None) -> list[str]:
    """A line on the weights that training started from, as its record says; nothing without them."""
    if not start:
        return []
    with fields_of("run.json"):
        parts = [f"{modality} {' and '.join(names)}" for modality, names in start["taken"].items()]
        return [
            f"Started from the weights of {start['name']} (sha256 {start['digest']}): {', '.join(parts)}. They were trained"
            f" on: {', '.join(start['trained_on'])}. The data's licences above are not theirs."
        ]


def _about(model: Model, learned: str, data: str, scores: dict[str, Any]) -> list[str]:
    """The part of the model card on the model: what it is, an example, scores, classes."""
    run = model.run
    said = "probabilities" if not model.targets else "probabilities_and_values" if model.classes else "values"
    return [
        f"# {run.method.name} on {learned}",
        "",
        f"Encoders of {' and '.join(model.encoders)} images ({run.encoder.trunk}),"
        f" {'trained with labels' if model.tasks else 'pre-trained without labels'} by"
        f" `{run.method.name}` (recipe `{run.recipe}`, seed {run.seed}), with linear probes on {data}.",
        "",
        "```python",
        "import mvitac",
        'model = mvitac.load("this folder, or owner/name on the Hub")   # never unpickles, checks every digest',
        f"{said} = model.predict({', '.join(f'{m}={m}_image' for m in model.encoders)})   # uint8 RGB, any size",
        "```",
        "",
        "## Scores",
        "",
        *_score_tables(model, scores),
        *_listed("Classes", {task: ", ".join(c) for task, c in model.classes.items()}),
        *_listed(
            "Values", {task: ", ".join(f"{t.name} in {t.unit}" for t in ts) for task, ts in model.targets.items()}
        ),
    ]


def _listed(title: str, rows: dict[str, str]) -> list[str]:
    """A section of the model card with one line per task; nothing without tasks."""
    return [f"## {title}", "", *(f"- {task}: {text}" for task, text in rows.items()), ""] if rows else []


def _score_tables(model: Model, scores: dict[str, Any]) -> list[str]:
    """A Markdown table per task: accuracy or R2 with its interval, next to the controls; of values their errors too."""
    if not scores["summary"]:
        return ["No task has labelled rows in train and test.", ""]
    by = scores["group_by"]
    leaks = dict.fromkeys(r.info.leak for r in model.probes.values() if r.info.leak)
    unseen = f"{by}s that neither encoders nor probes saw"
    if leaks:
        unseen = f"test rows. LEAK, what the encoders saw of them: {'; '.join(leaks)}"
    names = dict.fromkeys(score_name(task).capitalize() for task in scores["summary"].values())
    lines = [
        f"{' or '.join(names)} in percent of linear probes, on {unseen}. The rows below the first are controls."
        f" 95 % intervals: {covered(by, [{'source': 'run', 'seed': 0}])}.",
        "",
    ]
    for name, task in scores["summary"].items():
        columns = columns_of(task)
        rows = [[s, *(cell_text(task, s, m) for m in columns)] for s in sources_of(task)]
        lines += pipes([f"{name} ({tested_on(task, by)})", *columns], rows, words=1)
        lines += _errors([r.info for r in model.probes.values() if r.info.task == name])
    return [*lines, *(line for note in scores["notes"] for line in (f"Note: {note}.", ""))]


def _errors(infos: list[Any]) -> list[str]:
    """A Markdown table of the errors of one task's probes, in the unit of each target; nothing for classes."""
    infos = [q for q in infos if isinstance(q, ValueInfo)]
    if not infos:
        return []
    rows = []
    for t, target in enumerate(infos[0].targets):
        found = [f"{q.errors[t].mae:.3g} ({q.errors[t].rmse:.3g}) {target.unit}" for q in infos]
        rows.append([target.name, *found])
    return pipes(["mean absolute error (root mean square)", *(q.modality for q in infos)], rows, words=1)


def _usage(given: dict[str, Any]) -> list[str]:
    """The part of the model card on preprocessing."""
    return [
        "## Preprocessing",
        "",
        f"{given['input']}. {given['resize']}: stored {given['stored']} px, size {given['size']} px."
        f" Then (x / 255 - {given['mean']}) / {given['std']}. Background: {given['background']}.",
        f"Sensors seen: {listed(given['sensors']) or 'not recorded'}."
        " For another sensor, lamp or gel, check the accuracy before you rely on these predictions.",
        "",
    ]
