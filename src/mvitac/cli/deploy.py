"""``mvitac publish`` and ``export``: what leaves the desk."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.cli.options import parse


def publish(argv: list[str]) -> None:
    """mvitac publish RUN OUT [--on PACK] [--push OWNER/NAME]"""
    from rich.console import Console
    from rich.table import Table
    from tyro.conf import Positional

    from mvitac.data.pack import Pack
    from mvitac.deploy.artifact import read
    from mvitac.deploy.publish import publish, push
    from mvitac.system.progress import shown

    @dataclass(frozen=True)
    class Options:
        """One folder with encoders, preprocessing, trained probes, provenance and a model card, for mvitac.load."""

        run: Positional[Path]
        """A finished run's folder."""
        out: Positional[Path]
        """The new folder."""
        on: Path | None = None
        """Fit the probes on this pack instead of the data the run was trained on."""
        push: str | None = None
        """Also upload it to the Hugging Face Hub under this name (owner/name); needs `hf auth login`."""
        private: bool = False
        """Make the uploaded repository private."""

    options = parse(Options, argv, "publish")
    with shown(Console(stderr=True)):
        out = publish(options.run, options.out, Pack(options.on) if options.on else None)
    console = Console(markup=False)
    table = Table(title=f"{out}: what its probes know", title_justify="left")
    for column in ("task", "from", "accuracy %", "majority %"):
        table.add_column(column)
    for readout in read(out).readouts.values():
        q = readout.question
        table.add_row(q.task, q.modality, f"{100 * q.accuracy:.1f}", f"{100 * q.majority:.1f}")
    console.print(table)
    if options.push:
        console.print(f"pushed: {push(out, options.push, private=options.private)}", soft_wrap=True, highlight=False)


def export(argv: list[str]) -> None:
    """mvitac export RUN|ARTIFACT --out DIR [--format torch|onnx|openvino] [--int8]"""
    from typing import Annotated, Literal

    import tyro
    from rich.console import Console
    from rich.table import Table

    from mvitac.data.pack import Pack
    from mvitac.deploy import export as exports
    from mvitac.deploy.artifact import load
    from mvitac.deploy.publish import own_data, with_readouts
    from mvitac.system.progress import shown

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Write a model for another engine: uint8 in, embeddings and class probabilities out. Checked against the model on
        real inputs; nothing is written if it differs."""

        model: tyro.conf.Positional[str]
        """A run's or an artifact's folder, or owner/name on the Hub."""
        out: Path
        """The new folder."""
        format: Annotated[Literal["torch", "onnx", "openvino"], tyro.conf.arg(name="format")] = "onnx"
        """torch (torch.export), onnx (ONNX Runtime) or openvino."""
        precision: Literal["fp32", "bf16"] = "fp32"
        """Arithmetic of openvino; bf16 only on a CPU that computes it, where it can be checked."""
        int8: bool = False
        """8-bit weights and activations, ranges from train rows of the pack (onnx, openvino)."""
        target: Literal["auto", "avx2", "vnni"] = "auto"
        """CPU that --int8 is for. avx2: any CPU (7-bit weights). vnni: x86 with VNNI or AMX, or ARM (8-bit weights). auto:
        this machine's, as measured."""
        on: Path | None = None
        """Pack whose test rows check the export, and to which the probes of a run are fitted; an artifact keeps its own
        (default: the data the model was trained on)."""
        calibrate: Path | None = None
        """Pack whose train rows set the ranges of int8 (default: the same)."""
        modality: Literal["both", "vision", "touch"] = "both"
        """Inputs of the export; both = all the model has."""
        min_cosine: float | None = None
        """Least cosine allowed (default: .9999 for fp32, .99 for bf16, .95 for int8)."""
        accuracy_loss: float = 0.5
        """Points of accuracy that a task may lose."""
        rows: int = 512
        """Most test rows to check on."""
        threads: int = 0
        """CPU threads while measuring latency; 0 = all cores."""

    options = parse(Options, argv, "export")
    model = load(options.model)
    pack = Pack(options.on) if options.on else own_data(model, "check the export on another pack, --on PACK")
    usual = exports.TOLERANCES["int8" if options.int8 else options.precision]
    with shown(Console(stderr=True)):
        report = exports.export(
            with_readouts(model, pack),
            pack,
            options.out,
            kind=options.format,
            precision=options.precision,
            int8=options.int8,
            target=options.target,
            calibrate=Pack(options.calibrate) if options.calibrate else None,
            modalities=None if options.modality == "both" else (options.modality,),
            tolerance=exports.Tolerance(
                min_cosine=usual.min_cosine if options.min_cosine is None else options.min_cosine,
                accuracy_loss=options.accuracy_loss,
            ),
            num_rows=options.rows,
            threads=options.threads,
        )
    table = Table(title=f"{options.out}: checked on {report['num_rows']} test rows", title_justify="left")
    for column in ("", "original", "export"):
        table.add_column(column)
    for task, values in report["accuracy"].items():
        table.add_row(f"{task}, accuracy %", f"{values['original']:.1f}", f"{values['export']:.1f}")
    for name, values in report["cosine"].items():
        table.add_row(f"{name}, least cosine", "", f"{values['min']:.5f}")
    if options.int8:
        bits = {"avx2": "any CPU, 7-bit weights", "vnni": "with VNNI, 8-bit weights"}[report["target"]]
        table.add_row("CPUs it is for", "", f"{report['target']}: {bits}")
    table.add_row("size, MB", "", f"{report['size_mb']}")
    table.add_row("latency of one pair, ms: p50 / p99", "", "{p50} / {p99}".format(**report["latency_ms"]))
    Console(markup=False).print(table)
