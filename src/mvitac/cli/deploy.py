"""``mvitac publish`` and ``export``: a trained model for other people and other engines."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from mvitac.cli.options import check_models, loading, parse
from mvitac.data.pack import Pack
from mvitac.deploy.export_config import ExportConfig
from mvitac.system.locks import check_new
from mvitac.system.progress import shown


@dataclass(frozen=True)
class _PublishOptions:
    """One folder with encoders, preprocessing, trained probes, provenance and a model card, for mvitac.load."""

    run: Positional[Path]
    """Folder of a finished run."""
    out: Positional[Path]
    """The new folder."""
    on: Path | None = None
    """Fit the probes on this pack instead of the data the run was trained on."""
    allow_leak: bool = False
    """Score also rows or groups of --on that the run was trained on; the card says LEAK beside such scores."""


def publish(argv: list[str]) -> None:
    options = parse(_PublishOptions, argv, "publish")
    check_models(options.run)
    loading()
    from mvitac.deploy import publish
    from mvitac.deploy.artifact import ARTIFACT
    from mvitac.report.tables import print_summary

    with shown():
        pack = Pack(options.on) if options.on else None
        out = publish.publish(options.run, options.out, pack, allow_leak=options.allow_leak)
    print_summary(ARTIFACT.read(out)["scores"])
    print(f"written: {out}\nto the Hub: hf upload OWNER/NAME {shlex.quote(str(out))}")


def warn_changed(run: str, pack: Pack) -> None:
    """Say it on stderr if ``pack``, on which probes are fitted, is not the data that ``run`` was trained on."""
    from mvitac.evaluation.evaluate import trained_on

    if trained_on(Path(run)) not in (None, pack.digest):
        print(f"mvitac: warning: {run} was trained on other data than its probes are fitted on", file=sys.stderr)


@dataclass(frozen=True, kw_only=True)
class _ExportOptions(ExportConfig):
    """Write a model as ONNX, for OpenVINO and ONNX Runtime: uint8 in, embeddings, probabilities and values out. The result
    is compared with the model on real inputs; nothing is written if it differs."""

    model: Positional[str]
    """Folder of a run or an artifact, or owner/name on the Hub."""
    out: Path
    """The new folder."""
    on: Path | None = None
    """Pack whose test rows check the export, and on which the probes of a run are fitted; an artifact keeps its own
    (default: the data the model was trained on)."""
    new_sensor: Path | None = None
    """Pack with 64 to 400 unlabelled images of a touch sensor that the model never met, such as a recording of mvitac
    live: the export is for that sensor, and shows its images in the colours of the known ones."""


def export(argv: list[str]) -> None:
    options = parse(_ExportOptions, argv, "export")
    check_models(options.model)
    check_new(options.out, before_lock=True)
    loading()
    from mvitac.deploy.artifact import folder_of, load
    from mvitac.deploy.export import export
    from mvitac.deploy.publish import own_data, with_probes
    from mvitac.evaluation.evaluate import as_trained
    from mvitac.evaluation.leaks import UNKNOWN, Scored, read_sources
    from mvitac.report.tables import text_table

    model = load(options.model)
    how = "check the export on a pack, --on PACK"
    pack = Pack(options.on) if options.on else own_data(model, how, few=1000 * bool(model.probes))
    if not (options.on or model.probes):
        warn_changed(options.model, pack)
    pack = as_trained(model, pack)
    print("writing and checking the export takes up to a minute", flush=True)
    with shown():
        new = Pack(options.new_sensor) if options.new_sensor else None
        report = export(with_probes(model, pack), pack, options.out, options, new=new)
    both = ("original", "export")
    rows = [[f"{t}, accuracy %", *(f"{v[k]:.1f}" for k in both)] for t, v in report["accuracy"].items()]
    for target in (target for targets in report["values"].values() for target in targets):
        if target["num"]:
            cells = (f"{target[key]:.3g}" for key in both)
            rows.append([f"{target['name']}, mean absolute error, {target['unit']}", *cells])
        rows.append([f"{target['name']}, change, {target['unit']}", "", f"{target['change']:.2g}"])
    rows += [[f"{name}, lowest cosine", "", f"{values['min']:.5f}"] for name, values in report["cosine"].items()]
    latency = "{p50} / {p99}".format(**report["latency_ms"])
    rows += [["size, MB", "", f"{report['size_mb']}"], ["latency of one pair, ms: p50 / p99", "", latency]]
    print(text_table(f"{options.out}: checked on {report['num_rows']} rows of {(new or pack).path}", ["", *both], rows))
    if options.on and not new and any(original for _, original, _ in rows):  # scores
        tested, others = pack.rows("test"), pack.rows("train", "val", "unlabelled")
        leak = Scored(pack).leak(read_sources(folder_of(options.model)), tested if len(tested) else others)
        if leak not in ("", UNKNOWN):
            print(f"LEAK: {leak}: this table compares the export with the model, it is no score")
