"""checkpoint.pt, from which an interrupted run continues: weights, optimiser state, step, and the digest of the run.

It is one file for any number of processes. Sharded memory banks are gathered in it, so a run can continue with another
number of processes. It needs no state of random generators, since all randomness is a function of (seed, step). Loading it
executes no code (``weights_only``).

torch.save writes a zip archive. Its comment, at the end of the file, holds the sha256 of everything before it. The last
checkpoint before is kept as checkpoint.previous.pt until the run is finished, and used if this one is damaged.
"""

import contextlib
import hashlib
import io
import os
import sys
from pathlib import Path
from typing import Any

import torch

from mvitac.methods.base import Method
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.system.files import brief, write_atomic

CHECKPOINT, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"
_MARK = b"mvitac sha256 "
_SEAL = len(_MARK) + 64  # bytes of the comment
_END = b"PK\5\6"  # first bytes of the last record of a zip archive, which has 22 bytes without its comment


class Damaged(ValueError):
    """The file is not what was written."""


def save(
    out: Path,
    run: Run,
    method: Method,
    optimiser: torch.optim.Optimizer,
    step: int,
    world: World | None = None,
    *,
    kept: dict[str, Any] | None = None,
) -> None:
    """Write the state after ``step`` steps to checkpoint.pt in the run's folder ``out``, and keep the one before it.

    All processes of ``world`` must call it; one of them writes. ``kept`` is the state of validation (tensors and numbers).
    """
    state = {"method": method.state_dict(), "optimiser": optimiser.state_dict(), "step": step}
    if world and not world.writes:
        return
    buffer = io.BytesIO()  # torch.save to a file would hide the error of a full disk
    torch.save({**state, "run": run.digest(), "kept": kept or {}}, buffer)
    seal(buffer)

    def write(file: Any) -> None:
        file.write(buffer.getbuffer())
        file.flush()  # a full disk shows here, before the last checkpoint moves away
        with contextlib.suppress(FileNotFoundError):
            os.replace(out / CHECKPOINT, out / PREVIOUS)

    write_atomic(out / CHECKPOINT, write)


def seal(buffer: io.BytesIO) -> None:
    """Append the digest of a zip archive to it, as its comment."""
    buffer.seek(-2, os.SEEK_END)
    buffer.write(_SEAL.to_bytes(2, "little"))
    buffer.write(_MARK + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())


def restore(
    out: Path,
    run: Run,
    method: Method,
    optimiser: torch.optim.Optimizer,
    num_steps: int,
    world: World | None = None,
    *,
    kept: dict[str, Any] | None = None,
) -> int:
    """Load the checkpoint in the run's folder ``out`` into ``method`` and ``optimiser``, and what it kept into ``kept``.

    If it is damaged, it is deleted and the one before it is used, with a message on stderr. Returns the number of steps
    that are done, 0 without a checkpoint; ValueError if both are damaged, or belong to another run.
    """
    found = [path for path in (out / CHECKPOINT, out / PREVIOUS) if path.exists()]
    damage: Damaged | None = None
    for path in found:
        try:
            step = _restore(path, run, method, optimiser, num_steps, {} if kept is None else kept)
        except Damaged as error:
            damage = damage or error
            continue
        if damage and (world is None or world.writes):
            print(f"mvitac: {damage}; continuing from {path}, step {step}", file=sys.stderr)
            (out / CHECKPOINT).unlink()  # else the next checkpoint would push it to the place of the good one
        return step
    if damage:
        both = f" and {PREVIOUS}" if len(found) > 1 else ""
        raise ValueError(f"{damage}: delete it{both} to start over")
    return 0


def _restore(
    path: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, num_steps: int, kept: dict[str, Any]
) -> int:
    try:
        _check_seal(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Damaged:
        raise
    except Exception as error:  # torch raises several types for damaged files
        raise Damaged(f"{path} is damaged ({brief(error)})") from None
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
    kept.update(state.get("kept", {}))  # older checkpoints have none
    return state["step"]


def _check_seal(path: Path) -> None:
    """Raise Damaged if the file does not match its digest. Version 0.1.0 wrote none: its archives have no comment."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _SEAL - 22))
        tail = file.read()
        if tail[-22:-18] == _END and tail[-2:] == b"\0\0":
            return
        file.seek(0)
        total, left = hashlib.sha256(), max(0, size - _SEAL)
        while piece := file.read(min(left, 1 << 20)):
            total.update(piece)
            left -= len(piece)
    if tail[-_SEAL:] != _MARK + total.hexdigest().encode():
        raise Damaged(f"{path} does not match its digest")
