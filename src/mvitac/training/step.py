"""One optimiser step: forward, losses, backward, update; fast or small, and equal to the plain one (tests/training).

A batch comes as parts, functions that make its views anew, the same each time. One part is the plain step. Several are
gradient caching (Gao et al., arXiv:2101.06983): every part is embedded without a graph, the losses are taken over all
embeddings at once, then each part is embedded again and receives its gradient. So the batch, and with it the number of
negatives, may be any size in the memory of one part; the gradient is that of the whole batch to rounding. BatchNorm
normalises each part by its own statistics, as it does per GPU, and its running statistics move once per part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mvitac.methods.base import Contrastive, Method, Views
from mvitac.run import Optim, Run
from mvitac.system.distributed import World

Chunk = Callable[[], Views]


class Step:
    """Calling it with the parts of a batch takes one step and returns the losses (detached, on the device)."""

    def __init__(self, run: Run, method: Method, device: torch.device, world: World | None = None) -> None:
        self.method, self.device, self.world = method, device, world or World()
        self.bf16 = run.bf16
        self.optimiser = build_optimiser(run.optim, method)
        if (run.chunk or self.world.size > 1) and not isinstance(method, Contrastive):
            raise ValueError(
                f"method {run.method.name!r} takes its loss pair by pair: train it in one process, without --chunk"
            )
        if run.recompute:
            for name, trunk in method.encoders().items():
                if not hasattr(trunk, "set_grad_checkpointing"):
                    raise ValueError(f"trunk {run.encoder.trunk} ({name}) cannot recompute: leave out --recompute")
                trunk.set_grad_checkpointing(True)  # pyright: ignore[reportCallIssue]
        set_precision(run.precision)
        self.forward = torch.compile(method, fullgraph=True) if run.compile else method

    def __call__(self, parts: Sequence[Chunk], *, lr: float, seed: int, progress: float) -> dict[str, Tensor]:
        """``seed`` decides dropout; ``progress`` runs from 0 to 1 over the run."""
        for group in self.optimiser.param_groups:
            group["lr"] = lr
        self.optimiser.zero_grad(set_to_none=True)
        if len(parts) == 1 and self.world.size == 1:
            torch.manual_seed(seed)
            with self._autocast():
                losses = self.forward(parts[0]())
            losses["loss"].backward()
        else:
            losses = self._over_all(parts, seed)
        self.optimiser.step()
        self.method.after_step(progress)
        return {name: value.detach() for name, value in losses.items()}

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16)

    def _over_all(self, parts: Sequence[Chunk], seed: int) -> dict[str, Tensor]:
        """Losses over the embeddings of all parts of all processes; each embeds, and learns from, its own."""
        method, world = self.method, self.world
        assert isinstance(method, Contrastive)
        alone = len(parts) == 1  # one part keeps its graph and needs no second pass

        def queries(part: int, views: Views) -> dict[str, Tensor]:
            torch.manual_seed(seed + len(parts) * world.rank + part)  # the same dropout in both passes
            with self._autocast():
                return method.queries(views)

        running = [] if alone else _running_statistics(method)
        before = [buffer.clone() for buffer in running]
        graphs, keys = [], []
        for i, part in enumerate(parts):
            views = part()
            with torch.set_grad_enabled(alone):
                graphs.append(queries(i, views))
            with torch.no_grad(), self._autocast():
                keys.append(method.keys(views))
        own = {name: torch.cat([z[name].detach() for z in graphs]) for name in graphs[0]}
        everyones = {name: world.gather(z).requires_grad_() for name, z in own.items()}
        fixed = {name: world.gather(torch.cat([z[name] for z in keys])) for name in keys[0]}
        torch.manual_seed(seed)  # what the losses draw (CMC's negatives) is the same on every process
        with self._autocast():
            losses = method.contrast(everyones | fixed)
        # Every process takes the whole loss, so the gradient of its own embeddings is complete without communication.
        sources = [everyones[name] for name in own]
        found = torch.autograd.grad(losses["loss"], sources, allow_unused=True)  # a loss may be left out of the sum
        gradients = {name: gradient for name, gradient in zip(own, found, strict=True) if gradient is not None}
        mine = {
            name: world.own(gradient, len(own[name])).split([len(z[name]) for z in graphs])
            for name, gradient in gradients.items()
        }
        for buffer, old in zip(running, before, strict=True):
            buffer.copy_(old)  # the second pass will move them again
        for i, part in enumerate(parts):
            z = graphs[i] if alone else queries(i, part())
            torch.autograd.backward([z[name] for name in mine], [chunks[i] for chunks in mine.values()])
        world.sum_gradients(self.method)
        return losses


def _running_statistics(method: Method) -> list[Tensor]:
    """Buffers of the modules that are trained: BatchNorm's running statistics, but not those of momentum towers."""
    layers = (m for m in method.modules() if any(p.requires_grad for p in m.parameters(recurse=False)))
    return [buffer for layer in layers for buffer in layer.buffers(recurse=False)]


def build_optimiser(config: Optim, method: Method) -> torch.optim.Optimizer:
    """Over the method's trainable parameters only (momentum copies have none); one fused kernel where there is one."""
    parameters = [p for p in method.parameters() if p.requires_grad]
    fused = all(p.device.type in ("cpu", "cuda") and p.is_floating_point() for p in parameters)
    if config.name == "sgd":
        momentum, decay = config.betas[0], config.weight_decay
        return torch.optim.SGD(parameters, config.lr, momentum=momentum, weight_decay=decay, fused=fused)
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.name]
    return kind(parameters, config.lr, config.betas, config.eps, config.weight_decay, fused=fused)


def set_precision(precision: str) -> None:
    """The whole policy: fp32 is IEEE fp32, never TF32 in silence; tf32 says so; bf16 is autocast, its fp32 rest is IEEE."""
    tf32 = precision == "tf32"
    torch.backends.cuda.matmul.allow_tf32 = tf32
    torch.backends.cudnn.allow_tf32 = tf32
