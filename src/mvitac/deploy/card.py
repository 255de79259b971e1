"""The model card of an artifact: what the model is, an example, scores next to controls, preprocessing, data."""

import json
import textwrap
from functools import partial
from typing import Any

import jinja2

from mvitac.data.spec import listed
from mvitac.evaluation.score_text import columns_of, covered, pipes, score_name, score_rows, tested_on
from mvitac.model import Model
from mvitac.nn.linear_probe import ValueInfo
from mvitac.system.files import fields_of


def card(model: Model, about: dict[str, Any]) -> str:
    """The model card: Markdown with the Hub's front matter. ``about`` is what artifact.json says."""
    data, learned, scores = about["data"], about["trained_on"], about["scores"]
    same = learned == {key: data[key] for key in learned}
    sets = {"Encoders and probes": learned} if same else {"Encoders": learned, "Probes": data}
    licences = ", and ".join(dict.fromkeys(one["licence"] for one in sets.values()))
    pages = jinja2.Environment(finalize=_harmless, undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    pages.loader = jinja2.PackageLoader("mvitac", "deploy")
    with fields_of("run.json"):
        text = pages.get_template("card.md.j2").render(
            about,
            model=model,
            run=model.run,
            sets=sets,
            licence=json.dumps(f"weights: as their owner says; trained on data under: {licences}"),
            tables=_tables(model, scores),
            names=dict.fromkeys(score_name(task) for task in scores["summary"].values()),
            leaks=list(dict.fromkeys(probe.info.leak for probe in model.probes.values() if probe.info.leak)),
            covered=covered(scores["group_by"], [{"source": "run", "seed": 0}]),
            listed=listed,
        )
    as_it_is = ("|", "license")  # tables and the front matter
    wrap = partial(textwrap.fill, width=120, break_long_words=False, break_on_hyphens=False)
    return "\n".join(line if line.startswith(as_it_is) else wrap(line) for line in text.split("\n"))


def _harmless(value: object) -> str:
    """Text in which labels and notes of the data make no line, HTML, image, link or terminal escape in Markdown."""
    return "".join(c if c.isprintable() else " " for c in str(value)).replace("<", "&lt;").replace("](", r"]\(")


def _tables(model: Model, scores: dict[str, Any]) -> list[str]:
    """Lines of a table per task: accuracy or R2 with its interval, next to the controls; of values their errors too."""
    lines = []
    for name, task in scores["summary"].items():
        columns = columns_of(task)
        heads = [f"{name} ({tested_on(task, scores['group_by'])})", *columns]
        lines += pipes(heads, score_rows(task, columns), words=1)
        probes = [probe.info for probe in model.probes.values() if probe.info.task == name]
        if infos := [info for info in probes if isinstance(info, ValueInfo)]:
            errors = [[f"{e.mae:.3g} ({e.rmse:.3g})" for e in info.errors] for info in infos]
            rows = [[t.name, *(f"{e[i]} {t.unit}" for e in errors)] for i, t in enumerate(infos[0].targets)]
            heads = ["mean absolute error (root mean square)", *(info.modality for info in infos)]
            lines += pipes(heads, rows, words=1)
    return lines
