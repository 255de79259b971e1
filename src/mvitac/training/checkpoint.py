"""checkpoint.pt, from which an interrupted run continues: weights, optimiser state, step, and the digest of the run.

It is one file for any number of processes. It needs no state of random generators, since all randomness is a function of
(seed, step). The one before is kept as checkpoint.previous.pt until the run is finished, in case this is damaged.
"""

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mvitac.methods.base import Method
from mvitac.nn.weights import load_checked
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.system.files import brief, write_atomic

CHECKPOINT, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"


def save(
    out: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, step: int, validation: dict[str, Any]
) -> None:
    """Write the state after ``step`` steps, with that of validation, to checkpoint.pt in ``out``; keep the one before."""
    state = {"method": method.state_dict(), "optimiser": optimiser.state_dict(), "step": step}
    buffer = io.BytesIO()  # torch.save to a file would hide the error of a full disk
    torch.save({**state, "run": run.digest(), "validation": validation}, buffer)

    def write(file: Any) -> None:
        file.write(buffer.getbuffer())
        file.flush()  # a full disk shows here, before the last checkpoint moves away
        with contextlib.suppress(FileNotFoundError):
            os.replace(out / CHECKPOINT, out / PREVIOUS)

    write_atomic(out / CHECKPOINT, write)


def restore(
    out: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, num_steps: int, world: World | None = None
) -> tuple[int, dict[str, Any]]:
    """Load the checkpoint in the run's folder ``out``, of ``num_steps`` in all, into ``method`` and ``optimiser``.

    If it is damaged, it is deleted and the one before it is used, with a message on stderr. Returns the number of steps
    that are done, 0 without a checkpoint, and what it kept; ValueError if both are damaged, or belong to another run.
    """
    found, damage = [path for path in (out / CHECKPOINT, out / PREVIOUS) if path.exists()], ""
    for path in found:
        try:
            state = load_checked(path)
            if mine := state["run"] == run.digest():
                _load(state, method, optimiser, num_steps)
        except Exception as error:  # zipfile and torch raise several types for damaged files
            damage = damage or f"{path} is damaged ({brief(error)})"
            continue
        if not mine:
            raise ValueError(f"{path} belongs to another run: restore the one of this run, or delete it to start over")
        if damage and (world is None or world.is_main):
            print(f"mvitac: {damage}; continuing from {path}, step {state['step']}", file=sys.stderr)
            (out / CHECKPOINT).unlink()  # else the next checkpoint would push it to the place of the good one
        return state["step"], state["validation"]
    if damage:
        raise ValueError(f"{damage}: delete it{f' and {PREVIOUS}' if len(found) > 1 else ''} to start over")
    return 0, {}


def _load(state: dict[str, Any], method: Method, optimiser: torch.optim.Optimizer, num_steps: int) -> None:
    method.load_state_dict(state["method"])
    optimiser.load_state_dict(state["optimiser"])
    if not all(isinstance(x, Tensor) for kept in optimiser.state.values() for x in kept.values()):
        raise ValueError("a state of the optimiser that is no tensor")
    step, kept = state["step"], state["validation"]
    if type(step) is not int or not 0 <= step <= num_steps or not isinstance(kept, dict):
        raise ValueError(f"step {step!r} of {num_steps}")
