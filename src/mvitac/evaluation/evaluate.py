"""Evaluate finished runs: probe them and their controls together, in one result for tables and reports."""

import sys
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.data.spec import AnyTask, Task, ValueTask
from mvitac.data.windows import windowed
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation import few_labels
from mvitac.evaluation.controls import CONTROLS, Records, controls_of, frozen_trunks
from mvitac.evaluation.encoders import Bound, open_encoders, probe_encoders
from mvitac.evaluation.features import fitting
from mvitac.evaluation.folds import fold_splits
from mvitac.evaluation.leaks import CHOSE, UNKNOWN, Scored, Source, leaks_of, mark_split_leaks, read_sources
from mvitac.evaluation.probe import names_in, probe_model, probes_of, seen_by, split_rows
from mvitac.evaluation.probe_config import ProbeConfig
from mvitac.evaluation.retrieval import cross_modal, retrieved_rows
from mvitac.evaluation.run_names import names_of
from mvitac.evaluation.scores import per_class, pool, summarise
from mvitac.evaluation.sensors import about_new, describe_statistics
from mvitac.model import Model, Which, load, weights_file
from mvitac.nn.encoders import build_trunk
from mvitac.registry import check_known, from_json, to_json
from mvitac.run import Run, load_run
from mvitac.shipped import BASE, named
from mvitac.system.files import check_place, digest_file, fields_of, read_json, write_json
from mvitac.system.progress import work
from mvitac.system.threads import in_threads

Probed = tuple[Path, Model, str, list[Source] | None]  # a run: folder, model, name, and what it learned from
END_TO_END = ", end to end"
"""Suffix of a source's name for the scores of its own heads, trained along with its encoders."""


def probe(
    *runs: str | Path, on: str | Path | Pack | None = None, allow_leak: bool = False, **options: Any
) -> dict[str, Any]:
    """Probe finished runs beside their controls, as `mvitac probe` does. Public as ``mvitac.probe``.

    Args:
        runs: Folders of runs: seeds of one method, or several methods, trained on one dataset.
        on: Another pack, or its folder, to probe on. Default: the data the runs were trained on.
        allow_leak: Score also test rows of ``on`` that a run was trained on.
        options: Fields of ``ProbeConfig``: probes, tasks, modalities, controls, fractions, folds.

    Returns what ``probe_runs`` returns, and raises what it raises.

    Examples:
        >>> scores = mvitac.probe("runs/demo/seed0", probes=("linear", "knn"))  # doctest: +SKIP
        >>> scores["summary"]["category"]["touch"]["mvitac"]["mean"]  # doctest: +SKIP
    """
    pack = PackConfig(path=Path(on)).open() if isinstance(on, (str, Path)) else on
    return probe_runs([named(Path(run)) for run in runs], ProbeConfig(**options), pack, allow_leak=allow_leak)


