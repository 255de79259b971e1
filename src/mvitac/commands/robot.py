"""``mvitac publish``: what leaves the desk."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.options import parse


def publish(argv: list[str]) -> None:
    """mvitac publish RUN OUT [--on PACK] [--push OWNER/NAME]"""
    from rich.console import Console
    from rich.table import Table
    from tyro.conf import Positional

    from mvitac.artifact import read
    from mvitac.pack import Pack
    from mvitac.publish import publish, push

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
    out = publish(options.run, options.out, Pack(options.on) if options.on else None)
    console = Console()
    table = Table(title=f"{out}: what its probes know", title_justify="left")
    for column in ("task", "from", "accuracy %", "majority %"):
        table.add_column(column)
    for readout in read(out).readouts.values():
        q = readout.question
        table.add_row(q.task, q.modality, f"{100 * q.accuracy:.1f}", f"{100 * q.majority:.1f}")
    console.print(table)
    if options.push:
        console.print(f"pushed: {push(out, options.push, private=options.private)}", soft_wrap=True, highlight=False)
