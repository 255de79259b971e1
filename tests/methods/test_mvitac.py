"""The method against the paper: eq. 1-14 written out slowly, and what may and may not be trained."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch

from mvitac.methods.mvitac import PARTS, MViTacConfig
from mvitac.nn.encoders import SCRATCH, Encoders
from support.small_methods import TINY, build, slow_info_nce, views
from support.toy import Toy

CONFIG = MViTacConfig(hidden=24, out=12)


def built(**changes: Any) -> Any:
    return build("mvitac", config=replace(CONFIG, **changes))


def test_equals_the_paper_written_out() -> None:
    """Eq. 4-14 with the paper's symbols, one embedding at a time, on copies of the same weights."""
    batch = views(method := built(lambda_inter=0.7, temperature=0.2))
    with torch.no_grad():  # make keys differ from queries, or confusing them would go unseen
        for p in method.key.parameters():
            p.add_(0.05 * torch.randn_like(p))
    theta, psi = copy.deepcopy(method.query["vision"]), copy.deepcopy(method.query["touch"])
    theta_k, psi_k = copy.deepcopy(method.key["vision"].module), copy.deepcopy(method.key["touch"].module)
    phi_v_q, phi_t_q, Phi_t_q, Phi_v_q = theta.intra, theta.inter, psi.intra, psi.inter
    phi_v_k, phi_t_k, Phi_t_k, Phi_v_k = theta_k.intra, theta_k.inter, psi_k.intra, psi_k.inter
    (o_v_q, o_v_k), (o_t_q, o_t_k) = batch.images["vision"], batch.images["touch"]
    f_v_q, f_t_q = theta.trunk(o_v_q), psi.trunk(o_t_q)
    f_v_k, f_t_k = theta_k.trunk(o_v_k), psi_k.trunk(o_t_k)
    L_vv = slow_info_nce(phi_v_q(f_v_q), phi_v_k(f_v_k), 0.2)  # eq. 4, 5, 8
    L_tt = slow_info_nce(Phi_t_q(f_t_q), Phi_t_k(f_t_k), 0.2)  # eq. 6, 7
    L_vt = slow_info_nce(phi_t_q(f_v_q), Phi_v_k(f_t_k), 0.2)  # eq. 9, 10, 11
    L_tv = slow_info_nce(Phi_v_q(f_t_q), phi_t_k(f_v_k), 0.2)  # eq. 12, 13
    with torch.no_grad():
        out = method(batch)
    for name, expected in {"vv": L_vv, "tt": L_tt, "vt": L_vt, "tv": L_tv}.items():
        assert float(out[name]) == pytest.approx(expected, rel=1e-4), name
    assert float(out["loss"]) == pytest.approx(L_vv + L_tt + 0.7 * (L_vt + L_tv), rel=1e-4)  # eq. 14


def test_each_view_passes_each_encoder_once() -> None:
    method = built()
    calls: list[str] = []
    for side in ("query", "key"):
        for modality, tower in getattr(method, side).items():
            trunk = tower.trunk if side == "query" else tower.module.trunk
            trunk.register_forward_hook(lambda *_, name=f"{side} {modality}": calls.append(name))
    method(views(method))
    assert sorted(calls) == ["key touch", "key vision", "query touch", "query vision"]


def test_heads_are_as_printed() -> None:
    """Appendix A: 512 -> hidden -> 128, ReLU after the first layer, nothing after the last."""
    tower = MViTacConfig().build(Toy().spec(), Encoders().changed(trunk="resnet18", weights=SCRATCH)).query["touch"]
    assert [type(layer).__name__ for layer in tower.intra] == ["Linear", "ReLU", "Linear"]
    assert (tower.intra[0].in_features, tower.inter[-1].out_features) == (512, 128)


def test_end_to_end_keys_are_the_queries_and_learn() -> None:
    """Without momentum towers: the mean loss of keys that equal the queries, in both ways; its gradient is another one."""
    learned, copied = built(keys="end-to-end"), built()
    assert not list(learned.key.parameters())
    batch = views(learned)
    turned = replace(batch, images={m: both[::-1] for m, both in batch.images.items()})
    mine, there, back = learned(batch), copied(batch), copied(turned)
    theirs = {name: (there[name] + back[name]) / 2 for name in there}
    torch.testing.assert_close(mine, theirs)
    mine["loss"].backward()
    theirs["loss"].backward()
    found = [(a.grad, b.grad) for a, b in zip(learned.query.parameters(), copied.query.parameters(), strict=True)]
    assert not all(torch.allclose(a, b, rtol=0.05) for a, b in found if a is not None and b is not None)
    learned.after_step(0.5)  # has nothing to move


