"""checkpoint.pt, from which an interrupted run continues: weights, optimiser state, step, and the digest of the run.

It is one file for any number of processes. Sharded memory banks are gathered in it, so a run can continue with another
number of processes. It needs no state of random generators, since all randomness is a function of (seed, step). Loading it
executes no code (``weights_only``).
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
    """Write the state after ``step`` steps. The file is replaced atomically.

    All processes of ``world`` must call it; one of them writes.
    """
    state = {"method": method.state_dict(), "optimiser": optimiser.state_dict(), "step": step}
    if world and not world.writes:
        return
    buffer = io.BytesIO()  # torch.save to a file would hide the error of a full disk
    torch.save({**state, "run": run.digest()}, buffer)
    write_atomic(path, lambda file: file.write(buffer.getbuffer()))


def restore(path: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, num_steps: int) -> int:
    """Load a checkpoint into ``method`` and ``optimiser``.

    Returns:
        The number of steps that are done.

    Raises:
        ValueError: If the file is damaged or belongs to another run.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises several types for damaged files
        raise ValueError(f"{path} is damaged ({brief(error)}): delete it to start over") from None
    for name, kind in (("method", dict), ("optimiser", dict), ("step", int)):
        if not isinstance(state, dict) or not isinstance(state.get(name), kind):
            raise ValueError(
                f"{path} is no checkpoint of mvitac ({name} is missing or invalid): delete it to start over"
            )
    if state.get("run", run.digest()) != run.digest():
        raise ValueError(
            f"{path} belongs to another run: restore the checkpoint of this run, or delete it to start over"
        )
    if not 0 <= state["step"] <= num_steps:
        raise ValueError(f"{path} was made at step {state['step']} of {num_steps}: delete it to start over")
    try:
        method.load_state_dict(state["method"])
        optimiser.load_state_dict(state["optimiser"])
    except Exception as error:  # other names, other shapes, other types
        raise ValueError(f"{path} does not fit this run ({brief(error)}): delete it to start over") from None
    return state["step"]
