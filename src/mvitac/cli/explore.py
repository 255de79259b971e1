"""``mvitac explore``: a local page that shows what a run has learned."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from mvitac.cli.options import check_models, loading, parse
from mvitac.data.pack import Pack
from mvitac.system.progress import shown, work

if TYPE_CHECKING:
    import gradio


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Open a local page: the map of features, the nearest neighbours of any point, and mistakes; two runs side
    by side."""

    runs: Positional[tuple[str, ...]]
    """Folder of a run or an artifact, or owner/name on the Hub; two to compare."""
    on: Path | None = None
    """Show this pack instead of the data of the first run."""
    rows: int = 20_000
    """Maximum number of rows to show; a sample is drawn of more."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 opens the page to the whole network."""
    port: int | None = None
    """Port (default: a free one from 7860)."""


def explore(argv: list[str]) -> None:
    """mvitac explore RUN [RUN2] [--on PACK] [--port N]"""
    options = parse(_Options, argv, "explore")
    if not 1 <= len(options.runs) <= 2:
        raise ValueError(f"{len(options.runs)} runs given: give one, or two to compare")
    check_models(*options.runs)
    loading()
    try:
        from mvitac.report.explorer import serve

        blocks = _page(options)
    except ModuleNotFoundError as error:
        if error.name != "gradio":
            raise
        raise ValueError("the explorer needs gradio: pip install -e '.[explore]' in mvitac's clone") from None
    print(f"explorer: http://{options.host}:{options.port or 7860} (or the next free port; Ctrl-C ends it)", flush=True)
    serve(blocks, host=options.host, port=options.port or None)


def _page(options: _Options) -> "gradio.Blocks":
    """The page, after the features of every run were computed."""
    from mvitac.deploy.artifact import load
    from mvitac.deploy.publish import own_data
    from mvitac.evaluation.evaluate import as_trained
    from mvitac.report.explorer import page
    from mvitac.report.explorer_data import ExplorerData

    models = [load(run) for run in options.runs]
    given = as_trained(models[0], Pack(options.on)) if options.on else None
    pack = given or own_data(models[0], "show another pack, --on PACK")
    runs = {}
    for name, model in zip(_names(options.runs), models, strict=True):
        print(f"{name}: features of up to {min(options.rows, pack.num)} pairs, and its probes", flush=True)
        with shown():
            runs[name] = ExplorerData(model, pack, limit=options.rows)
    with shown(), work("drawing the page"):
        return page(runs)


def _names(runs: tuple[str, ...]) -> list[str]:
    """A name for each run: the last part of its path, or more where these are equal."""
    names = [Path(run).name if runs.count(run) == 1 else f"{run} {i}" for i, run in enumerate(runs)]
    return names if len(set(names)) == len(names) else list(runs)
