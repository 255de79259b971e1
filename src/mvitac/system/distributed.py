"""Distributed training with torchrun: gather embeddings, sum gradients.

Without torchrun there is one process and all functions do nothing. Each process embeds its own rows. Embeddings of all
processes are gathered, and each process computes the whole loss, so it has the full gradient of its own embeddings.
Parameter gradients are then summed. The result is the gradient of a single process on the joint batch
(tests/training/test_distributed.py).

On GPUs, BatchNorm has the statistics of all processes (``training/step.py``). On CPUs each process has its own.
"""

import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn


@dataclass(frozen=True)
class World:
    """The processes of a run: this one is ``rank`` of ``size``."""

    rank: int = 0
    size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process writes files and shows progress (rank 0)."""
        return self.rank == 0

    def gather(self, own: Tensor) -> Tensor:
        """Concatenate [B, ...] of all processes in the order of ranks to [size * B, ...]; B must be equal everywhere."""
        if self.size == 1:
            return own
        everyones = [torch.empty_like(own) for _ in range(self.size)]
        dist.all_gather(everyones, own.contiguous())
        return torch.cat(everyones)

    def sum_gradients(self, module: nn.Module) -> None:
        """Sum the gradients over processes, in one message."""
        if self.size == 1:
            return
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        for gradient, summed in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def broadcast(self, tensors: list[Tensor]) -> None:
        """Overwrite ``tensors`` with those of rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def any(self, flag: bool) -> bool:
        """Return whether ``flag`` is true on any process; all processes must call this."""
        if self.size == 1:
            return flag
        value = torch.tensor(float(flag), device=local_device("cuda") if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(value)
        return bool(value > 0)

    def barrier(self) -> None:
        if self.size > 1:
            dist.barrier()


def join() -> World:
    """Return the processes started by torchrun (NCCL with GPUs, else gloo), or a world of one."""
    if "WORLD_SIZE" not in os.environ or int(os.environ["WORLD_SIZE"]) == 1:
        return World()
    if not dist.is_initialized():
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return World(dist.get_rank(), dist.get_world_size())


def local_device(name: str) -> str:
    """Return the device of this process: its own GPU under torchrun if ``name`` is `auto` or `cuda`."""
    if name in ("auto", "cuda") and "LOCAL_RANK" in os.environ and torch.cuda.is_available():
        return f"cuda:{os.environ['LOCAL_RANK']}"
    return name
