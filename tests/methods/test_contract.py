"""What every registered method owes the loop: a finite pure forward, gradients, frozen keys, a record, an exact resume."""

import copy
import json
import typing
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from mvitac.data.pack import Pack
from mvitac.methods.base import MethodConfig, Views
from mvitac.model import load
from mvitac.nn.encoders import Encoders
from mvitac.recipes import with_method
from mvitac.registry import default, from_json, to_json
from mvitac.run import Optim
from mvitac.training.step import build_optimiser
from support.small_methods import PAIRED, TINY_VIT, build, outcome, views
from support.toy import Toy
from support.training_runs import smoke, train_twice

NAMES = sorted(MethodConfig.choices)


@pytest.mark.parametrize("touch", [3, 6])
@pytest.mark.parametrize("name", NAMES)
def test_every_trained_weight_gets_a_gradient_and_no_other(name: str, touch: int) -> None:
    method = build(name, Toy(touch_channels=touch).spec())
    losses = outcome(method, views(method, touch=touch))
    assert losses["loss"].ndim == 0 and all(torch.isfinite(value) for value in losses.values())
    losses["loss"].backward()
    trained = {id(p) for group in build_optimiser(Optim(), method, Encoders()).param_groups for p in group["params"]}
    for parameter_name, parameter in method.named_parameters():
        assert (parameter.grad is not None) == (id(parameter) in trained), parameter_name
    assert {id(p) for trunk in method.encoders().values() for p in trunk.parameters()} <= trained


@pytest.mark.skipif(not torch.backends.cuda.is_built(), reason="torch without CUDA knows no CUDA tensors")
@pytest.mark.filterwarnings("ignore:CUDA is not available")
@pytest.mark.parametrize("name", NAMES)
def test_on_a_gpu_nothing_stays_behind_and_nothing_is_waited_for(name: str) -> None:
    """Losses, update and after_step on torch's fake CUDA tensors, which have a device but no values: an operation over two
    devices raises, and so does whatever would wait for a value."""
    method, batch = build(name).train(), views(build(name))
    with FakeTensorMode():

        def fake(real: torch.Tensor) -> torch.Tensor:
            return torch.empty(real.shape, dtype=real.dtype, device=torch.device("cuda"))

        moved: dict[int, torch.nn.Parameter] = {}
        for module in method.modules():
            for key, weight in module._parameters.items():
                if weight is not None:
                    moved.setdefault(id(weight), torch.nn.Parameter(fake(weight), weight.requires_grad))
                    module._parameters[key] = moved[id(weight)]
            module._buffers.update({key: None if b is None else fake(b) for key, b in module._buffers.items()})
        images = {m: [fake(view) for view in seen] for m, seen in batch.images.items()}
        labels = {task: fake(label) for task, label in batch.labels.items()}
        losses = method(Views(images=images, labels=labels, rows=fake(batch.rows)))
        assert {value.device.type for value in losses.values()} == {"cuda"}
        for parameter in method.parameters():
            parameter.grad = fake(parameter) if parameter.requires_grad else None
        build_optimiser(Optim(name="adamw"), method, Encoders()).step()
        method.after_step(0.5)


@pytest.mark.parametrize("name", NAMES)
def test_forward_is_pure(name: str) -> None:
    """Twice the same value and, but for BatchNorm's running statistics, no parameter or buffer moves before after_step."""
    method = build(name)
    batch, before = views(method), copy.deepcopy(method.state_dict())
    first, second = outcome(method, batch), outcome(method, batch)
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    for key, value in method.state_dict().items():
        if not any(part in key for part in ("running_", "num_batches")):
            assert torch.equal(value, before[key]), key


@pytest.mark.parametrize("name", NAMES)
def test_encoders_and_projectors_fit(name: str) -> None:
    batch = views(method := build(name).eval())
    features = {m: trunk(batch.images[m][0]) for m, trunk in method.encoders().items()}
    assert {m: z.shape for m, z in features.items()} == {"vision": (8, 64), "touch": (8, 64)}
    for modality, head in method.projectors().items():
        assert head(features[modality]).shape[0] == 8
    assert len(method.projectors()) in (0, 2)
    for task, classifier in method.classifiers().items():
        assert classifier(torch.cat(list(features.values()), dim=1)).shape == (8, {"pattern": 3, "bright": 2}[task])


@pytest.mark.parametrize("name", NAMES)
def test_one_modality_works_or_is_refused(name: str) -> None:
    spec = Toy(vision_channels=0).spec()
    if name in PAIRED:
        with pytest.raises(ValueError, match=f"'{name}' learns from pairs.*'toy' has touch only"):
            build(name, spec)
        return
    method = build(name, spec)
    assert torch.isfinite(outcome(method, views(method, vision=0))["loss"]) and set(method.encoders()) == {"touch"}


@pytest.mark.parametrize("name", NAMES)
def test_resumed_equals_straight_and_loads(pack: Pack, tmp_path: Path, name: str) -> None:
    """Cut after step 3 of 4 and resumed: queues, banks and their constants come back with the weights."""
    run = with_method(smoke(pack, steps=4, checkpoint_every=2, eval_every=0), name)
    run = replace(run, encoder=TINY_VIT) if run.method.needs_vit else run
    model = load(train_twice(run, tmp_path, cut=3, validate=False))
    checkpoints = [torch.load(tmp_path / place / "checkpoint.pt")["method"] for place in ("straight", "cut")]
    torch.testing.assert_close(*checkpoints, rtol=0, atol=0)
    assert set(model.encoders) == {"vision", "touch"}


def test_a_recipe_changes_every_method_alike_and_each_survives_its_record(pack: Pack) -> None:
    """smoke asks for narrow heads (32, 16): so do the methods that have them; the rest keeps its own defaults."""
    run = smoke(pack)
    for name in NAMES:
        method = with_method(run, name).method
        assert method.name == name and from_json(MethodConfig, json.loads(json.dumps(to_json(method)))) == method
        usual = default(MethodConfig, name)
        for field, value in {"hidden": 32, "out": 16}.items():
            assert getattr(method, field, value) == value
        if hasattr(usual, "temperature"):
            assert method.temperature == usual.temperature  # type: ignore[attr-defined]
    assert with_method(run, "mvitac") is run


def numbers() -> list[tuple[str, str, object]]:
    """(method, field, impossible value) of every number in every method's config, found by reflection."""
    found: list[tuple[str, str, object]] = []
    for name in NAMES:
        for field, kind in typing.get_type_hints(type(default(MethodConfig, name))).items():
            if kind is int:
                found += [(name, field, value) for value in (-1, 0, 10**30)]
            elif kind in (float, float | None):
                found += [(name, field, value) for value in (-1.0, float("nan"), float("inf"))]
    return found


@pytest.mark.parametrize(("name", "field", "value"), numbers())
def test_impossible_numbers(name: str, field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        replace(default(MethodConfig, name), **{field: value})
