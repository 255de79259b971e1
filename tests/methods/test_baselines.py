"""The baselines against their owners' formulas, written out one element at a time."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mvitac.data.pack import Pack
from mvitac.evaluation.diagnostics import spread
from mvitac.evaluation.features import pack_features
from mvitac.evaluation.probe import probe_model, split_rows
from mvitac.methods.calandra import CalandraConfig
from mvitac.methods.cmc import CMC, CMCConfig
from mvitac.methods.dino import DINO, Prototypes
from mvitac.methods.mct import hinge
from mvitac.methods.moco import MoCo, MoCoConfig
from mvitac.methods.simclr import nt_xent
from mvitac.methods.supervised import SupervisedConfig
from mvitac.methods.vicreg import VICReg, covariance, variance
from mvitac.model import fresh, load
from mvitac.nn.losses import queue_nce
from mvitac.nn.memory_bank import Queue
from mvitac.recipes import with_method
from mvitac.run import Optim
from mvitac.training.loop import train
from mvitac.training.views import StepViews
from support.small_methods import ROWS, TINY, build, outcome, slow_info_nce, small, views
from support.toy import Toy, with_columns
from support.training_runs import smoke


def unit(x: torch.Tensor) -> list[list[float]]:
    return [[v / math.hypot(*row) for v in row] for row in x.tolist()]


def dot(a: list[float], b: list[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def test_queue_holds_the_last_keys_and_wraps() -> None:
    queue, keys = Queue(5, 2), torch.randn(9, 2)
    for start in (0, 3, 6):
        queue.push(keys[start : start + 3])
    held = {tuple(round(v, 5) for v in row) for row in queue.keys.tolist()}
    assert held == {tuple(round(v, 5) for v in row) for row in unit(keys[4:])}
    queue.push(torch.randn(11, 2))  # more than it holds
    assert torch.allclose(queue.keys.norm(dim=1), torch.ones(5))


def slow_nce(scores: list[list[float]], num_rows: int) -> float:
    """NCECriterion of HobbitLong/CMC: P_pos / (P_pos + m Pn + eps), m Pn / (P_neg + m Pn + eps)."""
    total, m = 0.0, len(scores[0]) - 1
    noise = m * (1.0 / num_rows)
    for row in scores:
        total += math.log(row[0] / (row[0] + noise + 1e-7))
        for p in row[1:]:
            total += math.log(noise / (p + noise + 1e-7))
    return -total / len(scores)


@pytest.mark.parametrize("softmax", [False, True])
def test_cmc_equals_a_direct_transcription(softmax: bool) -> None:
    """Fetch the drawn bank rows, exponentiate, divide by Z of the first batch; a second batch keeps that Z."""
    config = replace(small("cmc"), softmax=softmax)
    method = build("cmc", config=config)
    assert isinstance(method, CMC) and isinstance(config, CMCConfig)
    fixed: dict[str, float] = {}
    for seed in (5, 6):
        batch = views(method, seed=seed)
        banks, found = {m: bank.values.clone() for m, bank in method.banks.items()}, outcome(method, batch)
        torch.manual_seed(9)
        at, drawn = [ROWS.tolist().index(row) for row in batch.rows.tolist()], torch.randint(len(ROWS), (8, 10))
        drawn[:, 0] = torch.tensor(at)
        z, total = {m: unit(tower(batch.images[m][0])) for m, tower in method.towers.items()}, 0.0
        for name, query, bank in (("vt", "vision", "touch"), ("tv", "touch", "vision")):
            memory = banks[bank].tolist()
            logits = [[dot(z[query][i], memory[j]) / 0.07 for j in row] for i, row in enumerate(drawn.tolist())]
            if softmax:
                loss = sum(math.log(sum(math.exp(v) for v in row)) - row[0] for row in logits) / 8
            else:
                scores = [[math.exp(v) for v in row] for row in logits]
                fixed.setdefault(name, sum(map(sum, scores)) / 80 * len(ROWS))
                loss = slow_nce([[s / fixed[name] for s in row] for row in scores], len(ROWS))
            assert float(found[name].detach()) == pytest.approx(loss, rel=1e-4), (name, seed)
            total += loss
        assert float(found["loss"].detach()) == pytest.approx(total, rel=1e-4)
        method.after_step(0.5)
        for modality, bank in method.banks.items():
            assert (bank.values != banks[modality]).any(dim=1).nonzero().flatten().tolist() == sorted(at)
            new = unit(0.5 * banks[modality][at] + 0.5 * torch.tensor(z[modality]))
            torch.testing.assert_close(bank.values[at], torch.tensor(new), rtol=1e-4, atol=1e-5)


def test_ssvtp_is_the_mean_of_both_directions() -> None:
    batch = views(method := build("ssvtp"))
    z = {m: tower(batch.images[m][0]).detach() for m, tower in method.towers.items()}  # type: ignore[union-attr]
    both = slow_info_nce(z["vision"], z["touch"], 0.07) + slow_info_nce(z["touch"], z["vision"], 0.07)
    assert float(outcome(method, batch)["loss"].detach()) == pytest.approx(both / 2, rel=1e-4)


def test_nt_xent_written_out() -> None:
    a, b = torch.randn(4, 5), torch.randn(4, 5)
    z, total = unit(torch.cat([a, b])), 0.0
    for i in range(8):
        j = (i + 4) % 8
        below = sum(math.exp(dot(z[i], z[k]) / 0.3) for k in range(8) if k != i)
        total -= math.log(math.exp(dot(z[i], z[j]) / 0.3) / below)
    assert float(nt_xent(a, b, 0.3)) == pytest.approx(total / 8, rel=1e-5)


def test_losses_against_a_queue_written_out() -> None:
    q, k, queue = torch.randn(4, 5), torch.randn(4, 5), F.normalize(torch.randn(7, 5), dim=1)
    contrast, margins = 0.0, 0.0
    for a, b in zip(unit(q), unit(k), strict=True):
        positive = math.exp(dot(a, b) / 0.2)
        contrast -= math.log(positive / (positive + sum(math.exp(dot(a, n) / 0.2) for n in queue.tolist())))
        margins += sum(max(0.0, 0.2 - dot(a, b) + dot(a, n)) for n in queue.tolist())
    assert float(queue_nce(q, k, queue, 0.2)) == pytest.approx(contrast / 4, rel=1e-5)
    assert float(hinge(q, k, queue, 0.2)) == pytest.approx(margins / 28, rel=1e-5)


def test_moco_contrasts_with_the_queue_then_fills_it() -> None:
    method = build("moco")
    assert isinstance(method, MoCo)
    batch = views(method)
    keys = {m: method.key[m](batch.images[m][1]) for m in batch.images}
    queues, found = {m: queue.keys.clone() for m, queue in method.queues.items()}, outcome(method, batch)
    for modality in ("vision", "touch"):
        q = method.towers[modality](batch.images[modality][0])
        torch.testing.assert_close(found[modality], queue_nce(q, keys[modality], queues[modality], 0.2))
    before = copy.deepcopy(method.key.state_dict())
    method.after_step(0.5)
    for modality, queue in method.queues.items():
        torch.testing.assert_close(queue.keys[:8], F.normalize(keys[modality], dim=1))
        assert torch.equal(queue.keys[8:], queues[modality][8:]) and int(queue.place) == 8
    for name, value in method.key.state_dict().items():
        q = method.towers.state_dict()[name.replace(".module.", ".")]
        expected = 0.999 * before[name] + 0.001 * q if value.is_floating_point() else q
        torch.testing.assert_close(value, expected, msg=name)


def test_queues_and_negatives_are_a_share_of_the_rows() -> None:
    """An eighth; and TAG's 16,384 for its 91,982 rows, or as many per row for fewer."""
    method = MoCoConfig(hidden=8, out=4).build(Toy().spec(), TINY)
    method.prepare(ROWS)
    assert all(len(queue.keys) == 10 for queue in method.queues.values())
    assert [MoCoConfig(queue=4096).queue_size(num) for num in (1, 12, 96, 1_281_167)] == [1, 1, 12, 4_096]
    assert [CMCConfig().negatives(num) for num in (3, 3_900, 91_982)] == [1, 702, 16_384]


