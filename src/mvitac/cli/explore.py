"""``mvitac explore``: a local page that shows what a run knows."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mvitac.cli.options import parse


def explore(argv: list[str]) -> None:
    """mvitac explore RUN [RUN2] [--on PACK] [--port N]"""
    from rich.console import Console
    from tyro.conf import Positional

    from mvitac.data.pack import Pack
    from mvitac.deploy.artifact import load
    from mvitac.deploy.publish import own_data
    from mvitac.system.progress import shown, work

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Open a local page: the map of features, nearest neighbours of any point or picture, mistakes; two runs side by
        side."""

        runs: Positional[tuple[str, ...]]
        """A run's or an artifact's folder, or owner/name on the Hub; two to compare."""
        on: Path | None = None
        """Show this pack instead of the data of the first run."""
        rows: int = 20_000
        """Most rows to show; of more, a sample."""
        host: str = "127.0.0.1"
        """Address to listen on; 0.0.0.0 lets everybody on the network in."""
        port: int | None = None
        """Port; a free one from 7860 if not given."""

    options = parse(Options, argv, "explore")
    if not 1 <= len(options.runs) <= 2:
        raise ValueError(f"{len(options.runs)} runs given: give one, or two to compare")
    if options.rows < 3:
        raise ValueError(f"--rows {options.rows}: give at least 3")
    say = partial(Console(markup=False).print, soft_wrap=True, highlight=False)
    models = [load(run) for run in options.runs]
    pack = Pack(options.on) if options.on else own_data(models[0], "show another pack, --on PACK")
    try:
        from mvitac.report.explorer import page, serve
        from mvitac.report.explorer_data import ExplorerData

        names = [Path(run).name if options.runs.count(run) == 1 else f"{run} {i}" for i, run in enumerate(options.runs)]
        if len(set(names)) < len(names):
            names = list(options.runs)
        lands = {}
        for name, model in zip(names, models, strict=True):
            say(f"{name}: features of up to {min(options.rows, pack.num)} pairs, and its probes")
            with shown(Console(stderr=True)):
                lands[name] = ExplorerData(model, pack, limit=options.rows)
        with shown(Console(stderr=True)), work("drawing the page"):
            blocks = page(lands)
    except ModuleNotFoundError as error:
        if error.name != "gradio":
            raise
        raise ValueError("the explorer needs gradio: pip install 'mvitac[explore]'") from None
    where = f"http://{options.host}:{options.port or 7860}"
    say(f"explorer: {where} (or the next free port; Ctrl-C ends it)")
    serve(blocks, host=options.host, port=options.port)
