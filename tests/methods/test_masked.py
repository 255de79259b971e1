"""MAE and I-JEPA against their papers' arithmetic, written out patch by patch, on a tiny ViT with 4 x 4 patches."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from mvitac.data.spec import Window
from mvitac.methods.base import Method, Views
from mvitac.methods.ijepa import IJEPA, Blocks, IJEPAConfig, multi_block
from mvitac.methods.mae import MAE, MAEConfig, split_patches
from mvitac.nn.encoders import sin_cos_positions
from mvitac.nn.vit import Predictor, row_uniform
from mvitac.recipes import recipe
from support.small_methods import TINY, TINY_VIT, build, outcome, views
from support.toy import Toy

GRID, SIDE = (4, 4), 8
MASKED = {"mae": MAEConfig(), "ijepa": IJEPAConfig()}


def cut(image: Tensor) -> np.ndarray:
    """[16, 192]: the pixels of the patches of an image [3, 32, 32], in float64."""
    corners = product(range(0, image.shape[1], SIDE), range(0, image.shape[2], SIDE))
    return torch.stack([image[:, y : y + SIDE, x : x + SIDE].reshape(-1) for y, x in corners]).double().numpy()


def slow_predictor(predictor: Predictor, tokens: Tensor, at: Tensor, hidden: Tensor) -> np.ndarray:
    """Of one image: every place of the sequence has its position, mask tokens stand where patches are hidden."""
    where = sin_cos_positions(*GRID, predictor.embed.out_features)
    sequence = [predictor.embed(token) + where[place] for token, place in zip(tokens, at, strict=True)]
    sequence += [predictor.mask_token[0, 0, 0] + where[place] for place in hidden]
    predicted = predictor.norm(predictor.blocks(torch.stack(sequence)[None]))[0, -len(hidden) :]
    return predictor.out(predicted).detach().double().numpy()


def seen_alone(vit: torch.nn.Module, image: Tensor, at: Tensor) -> Tensor:
    """Output tokens of a ViT that is given these patches of one image and no others."""
    pixels = torch.from_numpy(cut(image)).float()[at]
    kernel = vit.patch_embed.proj  # type: ignore[union-attr]
    tokens = pixels @ kernel.weight.flatten(1).T + kernel.bias  # type: ignore[operator, union-attr]
    grid = vit.pos_embed.detach().view(1, 8, 8, -1).permute(0, 3, 1, 2)  # type: ignore[operator]
    where = torch.nn.functional.interpolate(grid, GRID, mode="bicubic", antialias=True).flatten(2).mT[0]
    return vit.norm(vit.blocks((tokens + where[at])[None]))[0]  # type: ignore[operator]


def noisy(method: Method) -> Method:
    """With weights far from their start, at which predictions are almost zero and a teacher equals its student."""
    torch.manual_seed(1)
    with torch.no_grad():
        for weight in method.parameters():
            weight += 0.2 * torch.randn_like(weight)
    return method.eval()


@pytest.mark.parametrize(("num", "ratio", "visible"), [(196, 0.75, 49), (16, 0.4, 9), (4, 0.99, 1), (9, 0.01, 8)])
def test_as_many_patches_are_hidden_as_the_ratio_says(num: int, ratio: float, visible: int) -> None:
    seen, hidden = split_patches(row_uniform(torch.tensor(3), torch.arange(50), num, 0), ratio)
    assert seen.shape == (50, visible)
    assert torch.equal(torch.cat([seen, hidden], 1).sort(1).values, torch.arange(num).expand(50, num))
    assert len({tuple(sorted(row)) for row in seen.tolist()}) > 1 or visible in (1, num - 1)


@pytest.mark.parametrize("pixel_norm", [True, False])
def test_mae_is_the_mean_squared_error_of_hidden_patches(pixel_norm: bool) -> None:
    method = noisy(build("mae", config=MAEConfig(pixel_norm=pixel_norm)))
    assert isinstance(method, MAE)
    batch = views(method, num=3)
    batch = replace(batch, seed=torch.tensor(11))
    found, errors = outcome(method, batch), {"vision": [], "touch": []}
    split = {m: split_patches(row_uniform(batch.seed, batch.rows, 16, n), 0.75) for n, m in enumerate(method.trunks)}
    for i in range(3):
        seen = {m: seen_alone(method.trunks[m], batch.images[m][0][i], split[m][0][i]) for m in errors}
        for m in ("vision", "touch"):
            at, hidden = (part[i] for part in split[m])
            assert (len(at), len(hidden)) == (4, 12)
            predicted = slow_predictor(method.decoders[m], seen[m], at, hidden)  # type: ignore[arg-type]
            for place, guess in zip(hidden, predicted, strict=True):
                target = cut(batch.images[m][0][i])[place]
                if pixel_norm:
                    target = (target - target.mean()) / math.sqrt(target.var(ddof=1) + 1e-6)
                errors[m].append(((guess - target) ** 2).mean())
    for m, each in errors.items():
        assert found[m].item() == pytest.approx(np.mean(each), rel=1e-4)
    torch.testing.assert_close(found["loss"], found["vision"] + found["touch"])


def rectangle(at: list[int], width: int) -> tuple[int, int]:
    """Height and width of the rectangle that these patches fill; fails if they are none."""
    rows, columns = sorted({p // width for p in at}), sorted({p % width for p in at})
    assert sorted(at) == [row * width + column for row in rows for column in columns]
    assert rows == [*range(rows[0], rows[-1] + 1)] and columns == [*range(columns[0], columns[-1] + 1)]
    return len(rows), len(columns)


@pytest.mark.parametrize("grid", [(14, 14), (6, 6), (4, 4), (3, 5), (2, 2)])
def test_blocks_have_their_papers_sizes_and_do_not_overlap_the_context(grid: tuple[int, int]) -> None:
    config, num, sizes = IJEPAConfig(), grid[0] * grid[1], set()
    for seed in range(12):
        blocks, shapes = multi_block(config, torch.tensor(seed), torch.arange(20), 0, grid), set()
        for row in range(20):
            targets = [blocks.targets[row, k][blocks.in_target[row, k]].tolist() for k in range(4)]
            shapes |= {rectangle(block, grid[1]) for block in targets}
            context = blocks.context[row][blocks.in_context[row]].tolist()
            assert len(set(context)) == len(context) and min(context) >= 0 and max(context) < num
            if num > 4:
                assert not set(context) & {p for block in targets for p in block}
            if num >= 36:
                assert len(context) >= 10
        assert len(shapes) == 1  # one size for the batch
        sizes |= shapes
    possible = set()
    for area in range(int(0.15 * num), int(0.2 * num) + 1):
        for aspect in np.linspace(0.75, 1.5, 2001):
            high, wide = round(math.sqrt(area * aspect)), round(math.sqrt(area / aspect))
            possible.add((min(grid[0], max(1, high)), min(grid[1], max(1, wide))))
    assert sizes <= possible and (len(sizes) > 2 or num < 196)


def test_blocks_are_a_function_of_seed_step_and_row() -> None:
    config, rows = IJEPAConfig(), torch.tensor([7, 3, 5])
    whole = multi_block(config, torch.tensor(9), rows, 0, (6, 6))
    part = multi_block(config, torch.tensor(9), rows[1:], 0, (6, 6))
    assert torch.equal(whole.context[1:], part.context) and torch.equal(whole.targets[1:], part.targets)
    for seed, step in ((8, 0), (9, 1)):
        assert not torch.equal(whole.context, multi_block(config, torch.tensor(seed), rows, step, (6, 6)).context)


def live(blocks: Blocks, row: int) -> Iterator[Tensor]:
    """Of one image, without the places that are not used: its context, then each target block."""
    yield blocks.context[row][blocks.in_context[row]]
    for k in range(blocks.targets.shape[1]):
        yield blocks.targets[row, k][blocks.in_target[row, k]]


def test_ijepa_is_smooth_l1_to_the_teachers_normalised_tokens() -> None:
    method = noisy(build("ijepa", config=IJEPAConfig(target_scale=(0.1, 0.4))))
    assert isinstance(method, IJEPA)
    batch = replace(views(method, num=3), seed=torch.tensor(5))
    found, errors = outcome(method, batch), {"vision": [], "touch": []}
    blocks = {m: method.blocks(batch, m) for m in errors}
    for i in range(3):
        context = {m: next(live(blocks[m], i)) for m in errors}
        seen = {m: seen_alone(method.trunks[m], batch.images[m][0][i], context[m]) for m in errors}
        for m in ("vision", "touch"):
            teacher, image = method.teachers[m].module, batch.images[m][0][i]
            whole = seen_alone(teacher, image, torch.arange(16)).detach().double().numpy()  # type: ignore[arg-type]
            normal = (whole - whole.mean(1, keepdims=True)) / np.sqrt(whole.var(1, keepdims=True) + 1e-5)
            for block in list(live(blocks[m], i))[1:]:
                guess = slow_predictor(method.predictors[m], seen[m], context[m], block)  # type: ignore[arg-type]
                off = np.abs(guess - normal[block])
                errors[m].append(np.where(off < 1, 0.5 * off**2, off - 0.5).mean())
    for m, each in errors.items():
        assert found[m].item() == pytest.approx(np.mean(each), rel=1e-4)


def test_the_teacher_follows_with_a_linear_momentum() -> None:
    method = build("ijepa", config=IJEPAConfig(ema=0.5))
    assert isinstance(method, IJEPA)
    student, teacher = method.trunks["touch"].norm.weight, method.teachers["touch"].module.norm.weight  # type: ignore[union-attr]
    with torch.no_grad():
        student += 1.0  # type: ignore[operator]
    method.after_step(0.5)  # m = .75: a quarter of the way
    torch.testing.assert_close(teacher, torch.full_like(teacher, 1.25))  # type: ignore[arg-type]
    assert not any(p.requires_grad for p in method.teachers.parameters())


@pytest.mark.parametrize("name", MASKED)
def test_frames_are_channels(name: str) -> None:
    window = Window(frames=2, stride=1, of=("vision", "touch"))
    config, seen, batch = MASKED[name], replace(Toy().spec(), window=window), views(build(name), num=4)
    twice = Views(images={m: [v[0].repeat(1, 2, 1, 1)] for m, v in batch.images.items()}, labels={}, rows=batch.rows)
    stacked = config.build(seen, TINY_VIT)
    assert torch.isfinite(outcome(stacked, twice)["loss"])
    if isinstance(stacked, MAE):
        assert stacked.decoders["touch"].out.out_features == 6 * SIDE**2  # type: ignore[union-attr]
    with pytest.raises(ValueError, match=r"reads the frames of a window together.*--encoder\.temporal stack"):
        config.build(seen, TINY_VIT.changed(temporal="mean"))


@pytest.mark.parametrize("name", MASKED)
def test_other_trunks_and_views_of_one_patch_are_refused(name: str) -> None:
    config, run, spec = MASKED[name], recipe("smoke"), Toy().spec()
    with pytest.raises(ValueError, match=f"method '{name}' needs a plain ViT, and trunk mvitac_tiny is a ResNet: give"):
        config.build(spec, TINY)
    with pytest.raises(ValueError, match="needs a plain ViT, and trunk mvitac_tiny is a ResNet"):
        replace(run, method=config).check(spec, 100, 72)
    with pytest.raises(ValueError, match=r"8 px are a single patch .*--augment\.size 16 or more"):
        replace(run, method=config, encoder=TINY_VIT, augment=replace(run.augment, size=8)).check(spec, 100, 72)