def test_mct_crosses_modalities_through_the_inter_heads() -> None:
    batch = views(method := build("mct"))
    towers, queues = method, {n: q.keys.clone() for n, q in method.queues.items()}  # type: ignore[union-attr]
    query = {m: towers.query[m](v[0]) for m, v in batch.images.items()}
    key = {m: towers.key[m](v[1]) for m, v in batch.images.items()}
    found = outcome(method, batch)
    torch.testing.assert_close(found["vt"], hinge(query["vision"][1], key["touch"][1], queues["touch_inter"], 0.2))
    torch.testing.assert_close(found["tt"], queue_nce(query["touch"][0], key["touch"][0], queues["touch_intra"], 0.07))
    method.after_step(0.1)
    pushed = method.queues["vision_inter"].keys[:8]  # type: ignore[union-attr]
    torch.testing.assert_close(pushed, F.normalize(key["vision"][1], dim=1))


def distance(p: torch.Tensor, t: torch.Tensor) -> float:
    rows = zip(unit(p), unit(t), strict=True)
    return sum(sum((x - y) ** 2 for x, y in zip(a, b, strict=True)) for a, b in rows) / len(p)


def test_byol_both_ways_round() -> None:
    batch = views(method := build("byol"))
    a, b = batch.images["touch"]
    online, predict, target = method.towers["touch"], method.predictor["touch"], method.target["touch"]  # type: ignore
    with torch.no_grad():
        expected = distance(predict(online(a)), target(b)) + distance(predict(online(b)), target(a))
    assert float(outcome(method, batch)["touch"].detach()) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("method", ["byol", "dino"])
