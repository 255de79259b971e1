"""One optimiser step: forward, losses, backward, update.

A batch comes as chunks: functions that create its views, the same ones at each call. With one chunk on one process this is
the plain step. Otherwise it is gradient caching (Gao et al., arXiv:2101.06983): each chunk is embedded without a graph, the
losses are computed over all embeddings at once, then each chunk is embedded again and receives its gradient. The batch, and
with it the number of negatives, can thus have any size in the memory of one chunk. The gradient is that of the whole batch,
up to rounding (tests/training/test_step.py). BatchNorm normalises each chunk by its own statistics, as it does per GPU, and
its running statistics are updated once per chunk.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from timm.optim import param_groups_layer_decay  # pyright: ignore[reportPrivateImportUsage]
from torch import Tensor

from mvitac.data.spec import MODALITIES
from mvitac.methods.base import Contrastive, Embeddings, Method, Views
from mvitac.nn.encoders import Encoders, PerFrame
from mvitac.run import Optim, Run
from mvitac.system.distributed import World

Chunk = Callable[[], Views]


class Step:
    """Takes one optimiser step of ``method``, which is on ``device``, when called.

    Raises:
        ValueError: If the method or the trunk does not support the settings of ``run``.
    """

    def __init__(self, run: Run, method: Method, device: torch.device, world: World | None = None) -> None:
        self.method, self.device, self.world = method, device, world or World()
        self.bf16 = run.bf16
        self.optimiser = build_optimiser(run.optim, method, run.encoder)
        if (run.chunk or self.world.size > 1) and not isinstance(method, Contrastive):
            raise ValueError(
                f"method {run.method.name!r} supports neither several processes nor --chunk: leave them out"
            )
        set_precision(run.precision)
        self.forward = torch.compile(method, fullgraph=True) if run.compile else method

    def __call__(self, chunks: Sequence[Chunk], *, lr: float, seed: int, progress: float) -> dict[str, Tensor]:
        """Take one step on the ``chunks`` that this process embeds; returns the losses, detached, on the device.

        ``seed`` is that of dropout and of random draws in losses. ``progress`` is the share of the run that is done after
        this step, from 0 to 1.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = lr * group.get("lr_scale", 1.0)
        self.optimiser.zero_grad(set_to_none=True)
        if len(chunks) == 1 and self.world.size == 1:
            torch.manual_seed(seed)
            with self.autocast():
                losses = self.forward(chunks[0]())
            losses["loss"].backward()
        else:
            losses = self._backward_by_chunks(chunks, seed)
        self.optimiser.step()
        self.method.after_step(progress)
        return {name: value.detach() for name, value in losses.items()}

    def autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16)

    def _backward_by_chunks(self, chunks: Sequence[Chunk], seed: int) -> dict[str, Tensor]:
        """Compute losses over all chunks of all processes, and the gradient of the parameters by gradient caching."""
        method, world = self.method, self.world
        assert isinstance(method, Contrastive)
        first_seed = seed + len(chunks) * world.rank  # each chunk has its own dropout, the same in both passes
        single = len(chunks) == 1  # keeps its graph and needs no second pass
        statistics = [] if single else _running_statistics(method)
        before = [buffer.clone() for buffer in statistics]

        # First pass: embed every chunk.
        queries, keys = [], []
        for i, chunk in enumerate(chunks):
            views = chunk()
            with torch.set_grad_enabled(single):
                queries.append(self._queries(views, first_seed + i))
            with torch.no_grad(), self.autocast():
                keys.append(method.keys(views))

        # Losses over all embeddings, and the gradient of each embedding of this process.
        losses, gradients = self._contrast(queries, keys, seed)

        # Second pass: embed every chunk again, and propagate the gradients of its embeddings to the parameters.
        for buffer, old in zip(statistics, before, strict=True):
            buffer.copy_(old)  # this pass updates them again
        for i, chunk in enumerate(chunks):
            z = queries[i] if single else self._queries(chunk(), first_seed + i)
            torch.autograd.backward([z[name] for name in gradients[i]], list(gradients[i].values()))
        world.sum_gradients(method)
        return losses

    def _queries(self, views: Views, seed: int) -> Embeddings:
        assert isinstance(self.method, Contrastive)
        torch.manual_seed(seed)
        with self.autocast():
            return self.method.queries(views)

    def _contrast(
        self, queries: list[Embeddings], keys: list[Embeddings], seed: int
    ) -> tuple[dict[str, Tensor], list[Embeddings]]:
        """Losses over the embeddings of all processes, and their gradients for ``queries``, chunk by chunk.

        Every process computes the whole loss, so the gradient of its own embeddings needs no communication.
        """
        assert isinstance(self.method, Contrastive)
        own = {name: torch.cat([z[name].detach() for z in queries]) for name in queries[0]}
        all_queries = {name: self.world.gather(z).requires_grad_() for name, z in own.items()}
        all_keys = {name: self.world.gather(torch.cat([z[name] for z in keys])) for name in keys[0]}
        torch.manual_seed(seed)  # what losses draw (CMC's negatives) is the same on every process
        with self.autocast():
            losses = self.method.contrast(all_queries | all_keys)
        # An embedding gets no gradient if its loss is not part of the sum.
        found = torch.autograd.grad(losses["loss"], list(all_queries.values()), allow_unused=True)
        sizes = [len(next(iter(z.values()))) for z in queries]
        by_name = {
            name: self.world.own(gradient, len(own[name])).split(sizes)
            for name, gradient in zip(all_queries, found, strict=True)
            if gradient is not None
        }
        return losses, [{name: pieces[i] for name, pieces in by_name.items()} for i in range(len(queries))]