def probe_runs(
    paths: Sequence[Path],
    session: ProbeConfig,
    pack: Pack | None = None,
    *,
    allow_leak: bool = False,
    weights: Which = "last",
    encoders: Sequence[str] = (),
) -> dict[str, Any]:
    """Probe finished runs and their controls, and write the result to probe.json in the folder of each run, as ``probe``.

    ``weights`` are those after the last step, or the best on split val, whose result is in probe.best.json; that of folds
    is in probe.folds.json. ``encoders`` are other people's to probe beside the runs ("external:..."); they need ``pack``.

    Returns a dict with "data", "pack", "group_by", "notes", "leaks", "classes", "records", "retrieval", "summary",
    "per_class", "asked" (the config), "models" (digests of the weights) and "encoders" (``ExternalModel.describe``). A
    record has a "leak", which is empty unless its test rows, or their groups, were trained on. ValueError if a path is no
    run, a run is given twice, the runs and the data do not fit together, or a run was trained on rows or groups that other
    data than its own would score.
    """
    _check_paths(paths, encoders)
    others = open_encoders(encoders, pack)
    models = [load(path, weights) for path in paths]
    names = [name + ", best" * (weights == "best") for name in names_of(paths, models)]
    pack = _common_pack(paths, models, pack)
    tasks, modalities = chosen(pack, session)
    _check_rows(names, models, others, pack, modalities)
    if session.standardise and (others or {*modalities} <= {"vision"}):
        raise ValueError("--standardise changes the touch features of runs, not of vision or an --encoder")
    for model in models:
        fitting(model, pack)
    # The initial weights that an artifact names may be any file or download.
    runs = [m.run.fresh() if m.foreign else m.run for m in models]
    _check_before(runs, pack, tasks, modalities, session)
    sources = check_unseen(paths, pack, tasks, weights, allow_leak=allow_leak or bool(session.folds))
    score = partial(_score, [*zip(paths, models, names, sources, strict=True)], runs, modalities, session)
    if session.folds:
        (records, tested), retrieval = _in_folds(score, pack, others, tasks, session, sources), []
    else:
        records, retrieval = score(pack, others, tasks)
        tested = _tested([(task, [pack]) for task in tasks], session.fractions)
    leaks = [*leaks_of(every := [*records, *retrieval]), *([] if session.folds else mark_split_leaks(pack, every))]
    classes = {task.name: list(task.classes) for task in tasks if isinstance(task, Task)}
    result = {
        **{"data": pack.spec.name, "pack": pack.digest, "group_by": pack.spec.group_by},
        **{"notes": [*pack.spec.notes, *tested], "classes": classes},
        "targets": {task.name: to_json(task.targets) for task in tasks if isinstance(task, ValueTask)},
        **{"asked": to_json(session), "models": _digests(paths, weights)},
        **{"encoders": [m.describe() for m, _ in others], "leaks": leaks},
        **{"records": records, "retrieval": retrieval, "summary": summarise(records, session.probes[0])},
        "per_class": per_class(records, classes, session.probes[0]),
    }
    new = dict.fromkeys(about_new(model, pack, session.standardise) for model in models)
    if said := [*filter(None, new), *describe_statistics(pack, session.standardise)]:
        result["statistics"] = said
    for path in (path for path in paths if path != BASE):  # nothing is written into the package
        name = "probe" + ".best" * (weights == "best") + ".folds" * bool(session.folds)
        write_json(path / f"{name}.json", result, sealed=True)
    return result


def _check_rows(names: list[str], models: list[Model], others: Any, pack: Pack, modalities: Sequence[str]) -> None:
    for name, model in [*zip(names, models, strict=True), *((model.title, model) for model, _ in others)]:
        if not any({*names_in(m, pack)} <= {*model.encoders} for m in modalities):
            raise ValueError(f"{name} does not read {' or '.join(modalities)}: choose other --modalities")
    runs, encoders, controls = {*names}, {model.title for model, _ in others}, {*CONTROLS, *pack.spec.controls}
    if alike := encoders & runs | (encoders | runs) & controls:
        raise ValueError(f"two rows would be called {min(alike)!r}: give a title=NAME, or rename the data's control")


def _check_paths(paths: Sequence[Path], encoders: Sequence[str]) -> None:
    if not (paths or encoders):
        raise ValueError("give at least one run's folder")
    for path in paths:
        if [p.resolve() for p in paths].count(path.resolve()) > 1:
            raise ValueError(f"run {path} is given twice: it would count as two seeds, give it once")
        if path != BASE:
            check_place(path / "probe.json")


def _check_before(
    runs: Sequence[Run], pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str], session: ProbeConfig
) -> None:
    """ValueError, before any probe is fitted, if a task has no rows to fit and to score, or weights are missing."""
    for task in () if session.folds else tasks:
        for modality in seen_by(pack, task, modalities):
            split_rows(pack, task, modality)
    for _, run in frozen_trunks(runs) if session.controls else ():
        for config in {run.encoder.vision, run.encoder.touch}:
            build_trunk(config, 3)


def _score(
    each: Sequence[Probed],
    runs: Sequence[Run],
    modalities: Sequence[str],
    session: ProbeConfig,
    pack: Pack,
    others: Sequence[Bound],
    tasks: Sequence[AnyTask],
) -> tuple[Records, Records]:
    records, retrieval = _probe_models(each, pack, tasks, modalities, session)
    records += probe_encoders(others, tasks, modalities, session.kinds, controls=session.controls)
    if not session.controls:
        return records, retrieval
    specs = [model.spec for _, model, _, _ in each]
    found, ranked = controls_of(runs, pack, tasks, modalities, session.kinds, specs, session.standardise)
    return records + found, retrieval + ranked