def test_without_negatives_nothing_collapses(pack: Pack, tmp_path: Path, method: str) -> None:
    """30 steps of the tiny trunk: unseen touches stay apart (a collapsed trunk has spread 0)."""
    run = with_method(smoke(pack, steps=30, batch_size=30, eval_every=0, optim=Optim(name="adamw", lr=2e-3)), method)
    run = replace(run, method=replace(run.method, momentum=0.95, hidden=64))
    z = pack_features(load(train(run, tmp_path / "r", quiet=True)), pack, "touch", pack.rows("test", "val"))
    assert spread(z - z.mean(0)) > 0.3


def test_dino_equals_a_direct_transcription() -> None:
    """Two steps: cross-entropy of centred, sharpened teacher scores of the other view; the centre follows their mean."""
    method = build("dino", config=replace(small("dino"), centre_momentum=0.75))
    assert isinstance(method, DINO)
    centre = [[0.0] * 12 for _ in range(2)]
    for seed in (5, 6):
        batch = views(method, seed=seed)
        found = outcome(method, batch)
        for place, modality in enumerate(("vision", "touch")):
            with torch.no_grad():
                seen, towers = batch.images[modality], (method.towers, method.teacher)
                s, t = ([tower[modality](view).tolist() for view in seen] for tower in towers)
            total = 0.0
            for mine, other in ((0, 1), (1, 0)):
                for a, b in zip(s[mine], t[other], strict=True):
                    p = [math.exp((x - c) / 0.04) for x, c in zip(b, centre[place], strict=True)]
                    q = [math.exp(x / 0.1) for x in a]
                    total -= sum(x / sum(p) * math.log(y / sum(q)) for x, y in zip(p, q, strict=True)) / 16
            assert float(found[modality].detach()) == pytest.approx(total, rel=1e-3)
            mean = [sum(column) / 16 for column in zip(*t[0], *t[1], strict=True)]
            centre[place] = [0.75 * c + 0.25 * m for c, m in zip(centre[place], mean, strict=True)]
        method.after_step(0.5)
        torch.testing.assert_close(method.centre, torch.tensor(centre), rtol=1e-4, atol=1e-6)
    assert all(float(row.norm()) > 0 for row in method.centre)


def test_vicreg_terms_are_their_definitions() -> None:
    z = torch.randn(6, 4) * torch.tensor([0.1, 0.5, 1.0, 2.0])
    rows = z.tolist()
    mean = [sum(r[j] for r in rows) / 6 for j in range(4)]
    cov = [[sum((r[j] - mean[j]) * (r[k] - mean[k]) for r in rows) / 5 for k in range(4)] for j in range(4)]
    v = sum(max(0.0, 1 - math.sqrt(cov[j][j] + 1e-4)) for j in range(4)) / 4
    c = sum(cov[j][k] ** 2 for j in range(4) for k in range(4) if j != k) / 4
    assert float(variance(z)) == pytest.approx(v, rel=1e-4) and float(covariance(z)) == pytest.approx(c, rel=1e-4)


