"""Optional places to send the training log: TensorBoard, Weights & Biases, trackio. None by default, all extras."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mvitac.log import Sink
from mvitac.registry import to_json, unknown
from mvitac.run import Run

SINKS = ("tensorboard", "wandb", "trackio")


@contextmanager
def open_sinks(name: str | None, out: Path, run: Run) -> Iterator[tuple[Sink, ...]]:
    """The sink called ``name`` (none if None) for the run in ``out``; ValueError if its library is not installed."""
    if name is None:
        yield ()
        return
    if name not in SINKS:
        raise unknown("sink", name, SINKS)
    try:
        if name == "tensorboard":
            from torch.utils.tensorboard import SummaryWriter

            def start() -> tuple[Sink, Callable[[], object]]:
                writer = SummaryWriter(str(out / "tensorboard"))

                def send(step: int, values: dict[str, float]) -> None:
                    for key, value in values.items():
                        writer.add_scalar(key, value, step)

                return send, writer.close
        else:
            import importlib

            library = importlib.import_module(name)  # wandb and trackio share these three calls

            def start() -> tuple[Sink, Callable[[], object]]:
                library.init(project="mvitac", name=out.name, config=to_json(run))
                return lambda step, values: library.log(values, step=step), library.finish
    except ImportError:
        raise ValueError(f"--sink {name} needs its library: pip install 'mvitac[{name}]'") from None
    # Started by the first values, not before: a run that is refused must leave nothing behind, and --out must be new.
    started: list[tuple[Sink, Callable[[], object]]] = []

    def send(step: int, values: dict[str, float]) -> None:
        if not started:
            started.append(start())
        started[0][0](step, values)

    try:
        yield (send,)
    finally:
        for _, close in started:
            close()