def _running_statistics(method: Method) -> list[Tensor]:
    """Running statistics of BatchNorm in the trained modules; not those of momentum towers."""
    layers = (m for m in method.modules() if any(p.requires_grad for p in m.parameters(recurse=False)))
    return [buffer for layer in layers for buffer in layer.buffers(recurse=False)]


def build_optimiser(config: Optim, method: Method, encoders: Encoders) -> torch.optim.Optimizer:
    """Create the optimiser of the trainable parameters (momentum copies have none). Uses a fused kernel if available."""
    parameters: Any = [p for p in method.parameters() if p.requires_grad]
    fused = all(p.device.type in ("cpu", "cuda") and p.is_floating_point() for p in parameters)
    if scales := _scales(method, encoders):
        parameters = _by_scale(config, parameters, scales)
    elif config.weight_decay and not config.decay_norms:
        vectors = [p for p in parameters if p.ndim <= 1]  # biases and BatchNorm
        matrices = [p for p in parameters if p.ndim > 1]
        parameters = [{"params": matrices}, {"params": vectors, "weight_decay": 0.0}]
    if config.name == "sgd":
        return torch.optim.SGD(parameters, config.lr, momentum=0.9, weight_decay=config.weight_decay, fused=fused)
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.name]
    return kind(parameters, config.lr, eps=config.eps, weight_decay=config.weight_decay, fused=fused)


def _scales(method: Method, encoders: Encoders) -> dict[int, float]:
    """id -> learning rate relative to that of the heads, of the parameters of trunks that are not trained like them."""
    scales: dict[int, float] = {}
    for name in MODALITIES:
        config = encoders[name]
        if config.lr_scale == config.layer_decay == 1 or name not in method.encoders():
            continue
        encoder = method.encoders()[name]
        scales |= dict.fromkeys(map(id, encoder.parameters()), config.lr_scale)
        trunk = encoder.trunk if isinstance(encoder, PerFrame) else encoder
        if config.layer_decay < 1 and not hasattr(trunk, "group_matcher"):
            raise ValueError(f"the trunk of {name} names no layers: leave out --encoder.{name}.layer-decay")
        # timm gives a trunk without its classifier's layer the full rate at the end; here the heads are that layer.
        for group in param_groups_layer_decay(trunk, layer_decay=config.layer_decay) if config.layer_decay < 1 else ():
            scale = config.lr_scale * config.layer_decay * group["lr_scale"]
            scales |= {id(p): scale for p in group["params"]}
    return scales


def _by_scale(config: Optim, parameters: list[Tensor], scales: dict[int, float]) -> list[dict[str, Any]]:
    """Groups of ``parameters`` with equal weight decay and equal share of the learning rate (lr_scale)."""
    groups: dict[tuple[float, bool], list[Tensor]] = {}
    for p in parameters:
        groups.setdefault((scales.get(id(p), 1.0), p.ndim > 1 or config.decay_norms), []).append(p)
    return [
        {"params": found, "lr_scale": scale, "weight_decay": config.weight_decay if decayed else 0.0}
        for (scale, decayed), found in groups.items()
    ]


def set_precision(precision: str) -> None:
    """Allow TF32 for precision tf32 only. fp32 is IEEE fp32; bf16 is autocast, and its remaining fp32 is IEEE fp32."""
    tf32 = precision == "tf32"
    torch.backends.cuda.matmul.allow_tf32 = tf32
    torch.backends.cudnn.allow_tf32 = tf32
