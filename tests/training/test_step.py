"""The fast and the small step against the plain one: fp32 reference, gradient caching, recomputation, compilation."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from mvitac.data.pack import Pack
from mvitac.methods.base import Method, MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.methods.supervised import SupervisedConfig
from mvitac.nn.encoders import Encoders, draws_random_numbers
from mvitac.registry import default
from mvitac.run import Optim, Run
from mvitac.system import threads as system_threads
from mvitac.system.distributed import World
from mvitac.training.loop import train
from mvitac.training.setup import check_divisible
from mvitac.training.step import Step
from support.small_methods import TINY_VIT, small
from support.small_steps import RUN, assert_close, build, gradients, split, views
from support.training_runs import smoke

CPU = torch.device("cpu")


def take(run: Run, method: Method, parts: list, num: int = 1) -> dict[str, Tensor]:
    step, losses = Step(run, method, CPU), {}
    for i in range(num):
        losses = step(parts, lr=1e-3, seed=i, progress=0.5)
    return losses


def test_the_step_is_the_plain_one_written_out() -> None:
    """Adam, loss.backward and eq. 1-3 in plain torch: three steps later all weights agree to 1e-5."""
    run = replace(RUN, method=MViTacConfig(hidden=24, out=12))
    fast, plain, batch = build(run), build(run), views()
    take(run, fast, [lambda: batch], num=3)
    optimiser = torch.optim.Adam([p for p in plain.parameters() if p.requires_grad], 1e-3, eps=1e-7, foreach=False)
    for _ in range(3):
        optimiser.zero_grad()
        plain(batch)["loss"].backward()
        optimiser.step()
        for name, key in plain.key.state_dict().items():
            query = plain.query.state_dict()[name.replace(".module.", ".")]
            key.copy_(0.99 * key + 0.01 * query if key.is_floating_point() else query)
    assert_close(fast.state_dict(), plain.state_dict(), 1e-4)


def test_bf16_keeps_the_direction_of_the_gradient() -> None:
    """Stated tolerance: cosine above .9, on noise at random weights, with the fp32 gradient, losses within 3 %."""
    run = replace(RUN, method=MViTacConfig(hidden=24, out=12))
    exact, rounded, batch = build(run), build(run), views()
    a, b = take(run, exact, [lambda: batch]), take(replace(run, precision="bf16"), rounded, [lambda: batch])
    first, second = (torch.cat([g.flatten() for g in gradients(m).values()]) for m in (exact, rounded))
    assert torch.cosine_similarity(first, second, dim=0) > 0.9 and not torch.equal(first, second)
    for name in a:
        assert float(b[name]) == pytest.approx(float(a[name]), rel=0.03)


CHUNKED = [
    *[(small("mvitac"), size) for size in (2, 4, 6)],
    (replace(small("mvitac"), losses=("vv", "vt")), 4),
    *[(small(name), 4) for name in ("cmc", "ssvtp", "simclr", "moco", "mct", "byol", "dino", "vicreg", "mae", "ijepa")],
]


@pytest.mark.parametrize(("config", "size"), CHUNKED, ids=lambda value: getattr(value, "name", value))
def test_gradient_caching_is_exact_without_batchnorm_statistics(config: MethodConfig, size: int) -> None:
    """With BatchNorm in eval mode no pair sees another: cached in any chunks = direct, losses, gradients and memory."""
    run = replace(RUN, method=config, encoder=TINY_VIT if config.needs_vit else RUN.encoder)
    direct, cached = build(run, norm=False), build(run, norm=False)
    assert_close(take(run, direct, [lambda: views()]), take(run, cached, split(views(), size)), 1e-5)
    assert_close(gradients(direct), gradients(cached), 1e-4)
    states, kept = (direct.state_dict(), cached.state_dict()), ("banks", "queues", "centre")
    remembered = [{k: v for k, v in state.items() if k.startswith(kept)} for state in states]
    assert (config.name in ("cmc", "moco", "mct", "dino")) == bool(remembered[0])
    torch.testing.assert_close(*remembered, rtol=1e-4, atol=1e-5)


def test_gradient_caching_is_exact_with_batchnorm_and_dropout_chunk_by_chunk() -> None:
    """The direct graph of the same chunks, kept whole; and the running statistics move once per chunk."""
    direct, cached, parts = build(), build(), split(views(), 4)
    z, keys = [], []
    for i, part in enumerate(parts):
        torch.manual_seed(i)
        z.append(direct.queries(part()))
        keys.append(direct.keys(part()))
    losses = direct.contrast({name: torch.cat([one[name] for one in many]) for many in (z, keys) for name in many[0]})
    losses["loss"].backward()
    torch.manual_seed(9)
    assert_close({n: v.detach() for n, v in losses.items()}, take(RUN, cached, parts), 1e-5)
    assert_close(gradients(direct), gradients(cached), 1e-4)
    assert {int(b) for name, b in cached.query.named_buffers() if "num_batches" in name} == {3}
    torch.testing.assert_close(dict(direct.query.named_buffers()), dict(cached.query.named_buffers()))


def test_impossible_steps_are_named(pack: Pack, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="chunk 5: give a divisor of batch_size 16"):
        replace(RUN, chunk=5)
    with pytest.raises(ValueError, match="batch_size 16 is not divisible by 3 processes: give a multiple of 3"):
        check_divisible(RUN, World(0, 3))
    with pytest.raises(ValueError, match="'supervised' supports neither several processes nor --chunk"):
        train(smoke(pack, chunk=4, method=SupervisedConfig()), tmp_path / "r", quiet=True)


def test_towers_side_by_side_are_those_of_one_thread(two_threads: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """MViTac's two towers train in two threads where there are two: the same weights, bit for bit."""
    run = replace(RUN, method=MViTacConfig(keys="end-to-end", losses=("vt", "tv")))
    at_once, calls = system_threads._at_once, []
    monkeypatch.setattr(system_threads, "_at_once", lambda towers: calls.append(len(towers)) or at_once(towers))

    def trained(threads: int) -> dict[str, Tensor]:
        torch.set_num_threads(threads)
        method = build(run).train()
        step = Step(run, method, CPU)
        for i in range(3):
            step([views], lr=1e-2, seed=i, progress=0.5)
        assert torch.get_num_threads() == threads
        unused = [name for name, weights in method.named_parameters() if weights.grad is None]
        assert unused and all(".intra." in name for name in unused)  # not zeros, which weight decay would act on
        return method.state_dict()

    one, two = trained(1), trained(2)
    assert calls == [2, 2] * 3  # forward and backward of each step, of the second training alone
    torch.testing.assert_close(one, two, rtol=0, atol=0)
    assert draws_random_numbers(build()) and not draws_random_numbers(build(run))  # with dropout they are not


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mvitac", "mae", "ijepa"])
def test_a_compiled_step_is_one_graph(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """As ``--compile`` asks torch for it; without machine code, which takes a minute."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    method = default(MethodConfig, name)
    run = replace(RUN, method=method, encoder=TINY_VIT if method.needs_vit else RUN.encoder)
    plain, compiled = (take(replace(run, compile=c), build(run).train(), [views])["loss"] for c in (False, True))
    torch.testing.assert_close(plain, compiled)  # not equal: on some CPUs the last digits differ


@pytest.mark.parametrize("decay_norms", [True, False])
def test_layers_nearer_the_images_learn_more_slowly(decay_norms: bool) -> None:
    """layer_decay .5: decoders at full rate, the last block and its norm at half of it, the one before at half of that."""
    run = replace(RUN, method=small("mae"), encoder=TINY_VIT.changed(layer_decay=0.5))
    optim, method = Optim(name="sgd", weight_decay=0.1, decay_norms=decay_norms), build(run)
    before = {name: p.clone() for name, p in method.named_parameters()}
    Step(replace(run, optim=optim), method, CPU)([views], lr=1e-2, seed=0, progress=0.5)
    shares = {"norm.": 0.5, "blocks.1.": 0.5, "blocks.0.": 0.25, "patch_embed.": 0.125, "pos_embed": 0.125}
    for name, p in method.named_parameters():
        layer = name.removeprefix("trunks.vision.").removeprefix("trunks.touch.")
        share = 1.0 if "decoders" in name else next(s for start, s in shares.items() if layer.startswith(start))
        decay = 0.1 if p.ndim > 1 or decay_norms else 0.0
        assert p.grad is not None
        expected = before[name] - 1e-2 * share * (p.grad + decay * before[name])
        torch.testing.assert_close(p.detach(), expected, rtol=1e-5, atol=1e-7, msg=name)
    with pytest.raises(ValueError, match=r"layer_decay 1\.5: give a factor above 0, at most 1"):
        Encoders().changed(layer_decay=1.5)
