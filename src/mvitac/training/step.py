"""One optimiser step: forward, losses, backward, update.

A batch comes as chunks: functions that create its views, the same ones at each call. With one chunk on one process this is
the plain step. Otherwise it is gradient caching (Gao et al., arXiv:2101.06983): each chunk is embedded without a graph, the
losses are computed over all embeddings at once, then each chunk is embedded again and receives its gradient. The batch, and
with it the number of negatives, can thus have any size in the memory of one chunk. The gradient is that of the whole batch,
up to rounding (tests/training/test_step.py). BatchNorm normalises each chunk by its own statistics (on
several GPUs by those of that chunk on all of them), and its running statistics are updated once per chunk.
"""

from collections.abc import Callable, Sequence

import torch
from timm.layers.norm_act import convert_sync_batchnorm
from timm.optim import param_groups_layer_decay  # pyright: ignore[reportPrivateImportUsage]
from torch import Tensor

from mvitac.methods.base import Contrastive, Embeddings, Method, Views
from mvitac.nn.encoders import Encoders, within
from mvitac.run import Optim, Run
from mvitac.system.distributed import World

Chunk = Callable[[], Views]


class Step:
    """Takes one optimiser step of ``method``, on ``device``; ValueError if it or its trunk does not support ``run``."""

    def __init__(self, run: Run, method: Method, device: torch.device, world: World | None = None) -> None:
        self.method, self.device, self.world, self.bf16 = method, device, world or World(), run.bf16
        if self.world.size > 1 and device.type == "cuda":  # torch has none for CPUs
            # timm's function, because torch's drops the activation that timm puts into some layers.
            convert_sync_batchnorm(method)
        self.optimiser = build_optimiser(run.optim, method, run.encoder)
        if (run.chunk or self.world.size > 1) and not isinstance(method, Contrastive):
            raise ValueError(f"method {run.method.name!r} supports neither several processes nor --chunk")
        # fp32 is IEEE fp32; bf16 is autocast, and its remaining fp32 is IEEE fp32.
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = run.precision == "tf32"
        self.forward = torch.compile(method, fullgraph=True) if run.compile else method

    def __call__(self, chunks: Sequence[Chunk], *, lr: float, seed: int, progress: float) -> dict[str, Tensor]:
        """Take one step on the ``chunks`` that this process embeds; returns the losses, detached, on the device.

        ``seed`` is that of dropout and of random draws in losses. ``progress``: share of the run that is then done.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = lr * group.get("lr_scale", 1.0)
        self.optimiser.zero_grad(set_to_none=True)
        if len(chunks) == 1 and self.world.size == 1:
            torch.manual_seed(seed)
            with self.autocast():
                losses = self.forward(chunks[0]())
            loss = losses.get("loss") if isinstance(losses, dict) else None
            if not isinstance(loss, Tensor) or loss.ndim or not loss.requires_grad:
                raise ValueError(f"{type(self.method).__name__} returned no dict with a differentiable scalar 'loss'")
            loss.backward()
        else:
            losses = self._backward_by_chunks(chunks, seed)
        self.optimiser.step()
        self.method.after_step(progress)
        return {name: torch.as_tensor(value).detach() for name, value in losses.items()}

    def autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16)

    def _backward_by_chunks(self, chunks: Sequence[Chunk], seed: int) -> dict[str, Tensor]:
        """Compute losses over all chunks of all processes, and the gradient of the parameters by gradient caching."""
        method, world = self.method, self.world
        assert isinstance(method, Contrastive)
        first_seed = seed + len(chunks) * world.rank  # each chunk has its own dropout, the same in both passes
        single = len(chunks) == 1  # keeps its graph and needs no second pass
        # Running statistics of BatchNorm in the trained modules; not those of momentum towers.
        trained = (m for m in method.modules() if any(p.requires_grad for p in m.parameters(recurse=False)))
        statistics = [] if single else [buffer for layer in trained for buffer in layer.buffers(recurse=False)]
        before = [buffer.clone() for buffer in statistics]

        def embed(views: Views, i: int) -> Embeddings:
            torch.manual_seed(first_seed + i)
            with self.autocast():
                return method.queries(views)

        # First pass: embed every chunk.
        queries, keys = [], []
        for i, chunk in enumerate(chunks):
            views = chunk()
            with torch.set_grad_enabled(single):
                queries.append(embed(views, i))
            with torch.no_grad(), self.autocast():
                keys.append(method.keys(views))

        # Losses over the embeddings of all processes, and the gradient of each of this process. Every process computes the
        # whole loss, so that this needs no communication.
        own = {name: torch.cat([z[name].detach() for z in queries]) for name in queries[0]}
        all_queries = {name: world.gather(z).requires_grad_() for name, z in own.items()}
        all_keys = {name: world.gather(torch.cat([z[name] for z in keys])) for name in keys[0]}
        torch.manual_seed(seed)  # what losses draw (CMC's negatives) is the same on every process
        with self.autocast():
            losses = method.contrast(all_queries | all_keys)
        found = torch.autograd.grad(losses["loss"], list(all_queries.values()), allow_unused=True)
        sizes = [len(next(iter(z.values()))) for z in queries]
        # None of an embedding whose loss is not part of the sum.
        given = {name: whole for name, whole in zip(all_queries, found, strict=True) if whole is not None}
        gradients = {name: g.split(len(own[name]))[world.rank].split(sizes) for name, g in given.items()}

        # Second pass: embed every chunk again, and propagate the gradients of its embeddings to the parameters.
        for buffer, old in zip(statistics, before, strict=True):
            buffer.copy_(old)  # this pass updates them again
        for i, chunk in enumerate(chunks):
            z = queries[i] if single else embed(chunk(), i)
            torch.autograd.backward([z[name] for name in gradients], [pieces[i] for pieces in gradients.values()])
        world.sum_gradients(method)
        return losses


def build_optimiser(config: Optim, method: Method, encoders: Encoders) -> torch.optim.Optimizer:
    """The optimiser of the trainable parameters, in groups of equal weight decay and share of the rate (lr_scale)."""
    parameters = [p for p in method.parameters() if p.requires_grad]
    fused = all(p.device.type in ("cpu", "cuda") and p.is_floating_point() for p in parameters)
    scales = _scales(method, encoders)
    groups: dict[tuple[float, bool], list[Tensor]] = {}
    for p in parameters:  # biases and the parameters of normalisation layers are vectors
        groups.setdefault((scales.get(id(p), 1.0), p.ndim > 1 or config.decay_norms), []).append(p)
    given = [
        {"params": found, "lr_scale": scale, "weight_decay": config.weight_decay * decayed}
        for (scale, decayed), found in groups.items()
    ]
    if config.name == "sgd":
        return torch.optim.SGD(given, config.lr, momentum=0.9, fused=fused)
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.name]
    return kind(given, config.lr, eps=config.eps, fused=fused)


def _scales(method: Method, encoders: Encoders) -> dict[int, float]:
    """id -> learning rate relative to that of the heads, of the parameters of trunks that are not trained like them."""
    scales: dict[int, float] = {}
    for name, encoder in method.encoders().items():
        config = encoders[name]
        scales |= dict.fromkeys(map(id, encoder.parameters()), config.lr_scale)
        if config.layer_decay == 1:
            continue
        trunk = within(encoder)
        if not hasattr(trunk, "group_matcher"):
            raise ValueError(f"the trunk of {name} names no layers: leave out --encoder.{name}.layer-decay")
        # timm gives a trunk without its classifier's layer the full rate at the end; here the heads are that layer.
        for group in param_groups_layer_decay(trunk, layer_decay=config.layer_decay):
            scales |= {id(p): config.lr_scale * config.layer_decay * group["lr_scale"] for p in group["params"]}
    return scales
