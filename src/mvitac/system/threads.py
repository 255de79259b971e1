"""Parallel work in threads, each with its share of torch's threads."""

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any, TypeVar

import torch
from torch import Tensor

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Apply ``function`` to each item in several threads, each with its share of torch's threads; results are in order.

    Use it for CPU work that releases the GIL and does not use global random generators, such as forward passes of different
    models. Several tasks with few threads each are faster than one task with many.
    """
    if torch.get_num_threads() < 2:
        return list(map(function, items))
    return _at_once([partial(function, item) for item in items])


def in_branches(branches: Sequence[Callable[[], dict[Hashable, Tensor]]]) -> dict[Hashable, Tensor]:
    """Run networks that are trained together in parallel threads, forward and backward; their tensors in one dict.

    Each gets its share of torch's threads. Two networks with one thread each use two cores better than one network with
    two threads, which wait for each other after every layer. In fp32 the results equal those of one thread bit for bit.
    The ``branches`` share no parameters and draw no random numbers.
    """
    one = torch.compiler.is_compiling() or len(branches) < 2 or torch.distributed.is_initialized()
    threads = 1 if one else torch.get_num_threads()  # torch.compile cannot ask for it
    if threads < 2:
        return {name: tensor for branch in branches for name, tensor in branch().items()}
    cpu = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu"), torch.is_grad_enabled()

    def in_this_mode(branch: Callable[[], dict[Hashable, Tensor]]) -> dict[Hashable, Tensor]:
        # A new thread has none of these modes. All threads share autocast's cache, and the first to end clears it.
        with torch.autocast("cpu", cpu[1], enabled=cpu[0], cache_enabled=False), torch.set_grad_enabled(cpu[2]):
            return branch()

    named: list[Hashable] = []
    given = _Branches.apply(torch.empty(0, requires_grad=True), [partial(in_this_mode, b) for b in branches], named)
    return dict(zip(named, given, strict=True))  # type: ignore[arg-type]


class _Branches(torch.autograd.Function):
    """Cut the graph at the branches' outputs, so that backward runs all branches once all gradients are known."""

    @staticmethod
    def forward(
        ctx: Any, anchor: Tensor, branches: list[Callable[[], dict[Hashable, Tensor]]], named: list[Hashable]
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)  # None instead of zeros for outputs that no loss uses
        made = _at_once(branches)
        named += [name for tensors in made for name in tensors]
        ctx.made = [list(tensors.values()) for tensors in made]
        cut = [[tensor.detach() for tensor in tensors] for tensors in ctx.made]
        both = [(c, t) for cuts, tensors in zip(cut, ctx.made, strict=True) for c, t in zip(cuts, tensors, strict=True)]
        ctx.mark_non_differentiable(*(c for c, t in both if not t.requires_grad))
        return tuple(c for c, _ in both)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[None, None, None]:
        left = iter(gradients)
        pairs = [[(t, g) for t in tensors if (g := next(left)) is not None] for tensors in ctx.made]
        given = [tuple(zip(*used, strict=True)) for used in pairs if used]
        _at_once([partial(torch.autograd.backward, *each) for each in given])
        return None, None, None


def _at_once(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """The results of ``calls``, the first in this thread, each with its share of torch's threads."""
    threads = torch.get_num_threads()
    share = max(1, threads // max(1, len(calls)))
    torch.set_num_threads(share)
    others = [_pool(max(1, threads - 1), share).submit(call) for call in calls[1:]]
    try:
        found = {0: calls[0]()} if calls else {}
        # What no thread has begun is done here: never more calls at once than threads, as each may need much memory.
        found |= {i: calls[i]() for i in range(len(others), 0, -1) if others[i - 1].cancel()}
        return [found[i] if i in found else others[i - 1].result() for i in range(len(calls))]
    finally:
        _ = [other.cancel() for other in others]  # after an error nothing more is begun
        torch.set_num_threads(threads)


@cache
def _pool(num: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num, "branch", torch.set_num_threads, (threads,))
