"""``mvitac explore``: a local page that shows what a run has learned."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from mvitac.cli.options import check_models, loading, parse
from mvitac.data.pack import Pack
from mvitac.system.progress import shown, work


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Open a local page: the map of features, the nearest neighbours of any point, and mistakes."""

    run: Positional[str]
    """Folder of a run or an artifact, or owner/name on the Hub."""
    on: Path | None = None
    """Show this pack instead of the data of the run."""
    rows: int = 20_000
    """Maximum number of rows to show; a sample is drawn of more."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 opens the page to the whole network."""
    port: int | None = None
    """Port (default: a free one from 7860)."""


def explore(argv: list[str]) -> None:
    """mvitac explore RUN [--on PACK] [--port N]"""
    options = parse(_Options, argv, "explore")
    check_models(options.run)
    loading()
    from mvitac.deploy.artifact import load
    from mvitac.deploy.publish import own_data
    from mvitac.evaluation.evaluate import as_trained
    from mvitac.report.explorer_data import ExplorerData

    try:
        from mvitac.report.explorer import page, serve
    except ModuleNotFoundError as error:
        if error.name != "gradio":
            raise
        raise ValueError("the explorer needs gradio: pip install -e '.[explore]' in mvitac's clone") from None
    model = load(options.run)
    pack = as_trained(model, Pack(options.on)) if options.on else own_data(model, "show another pack, --on PACK")
    print(f"{options.run}: features of up to {min(options.rows, pack.num)} pairs, and its probes", flush=True)
    with shown(), work("drawing the page"):
        blocks = page(options.run, ExplorerData(model, pack, limit=options.rows))
    print(f"explorer: http://{options.host}:{options.port or 7860} (or the next free port; Ctrl-C ends it)", flush=True)
    serve(blocks, host=options.host, port=options.port or None)
