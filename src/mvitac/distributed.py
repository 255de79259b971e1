"""Many processes, one batch: rank, gather, the sum of gradients, synchronised BatchNorm. Started by torchrun.

Without torchrun there is a world of one and everything here does nothing. Process r embeds its own rows; the embeddings
of all are gathered, each process takes the whole loss and so holds the full gradient of its own embeddings; parameter
gradients are then summed. That is the gradient of one process on the joint batch (tests/test_distributed.py).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn


@dataclass(frozen=True)
class World:
    """Who takes part: this process is ``rank`` of ``size``."""

    rank: int = 0
    size: int = 1

    @property
    def writes(self) -> bool:
        """Only one process writes files and progress."""
        return self.rank == 0

    def gather(self, own: Tensor) -> Tensor:
        """[B, ...] of every process, in the order of ranks: [size * B, ...]; B must be the same everywhere."""
        if self.size == 1:
            return own
        everyones = [torch.empty_like(own) for _ in range(self.size)]
        dist.all_gather(everyones, own.contiguous())
        return torch.cat(everyones)

    def own(self, everyones: Tensor, num: int) -> Tensor:
        """This process's ``num`` rows of what ``gather`` made."""
        return everyones[self.rank * num : (self.rank + 1) * num]

    def sum_gradients(self, module: nn.Module) -> None:
        """Add up the gradients of all processes, in one message."""
        if self.size == 1:
            return
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        for gradient, summed in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def same_everywhere(self, tensors: list[Tensor]) -> None:
        """Overwrite ``tensors`` with those of rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def anyone(self, flag: bool) -> bool:
        """Whether ``flag`` is set on any process; all must ask together."""
        if self.size == 1:
            return flag
        value = torch.tensor(float(flag), device="cuda" if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(value)
        return bool(value > 0)

    def wait(self) -> None:
        """Until every process has come here."""
        if self.size > 1:
            dist.barrier()


def join() -> World:
    """The world torchrun started this process in (NCCL with GPUs, else gloo), or a world of one without it."""
    if "WORLD_SIZE" not in os.environ or int(os.environ["WORLD_SIZE"]) == 1:
        return World()
    if not dist.is_initialized():
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return World(dist.get_rank(), dist.get_world_size())


def local_device(name: str) -> str:
    """The device of this process: under torchrun with GPUs its own one, whatever `auto` or `cuda` says."""
    if name in ("auto", "cuda") and "LOCAL_RANK" in os.environ and torch.cuda.is_available():
        return f"cuda:{os.environ['LOCAL_RANK']}"
    return name


def synchronise_norms(module: nn.Module, world: World) -> nn.Module:
    """Let every BatchNorm take its statistics over all processes: torch's on GPUs, `SyncedBatchNorm` elsewhere."""
    if world.size == 1:
        return module
    if next(module.parameters()).is_cuda:
        return nn.SyncBatchNorm.convert_sync_batchnorm(module)
    for layer in module.modules():
        if type(layer) in (nn.BatchNorm1d, nn.BatchNorm2d):
            layer.__class__ = SyncedBatchNorm  # the same state, another forward
    return module


class SyncedBatchNorm(nn.BatchNorm2d):
    """BatchNorm over the batches of all processes, for backends that torch's SyncBatchNorm does not serve (gloo).

    Takes [B, C] and [B, C, H, W]; every process must have the same B. Statistics in fp32, differentiable through the
    all-reduce.
    """

    def _check_input_dim(self, input: Tensor) -> None:
        if input.ndim not in (2, 4):
            raise ValueError(f"expected [B, C] or [B, C, H, W], got {tuple(input.shape)}")

    def forward(self, input: Tensor) -> Tensor:
        self._check_input_dim(input)
        if not self.training:
            return super().forward(input)
        assert self.running_mean is not None and self.running_var is not None and self.momentum is not None
        x = input.float()
        axes = [0] if x.ndim == 2 else [0, 2, 3]
        size = dist.get_world_size()
        mean = _sum_over_processes(x.mean(axes)) / size
        centred = x - mean.view(1, -1, *[1] * (x.ndim - 2))  # two passes: no cancellation
        variance = _sum_over_processes(centred.square().mean(axes)) / size
        num = size * x.numel() // x.shape[1]
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * num / max(1, num - 1), self.momentum)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked.add_(1)
        shape = (1, -1, *[1] * (x.ndim - 2))
        scale = (self.weight if self.affine else 1) * (variance + self.eps).rsqrt()
        out = centred * scale.view(shape)
        return (out + self.bias.view(shape) if self.affine else out).to(input.dtype)


class _Sum(torch.autograd.Function):
    """All-reduce by sum, whose gradient is all-reduced too."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        total = value.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        total = gradients[0].clone()
        dist.all_reduce(total)
        return total


def _sum_over_processes(value: Tensor) -> Tensor:
    return _Sum.apply(value)  # type: ignore[return-value]