def _in_folds(
    score: Callable[[Pack, Sequence[Bound], Sequence[AnyTask]], tuple[Records, Records]],
    pack: Pack,
    others: Sequence[Bound],
    tasks: Sequence[AnyTask],
    session: ProbeConfig,
    sources: Sequence[list[Source] | None],
) -> tuple[Records, list[str]]:
    """Probe records of all folds, pooled, and notes on them. There is no retrieval: too few groups to search in."""
    learned, num = [source for several in sources for source in several or ()], session.folds
    splits = [(task, [{task.split: s.tolist()} for s in fold_splits(pack, task, num, learned)]) for task in tasks]
    folds: list[Records] = []
    for k in range(num):
        folds.append([])
        for task, cells in splits:
            own = [(model, data.with_splits(cells[k])) for model, data in others]
            try:
                folds[k] += score(pack.with_splits(cells[k]), own, [task])[0]
            except ValueError as error:
                raise ValueError(f"fold {k + 1} of {num}: {error}; give other --folds") from None
    tested = f"{num} folds: every {pack.spec.group_by} that no run learned from is tested once"
    return pool(folds), [tested, *_tested(((t, map(pack.with_splits, c)) for t, c in splits), session.fractions)]


def as_trained(model: Model, pack: Pack) -> Pack:
    """``pack`` with the windows that ``model`` was trained on, if it shows single frames and is not joined."""
    return pack if pack.spec.window.active or isinstance(pack, JoinedPack) else windowed(pack, model.spec.window)


def _common_pack(paths: Sequence[Path], models: Sequence[Model], pack: Pack | None) -> Pack:
    if len({model.spec.window for model in models}) > 1:
        raise ValueError("these runs see different windows of frames: probe them one by one, or `mvitac compare` them")
    if pack:
        return as_trained(models[0], pack) if models else pack
    packs = [model.open_data() for model in models]
    if len({p.digest for p in packs}) > 1:
        raise ValueError("these runs were trained on different data: probe them one by one, or on one pack with --on")
    return noted(packs[0], paths)


def noted(pack: Pack, paths: Sequence[Path]) -> Pack:
    """The data that the runs at ``paths`` name; with a note if it is not what they were trained on."""
    if {trained_on(path) for path in paths} - {None, pack.digest}:
        pack = copy(pack)
        pack.spec = replace(pack.spec, notes=(*pack.spec.notes, "the data of these runs changed since training"))
    return pack


def _tested(views: Iterable[tuple[AnyTask, Iterable[Pack]]], fractions: Sequence[float]) -> list[str]:
    """Lines on test rows of classes that no probe learns, for which all answers are wrong, and on raised ``fractions``."""
    lines = []
    for task, folds in views:
        each = [(split_rows(fold, task), fold) for fold in folds]
        lines += few_labels.raised(each[0][1], task, each[0][0].train, each[0][0].val, fractions)
        if not isinstance(task, Task):
            continue
        known = [(rows, fold.labels(task.name)) for rows, fold in each]
        new = np.concatenate([y[rows.test][~np.isin(y[rows.test], y[rows.fitted])] for rows, y in known])
        named, tested = ", ".join(task.classes[label] for label in np.unique(new)), sum(len(r.test) for r, _ in each)
        if named:
            lines.append(f"{task.name}: {len(new)} of {tested} test rows have classes that train lacks: {named}")
    return lines


def trained_on(path: Path) -> str | None:
    """The digest of the pack that the run at ``path`` was trained on, if it is known."""
    return load_run(path)[1].get("pack") if (path / "run.json").exists() else None