def test_vicreg_weighs_its_terms() -> None:
    method = build("vicreg", config=replace(small("vicreg"), invariance=3.0, variance=5.0, covariance=7.0))
    assert isinstance(method, VICReg)
    batch = views(method)
    a, b = (method.towers["touch"](view) for view in batch.images["touch"])
    expected = 3 * (a - b).square().mean() + 5 * (variance(a) + variance(b)) / 2 + 7 * (covariance(a) + covariance(b))
    torch.testing.assert_close(outcome(method, batch)["touch"], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("config", [SupervisedConfig, CalandraConfig])
def test_supervised_learns_the_labels_that_probes_are_fitted_on(pack: Pack, config: type) -> None:
    """Also of a task with a split of its own, as rough of Touch and Go's lists, and of rows without the other sense."""
    first, second = pack.spec.tasks
    spec = replace(pack.spec, tasks=(first, replace(second, split="split_bright")))
    own = [{"test": "train", "train": "test"}.get(s, s) if row % 2 else s for row, s in enumerate(pack.column("split"))]
    other = with_columns(pack, spec=spec, split_bright=own, has_vision=np.arange(pack.num) % 5 > 0)
    for sense in ("touch", "vision", "both"):
        method = config(modalities=() if sense == "both" else (sense,))
        rows = method.training_rows(other)
        for task in other.spec.tasks:
            learned = other.labels(task.name, *method.label_splits)[rows]
            fitted = split_rows(other, task, sense).fitted
            assert set(rows[learned >= 0]) == set(fitted) and 0 < len(fitted) < len(rows)
    batch = StepViews(smoke(pack, method=config()), other, 1, torch.device("cpu")).make(rows, 0)
    assert (batch.labels["bright"].numpy() == other.labels("bright", "train", "val")[rows]).all()


def test_calandra_has_a_trunk_per_stream() -> None:
    touch = (method := CalandraConfig().build(Toy(touch_channels=6).spec(), TINY)).encoders()["touch"]
    assert len(touch.trunks) == 2 and touch.num_features == 128  # type: ignore[union-attr, arg-type]
    head = method.classifiers()["bright"]
    sizes = [(layer.in_features, layer.out_features) for layer in head if hasattr(layer, "in_features")]  # type: ignore
    assert sizes == [(192, 512), (512, 256), (256, 2)]
    left, right = torch.randn(2, 3, 32, 32), torch.randn(2, 3, 32, 32)
    z = touch.eval()(torch.cat([left, right], dim=1))
    torch.testing.assert_close(z[:, :64], touch.trunks[0](left))  # type: ignore[index]
    torch.testing.assert_close(z[:, 64:], touch.trunks[1](right))  # type: ignore[index]


def test_the_own_classifier_is_scored_on_views_of_the_side_it_learned_from(pack: Pack) -> None:
    """Whatever side serves a probe best."""
    run = smoke(pack, method=SupervisedConfig())
    model = fresh(run, pack.spec, pack.size).eval()
    model.run = replace(run, augment=replace(run.augment, size=24, whole=32))
    task, rows = pack.spec.tasks[0], pack.rows("test")
    own = next(r for r in probe_model(model, pack, [task], ["both"], ["linear"]) if r["probe"] == "own")
    z = {m: pack_features(model, pack, m, rows, for_heads=True) for m in ("vision", "touch")}
    right = model.answer("pattern", z).argmax(1).numpy() == pack.column("label_pattern")[rows]
    assert own["accuracy"] == pytest.approx(right.mean())
    assert not torch.equal(z["touch"], pack_features(model, pack, "touch", rows))


def test_prototypes_start_with_the_owners_norm() -> None:
    """weight_norm of torch's Linear(256, K): rows uniform in +-1/16, of norm sqrt(256 / 3) / 16."""
    expected = torch.nn.Linear(256, 4096, bias=False).weight.norm(dim=1).mean().item()
    assert Prototypes(8, 16, 4096).directions.norm(dim=1).mean().item() == pytest.approx(expected, rel=0.01)
