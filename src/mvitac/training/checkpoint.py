"""checkpoint.pt, from which a killed run continues: weights, optimiser and step, and whose run they are.

One file, whatever the number of processes: sharded memory comes together in it, and a run may go on with another number.
No generator state: everything random is a function of (seed, step). Never unpickled.
"""

from __future__ import annotations

import io
from pathlib import Path

import torch

from mvitac.methods.base import Method
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.system.files import brief, write_atomic


def save(
    path: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, step: int, world: World | None = None
) -> None:
    """Write ``method`` and ``optimiser`` as they are after ``step`` steps; a reader finds the old file or the new one.

    All processes of ``world`` call it, one writes.
    """
    state = {"method": method.state_dict(), "optimiser": optimiser.state_dict(), "step": step}
    if world and not world.writes:
        return
    buffer = io.BytesIO()  # written in one go: torch.save itself hides a full disk behind its own error
    torch.save({**state, "run": run.digest()}, buffer)
    write_atomic(path, lambda file: file.write(buffer.getbuffer()))


def restore(path: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, num_steps: int) -> int:
    """Load the checkpoint into ``method`` and ``optimiser`` and return its step; ValueError if it does not fit."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises several kinds for a damaged file
        raise ValueError(f"{path} is damaged ({brief(error)}): delete it to start over") from None
    for name, kind in (("method", dict), ("optimiser", dict), ("step", int)):
        if not isinstance(state, dict) or not isinstance(state.get(name), kind):
            raise ValueError(f"{path} is no checkpoint of mvitac ({name} is missing or odd): delete it to start over")
    if state.get("run", run.digest()) != run.digest():
        raise ValueError(f"{path} belongs to another run: put this run's own back, or delete it to start over")
    if not 0 <= state["step"] <= num_steps:
        raise ValueError(f"{path} was made at step {state['step']} of {num_steps}: delete it to start over")
    try:
        method.load_state_dict(state["method"])
        optimiser.load_state_dict(state["optimiser"])
    except Exception as error:  # other names, other shapes, other types
        raise ValueError(f"{path} does not fit this run ({brief(error)}): delete it to start over") from None
    return state["step"]
