"""Distributed training with torchrun: gather embeddings, sum gradients, synchronise BatchNorm.

Without torchrun there is one process and all functions do nothing. Each process embeds its own rows. Embeddings of all
processes are gathered, and each process computes the whole loss, so it has the full gradient of its own embeddings.
Parameter gradients are then summed. The result is the gradient of a single process on the joint batch
(tests/training/test_distributed.py).

If a memory bank is sharded, process r has rows r, r + size, ... (`shard`). Inputs that are equal on all processes go through
`spread`, and partial results of the shards through `sum`, so that values and gradients are complete on every process (the
operators f and g of Shoeybi et al., arXiv:1909.08053).
"""

import os
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn


@dataclass(frozen=True)
class World:
    """The processes of a run: this one is ``rank`` of ``size``."""

    rank: int = 0
    size: int = 1

    @property
    def writes(self) -> bool:
        """Whether this process writes files and shows progress (rank 0)."""
        return self.rank == 0

    def gather(self, own: Tensor) -> Tensor:
        """Concatenate [B, ...] of all processes in the order of ranks to [size * B, ...]; B must be equal everywhere."""
        if self.size == 1:
            return own
        everyones = [torch.empty_like(own) for _ in range(self.size)]
        dist.all_gather(everyones, own.contiguous())
        return torch.cat(everyones)

    def own(self, everyones: Tensor, num: int) -> Tensor:
        """Return this process's ``num`` rows of a gathered tensor."""
        return everyones[self.rank * num : (self.rank + 1) * num]

    def sum(self, part: Tensor) -> Tensor:
        """Return the sum of ``part`` over processes. The gradient of each part is that of the sum."""
        return part if self.size == 1 else _Sum.apply(part, True, False)  # type: ignore[return-value]

    def spread(self, value: Tensor) -> Tensor:
        """Return ``value``, which is equal on all processes. Its gradients are summed over processes."""
        return value if self.size == 1 else _Sum.apply(value, False, True)  # type: ignore[return-value]

    def shard(self, whole: Tensor) -> Tensor:
        """Return this process's rows of ``whole`` [N, ...]: rank, rank + size, ..."""
        return whole[self.rank :: self.size]

    def unshard(self, own: Tensor, num: int) -> Tensor | None:
        """Collect all ``num`` rows from the shards (``own``) in main memory of rank 0; return None on other ranks."""
        if self.size == 1:
            return own
        if self.rank:
            dist.send(own.contiguous(), 0)
            return None
        whole = torch.empty(num, *own.shape[1:], dtype=own.dtype)
        self.shard(whole).copy_(own)
        for rank in range(1, self.size):
            theirs = World(rank, self.size).shard(whole)
            received = torch.empty_like(theirs, device=own.device, memory_format=torch.contiguous_format)
            dist.recv(received, rank)
            theirs.copy_(received)
        return whole

    def sum_gradients(self, module: nn.Module) -> None:
        """Sum the gradients over processes, in one message."""
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
        """Return whether ``flag`` is true on any process; all processes must call this."""
        if self.size == 1:
            return flag
        value = torch.tensor(float(flag), device=local_device("cuda") if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(value)
        return bool(value > 0)

    def wait(self) -> None:
        """Wait until all processes have called this."""
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


def synchronise_norms(module: nn.Module, world: World) -> nn.Module:
    """Make every BatchNorm compute statistics over all processes: torch's on GPUs, `SyncedBatchNorm` elsewhere."""
    if world.size == 1:
        return module
    if next(module.parameters()).is_cuda:
        return nn.SyncBatchNorm.convert_sync_batchnorm(module)
    for layer in module.modules():
        if type(layer) in (nn.BatchNorm1d, nn.BatchNorm2d):
            layer.__class__ = SyncedBatchNorm  # same state, different forward
    return module


class SyncedBatchNorm(nn.BatchNorm2d):
    """BatchNorm over the batches of all processes, for backends that torch's SyncBatchNorm does not support (gloo).

    Inputs are [B, C] or [B, C, H, W] with the same B on all processes. Statistics are fp32, with one message per pass. The
    arithmetic is torch's own kernels with the joint statistics.
    """

    def _check_input_dim(self, input: Tensor) -> None:
        if input.ndim not in (2, 4):
            raise ValueError(f"expected [B, C] or [B, C, H, W], got {tuple(input.shape)}")

    def forward(self, input: Tensor) -> Tensor:
        self._check_input_dim(input)
        if not self.training:
            return super().forward(input)
        assert self.running_mean is not None and self.running_var is not None and self.momentum is not None
        scratch = torch.zeros_like(self.running_mean)
        with torch.no_grad():
            own = torch.stack(torch.batch_norm_update_stats(input, scratch, scratch.clone(), 0.0)).float()
            everyones = [torch.empty_like(own) for _ in range(dist.get_world_size())]
            dist.all_gather(everyones, own)
            means, variances = torch.stack(everyones).unbind(1)  # each [N, C]
            mean = means.mean(0)
            variance = (variances + (means - mean).square()).mean(0)  # no cancellation
            num = len(means) * input.numel() // len(mean)
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (num / max(1, num - 1)), self.momentum)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked.add_(1)
        weight, bias = (self.weight, self.bias) if self.affine else (scratch + 1, scratch)
        return _Normalise.apply(input, weight, bias, mean, variance, self.eps)  # type: ignore[return-value]


class _Normalise(torch.autograd.Function):
    """(x - mean) / sqrt(variance + eps) * weight + bias, with mean and variance over all processes.

    The gradient of x is s g - s (sum(g) + y sum(g y)) / n, where s = weight / sqrt(variance + eps), n is the number of
    values per channel on all processes, y is the normalised x, and sums are over all processes. Both terms are kernels of
    BatchNorm with fixed statistics: its backward, and its forward with other weight and bias.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, mean: Tensor, variance: Tensor, eps: float
    ) -> Tensor:
        ctx.save_for_backward(x, weight, mean, variance)
        ctx.eps = eps
        return torch.native_batch_norm(x, weight, bias, mean, variance, False, 0.0, eps)[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, mean, variance = ctx.saved_tensors
        g, weight_gradient, bias_gradient = torch.ops.aten.native_batch_norm_backward(
            gradients[0], x, weight, mean, variance, None, None, False, ctx.eps, [True, True, True]
        )
        sums = _all_reduced(torch.stack([weight_gradient, bias_gradient]).float())
        scale = weight * (variance + ctx.eps).rsqrt() / (dist.get_world_size() * x.numel() // len(mean))
        other = torch.native_batch_norm(x, -scale * sums[0], -scale * sums[1], mean, variance, False, 0.0, ctx.eps)[0]
        return g + other, weight_gradient, bias_gradient, None, None, None


class _Sum(torch.autograd.Function):
    """All-reduce (sum) of the value, of its gradient, or of both."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, there: bool, back: bool) -> Tensor:
        ctx.back = back
        return _all_reduced(value) if there else value.view_as(value)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return _all_reduced(gradients[0]) if ctx.back else gradients[0], None, None


def _all_reduced(value: Tensor) -> Tensor:
    total = value.clone(memory_format=torch.contiguous_format)
    dist.all_reduce(total)
    return total