def test_all_pairs_are_the_mean_over_four_pairs_of_views() -> None:
    """Inter-modal losses: both queries against both keys; intra-modal ones never pair a view with itself."""
    batch = views(method := built(keys="end-to-end", pairs="all"))
    z = method.queries(batch) | method.keys(batch)
    losses, tau = method.contrast(z), CONFIG.temperature
    for part, (mine, other) in PARTS.items():
        head = "intra" if mine == other else "inter"
        pairs = [(q, k) for q in (0, 1) for k in (0, 1) if mine != other or q != k]
        terms = [slow_info_nce(z["q", mine, q, head], z["q", other, k, head], tau) for q, k in pairs]
        assert losses[part].item() == pytest.approx(sum(terms) / len(terms), rel=1e-5)
    method.config = replace(method.config, pairs="crossed")
    assert not torch.allclose(method.contrast(z)["vt"], losses["vt"])


@pytest.mark.parametrize("keys", ["momentum", "end-to-end"])
def test_touch_alone_keeps_its_intra_loss(keys: str) -> None:
    method: Any = build("mvitac", Toy(vision_channels=0).spec(), replace(CONFIG, keys=keys))  # type: ignore[arg-type]
    out = method(views(method, vision=0))
    assert set(out) == {"loss", "tt"} and torch.equal(out["loss"], out["tt"])


@pytest.mark.parametrize("keys", ["momentum", "end-to-end"])
def test_the_loss_between_sensors_written_out(keys: str) -> None:
    """One more term beside eq. 14: touch view 0 and view 2, the same press through another sensor, by the intra heads."""
    plain, method = (built(keys=keys, lambda_sensor=weight) for weight in (0.0, 0.3))
    batch = views(method)
    torch.manual_seed(8)
    batch.images["touch"].append(torch.randn(8, 3, 32, 32))
    query = method.query["touch"]
    key = query if keys == "end-to-end" else method.key["touch"].module
    with torch.no_grad():
        for p in method.key.parameters():  # or confusing keys with queries would go unseen
            p.add_(0.05 * torch.randn_like(p))
        first, third = (batch.images["touch"][view] for view in (0, 2))
        expected = slow_info_nce(query.intra(query.trunk(first)), key.intra(key.trunk(third)), 0.07)
        plain.load_state_dict(method.state_dict())
        out, without = method(batch), plain(views(plain))
    assert float(out["sensor"]) == pytest.approx(expected, rel=1e-4)
    assert float(out["loss"]) == pytest.approx(float(without["loss"]) + 0.3 * expected, rel=1e-4)
    assert "sensor" not in without


def test_settings_that_cannot_work_are_refused() -> None:
    vision_only, sensors = replace(Toy().spec(), touch_channels=0), replace(CONFIG, lambda_sensor=1.0)
    with pytest.raises(ValueError, match="has no touch"):
        sensors.build(vision_only, TINY)
    assert sensors.without_idle(vision_only).lambda_sensor == 0 and sensors.without_idle(Toy().spec()) == sensors
    with pytest.raises(ValueError, match="give keys 'end-to-end', or pairs 'crossed'"):
        replace(CONFIG, pairs="all")
    with pytest.raises(ValueError, match="losses"):
        replace(CONFIG, losses=())
    with pytest.raises(ValueError, match="give some of vv"):
        replace(CONFIG, losses=("tt", "vt")).build(vision_only, TINY)


def test_left_out_losses_are_told_but_not_minimised() -> None:
    batch = views(full := built())
    parts = full(batch)
    for losses in (("tt",), ("vv", "tv"), ("vt", "tv")):
        part = built(losses=losses, lambda_inter=0.5)(batch)
        expected = sum(parts[name] * (0.5 if name in ("vt", "tv") else 1) for name in losses)
        torch.testing.assert_close(part["loss"], expected)
        assert set(part) == {"loss", "vv", "tt", "vt", "tv"}