def _probe_models(
    each: Sequence[Probed], pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str], session: ProbeConfig
) -> tuple[Records, Records]:
    """Probe and retrieval records of runs, given as folder, model, name and what it learned from."""
    if not each:
        return [], []
    rows = Scored(pack)

    def probed(one: Probed) -> tuple[Records, Records]:
        path, model, source, learned = one
        own = {"source": source, "seed": model.run.seed, "run": str(path)}
        found = probe_model(model, pack, tasks, modalities, session.kinds, session.standardise)
        leaks = {task.name: rows.leak(learned, split_rows(pack, task).test) for task in tasks}
        records = [{**own, **record, "leak": leaks[record["task"]]} for record in found]
        for record in records:
            record["source"] += END_TO_END if record["probe"] == "own" else ""
        ranked = cross_modal(model, pack)
        return records, [{**own, **r, "leak": rows.leak(learned, retrieved_rows(pack, "test"))} for r in ranked]

    num = len(each) * len(modalities) * sum(len(probes_of(task, session.kinds)) for task in tasks)
    with work("fitting probes", num, "probes"):
        scored = in_threads(probed, list(each))
    return [r for own, _ in scored for r in own], [r for _, found in scored for r in found]


def stored_result(paths: Sequence[Path], pack: Pack) -> dict[str, Any] | None:
    """The result in the probe.json of the first run, if it has linear probes of exactly these runs on ``pack``.

    None if that file is missing or damaged, is about other runs, weights or data, or lacks tasks, modalities or controls.
    """
    path = paths[0] / "probe.json"
    if not path.exists():
        return None
    try:
        with fields_of(path):
            result = read_json(path, "a probe result")
            asked: ProbeConfig = from_json(ProbeConfig, result["asked"], "asked")
            scored = {Path(r["run"]).resolve() for r in result["records"] if "run" in r}
            # Of one pack, the notes tell scores on val from those on test.
            notes = [*pack.spec.notes, *_tested([(task, [pack]) for task in pack.spec.all_tasks], asked.fractions)]
            same = (result["pack"], result["notes"], result["models"]) == (pack.digest, notes, _digests(paths))
    except ValueError as error:
        print(f"mvitac: {error}; the runs are probed again", file=sys.stderr)
        return None
    whole = asked.probes[0] == "linear" and asked.controls and not asked.tasks and not asked.modalities
    whole &= not asked.standardise
    return result if same and whole and scored == {path.resolve() for path in paths} else None


def _digests(paths: Sequence[Path], weights: Which = "last") -> list[str]:
    return sorted(digest_file(weights_file(path, weights)) for path in paths)


def check_unseen(
    paths: Sequence[Path], pack: Pack, tasks: Sequence[AnyTask], weights: Which = "last", *, allow_leak: bool
) -> list[list[Source] | None]:
    """What each run at ``paths`` learned from; None where that is not known.

    ValueError if a run, or a model whose weights it started from, saw what would be scored. What a run itself saw of its
    own data follows from the split that was chosen, so there the scores only say LEAK.
    """
    scored, sources = Scored(pack), []
    for path in paths:
        sources.append(learned := read_sources(path, weights))
        own = 1 + any(source.name.endswith(CHOSE) for source in (learned or [])[1:2])  # the run's own rows
        refused = [] if allow_leak else (learned or [])[own if trained_on(path) == pack.digest else 0 :]
        for task in tasks if refused else ():
            if (leak := scored.leak(refused, split_rows(pack, task).test)) not in ("", UNKNOWN):
                seen = f"{path} has seen what {pack.path} would score, task {task.name!r}: {leak}"
                raise ValueError(f"{seen}; give a pack of other test groups, or --allow-leak, if the command has it")
    return sources


def chosen(pack: Pack, session: ProbeConfig) -> tuple[list[AnyTask], list[str]]:
    """The tasks and modalities that ``session`` asks for; ValueError if the data lacks one."""
    if not (known := {task.name: task for task in pack.spec.all_tasks}):
        raise ValueError(f"dataset {pack.spec.name!r} has no labels and no values: pack it with --labels or --values")
    check_known("task", session.tasks, known)
    have = [*pack.spec.modalities, *["both"] * (len(pack.spec.modalities) == 2)]
    check_known("modality", session.modalities, have)
    tasks = [known[name] for name in session.tasks or known]
    if not any(probes_of(task, session.kinds) for task in tasks):
        raise ValueError(f"probe {', '.join(session.kinds)} is for classes, these are values: give linear or knn")
    return tasks, list(session.modalities or have)
