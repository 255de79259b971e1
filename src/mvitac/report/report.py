"""The report of finished runs as one HTML page: verdict, tables, curves, pictures. No network."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mvitac import __version__
from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.probe import scorable
from mvitac.evaluation.retrieval import cross_modal
from mvitac.evaluation.run_names import names_of
from mvitac.evaluation.score_text import WORDS, above, covered, headline, percent, score_name, verdicts, with_interval
from mvitac.model import load
from mvitac.report import galleries, score_sections
from mvitac.report import sections as evidence
from mvitac.report.html import blocks as page
from mvitac.report.sections import Finished, Study
from mvitac.run import load_run
from mvitac.system.files import write_atomic
from mvitac.system.progress import shown, work
from mvitac.training.log import read_log

WRITTEN = "Written by mvitac"


def write_report(
    paths: Sequence[Path],
    out: Path,
    *,
    result: dict[str, Any] | None = None,
    pack: Pack | None = None,
    quiet: bool = False,
) -> Path:
    """Write ``out``/report.html and ``out``/figures/*.png about finished runs on the same data, and return the page.

    ``result`` is what ``probe_runs`` returned for these runs. Default: the probe.json in the first run's folder if it
    is complete (``stored_result``), else they are probed here, with logistic regression, all tasks and all controls.
    ``pack`` is shown instead of the runs' own. ValueError if a run is unfinished, or ``result`` is about others.
    """
    place = Path(out) / "report.html"
    if place.is_file() and WRITTEN not in place.read_text(errors="replace"):
        raise ValueError(f"{place} is no report: choose another --out")
    runs = open_runs(paths)
    if pack is None and len({r.record.get("pack") for r in runs}) > 1:
        raise ValueError("these runs were trained on different data: write one report per dataset")
    pack = pack or runs[0].model.open_data(quiet=quiet)
    if result is None and (result := stored_result(paths, pack)):
        if not quiet:
            print(f"scores: {paths[0] / 'probe.json'}")
    elif result is None:
        with shown(quiet=quiet):
            result = _probe(runs, pack)
    elif result["pack"] != pack.digest:
        raise ValueError("the probe result is about other data than these runs: probe them again")
    scored = {Path(r["run"]).resolve() for r in [*result["records"], *result["retrieval"]] if "run" in r}
    if scored and (other := scored ^ {run.path.resolve() for run in runs}):  # its means are of all of its runs
        names = ", ".join(map(str, sorted(other)))
        raise ValueError(f"the probe result and the report differ in {names}: probe them again")
    with shown(quiet=quiet):
        html = _page(Study(runs, pack, result, Path(out)))
    write_atomic(place, lambda file: file.write(html.encode()))
    return place


def open_runs(paths: Sequence[Path]) -> list[Finished]:
    """Load finished runs; ValueError if a folder holds none."""
    if not paths:
        raise ValueError("give at least one run's folder")
    opened = [(path, *load_run(path), read_log(path), load(path)) for path in paths]
    names = names_of([path for path, *_ in opened], [model for *_, model in opened])
    return [Finished(*each, name) for each, name in zip(opened, names, strict=True)]


def _probe(runs: Sequence[Finished], pack: Pack) -> dict[str, Any]:
    if usable := tuple(task.name for task in scorable(pack, "none" if pack.parts else "both")):
        return probe_runs([r.path for r in runs], ProbeConfig(tasks=usable), pack)
    own = [{"source": r.source, "seed": r.run.seed, "run": str(r.path)} for r in runs]
    found = [{**o, **f} for o, r in zip(own, runs, strict=True) for f in cross_modal(r.model, pack)]
    shared: dict[str, Any] = {"records": [], "retrieval": found, "summary": {}, "classes": {}}
    return {"data": pack.spec.name, "pack": pack.digest, "group_by": pack.spec.group_by, **shared}


def _page(study: Study) -> str:
    title = f"{', '.join(study.sources)} on {study.pack.spec.name}"
    sections = {
        "scores": ("Scores of the frozen features", score_sections.probe),
        "retrieval": ("Finding the other modality", evidence.retrieval),
        "loss": ("Loss", evidence.loss),
        "collapse": ("Learning or collapsing?", evidence.collapse),
        "confusion": ("Confusion", evidence.confusions),
        "values": ("Predicted and true values", score_sections.values),
        "mistakes": ("Mistakes and neighbours", galleries.mistakes),
    }
    drawn = []
    with work("drawing the report", len(sections), "sections") as advance:
        for name, (heading, draw) in sections.items():
            drawn.append((name, heading, draw(study)))
            advance()
    spec = study.pack.spec
    notes = "".join(f" Note: {note}." for note in spec.notes)
    foot = (
        f"Data: {spec.name}, from {spec.source}; licence {spec.licence}.{notes}"
        f" 95 % intervals: {covered(spec.group_by, study.result['records'])}."
        f" {WRITTEN} {__version__}; this page makes no network request."
    )
    return str(page.page(title, _head(study, title), [section for section in drawn if section[2]], foot))


def _head(study: Study, title: str) -> Markup:
    runs, modalities = study.runs, study.pack.spec.modalities
    seeds = sorted({r.run.seed for r in runs})
    chips = {
        "method": ", ".join(dict.fromkeys(r.run.method.name for r in runs)),
        "data": study.pack.spec.name,
        "recipe": ", ".join(dict.fromkeys(r.run.recipe for r in runs)),
        "seeds" if len(seeds) > 1 else "seed": ", ".join(map(str, seeds)),
        "trunk": ", ".join(dict.fromkeys(r.run.encoder.named(modalities) for r in runs)),
        "input": ", ".join(dict.fromkeys(f"{r.run.augment.whole_of(m)} px" for r in runs for m in modalities)),
    }
    summary, text = study.result["summary"], "Nothing is scored on this data."
    if summary:
        task, first = next(iter(summary.items()))
        text = f"On {task}, {'. '.join(said)}." if (said := verdicts(first)) else ""
    return page.head(title, "Pre-training report", chips, text, [_tile(study, task) for task in summary])


def _tile(study: Study, task: str) -> Markup:
    modality, own, controls = headline(study.result["summary"][task], study.sources[0], study.sources)
    found = above(own, controls)
    verdict = f"interval {found}" if controls else ""
    number, _, ends = with_interval(own["mean"], own["low"], own["high"], own.get("leak", "")).partition(" ")
    by = f", {study.sources[0]}" if len(study.sources) > 1 else ""
    about = ", ".join(["R2"] * (score_name(study.result["summary"][task]) == "R2") + [WORDS[modality] + by])
    if "balanced" in own:
        ends += f"; balanced {percent(own['balanced'])}"
    return page.tile(task, about, number, ends, verdict, "yes" if found.startswith("above") else "no")
