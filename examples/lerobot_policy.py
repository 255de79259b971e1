"""Train a LeRobot policy that feels by an encoder of mvitac, on recorded episodes, and ask whether it uses touch.

    python examples/record_servo.py --kind curved --episodes 20 --out packs/curved
    python examples/lerobot_policy.py base packs/curved --policy act --touch frozen --out runs/act

MODEL is anything that mvitac.load opens; the pack has touch, and values named action and state. --touch says how the
policy feels: "features" of the encoder as environment state; its trunk as the policy's backbone, "frozen" or "tuned";
or "own", LeRobot's ResNet-18 from random weights. Needs lerobot (docs/policies.md has the versions).
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import SpatialSoftmax
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor, nn

import mvitac
from mvitac.control.ablate import Episodes, ablate, read_episodes, report
from mvitac.deploy.policy import ObservationEncoder

GEL, STATE, FEATURES, ACTION = "observation.images.gel", "observation.state", "observation.environment_state", "action"
CHUNK = 8
SMALL: dict[str, Any] = {  # sizes for a CPU
    "act": {"dim_model": 128, "dim_feedforward": 512, "chunk_size": CHUNK, "n_action_steps": CHUNK},
    "diffusion": {"down_dims": (64, 128), "horizon": CHUNK, "n_action_steps": 4, "crop_shape": None}
    | {"noise_scheduler_type": "DDIM", "num_inference_steps": 10, "use_separate_rgb_encoder_per_camera": False},
}


class Backbone(nn.Module):
    """Images [B, 3, H, W] to the last map of the touch trunk, [B, D, h, w], named as ACT wants it or as it is."""

    def __init__(self, encoder: ObservationEncoder, name: str) -> None:
        super().__init__()
        self.encoder, self.name = encoder, name

    def forward(self, images: Tensor) -> Any:
        maps = self.encoder.maps({GEL: images})["touch"]
        return {self.name: maps} if self.name else maps


def give_backbone(policy: Any, encoder: ObservationEncoder, image: Tensor) -> None:
    """Put the encoder's trunk in the place of LeRobot's ResNet."""
    width, *places = encoder.maps({GEL: image[None]})["touch"].shape[1:]
    if policy.name == "act":
        policy.model.backbone = Backbone(encoder, "feature_map")
        policy.model.encoder_img_feat_input_proj = nn.Conv2d(width, policy.config.dim_model, 1)
    else:
        eye = policy.diffusion.rgb_encoder
        eye.backbone = Backbone(encoder, "")
        eye.pool = SpatialSoftmax((width, *places), num_kp=policy.config.spatial_softmax_num_keypoints)


class Eyes:
    """What the policy is given of touch: its images, or their features."""

    def __init__(self, encoder: ObservationEncoder, how: str, images: Any) -> None:
        self.encoder, self.images, self.key = encoder, images, FEATURES if how == "features" else GEL

    def __call__(self, rows: np.ndarray) -> Tensor:
        """Of rows [B] or [B, T]: float [..., 3, H, W] in [0, 1] as LeRobot has images, or features [..., D]."""
        return self.see(np.asarray(self.images[rows.ravel()])).unflatten(0, rows.shape)

    def see(self, images: np.ndarray) -> Tensor:
        found = torch.from_numpy(np.array(images)).movedim(-1, -3) / 255
        return self.encoder({GEL: found}) if self.key == FEATURES else found


def make(kind: str, how: str, eyes: Eyes, numbers: dict[str, np.ndarray], rows: np.ndarray) -> tuple[Any, Any, Any]:
    """The policy and its processors; ``numbers`` of ``rows`` give the statistics."""
    felt = {GEL: eyes(rows[:1])} if eyes.key == GEL else {FEATURES: torch.cat([eyes(part) for part in parts(rows)])}
    known = {key: torch.from_numpy(value[rows]).float() for key, value in numbers.items()} | felt
    kinds = {STATE: FeatureType.STATE, GEL: FeatureType.VISUAL, FEATURES: FeatureType.ENV, ACTION: FeatureType.ACTION}
    features = {key: PolicyFeature(kinds[key], tuple(value.shape[1:])) for key, value in known.items()}
    config = {"act": ACTConfig, "diffusion": DiffusionConfig}[kind](
        output_features={ACTION: features.pop(ACTION)},
        input_features=features,
        device="cpu",
        pretrained_backbone_weights=None,
        **SMALL[kind],
    )
    # LeRobot normalises features, which have no fixed scale. Images it must leave alone: the encoder does that.
    config.normalization_mapping |= {"ENV": NormalizationMode.MEAN_STD, "VISUAL": NormalizationMode.IDENTITY}
    policy = get_policy_class(kind)(config)
    if how in ("frozen", "tuned"):
        give_backbone(policy, eyes.encoder, known[GEL][0])
    stats = {
        key: {"mean": v.mean(0), "std": v.std(0), "min": v.amin(0), "max": v.amax(0)}
        for key, v in known.items()
        if key != GEL
    }
    return policy, *make_pre_post_processors(config, dataset_stats=stats)


def parts(rows: np.ndarray) -> list[np.ndarray]:
    return np.split(rows, range(64, len(rows), 64))


def around(rows: list[np.ndarray], picked: np.ndarray, steps: list[int]) -> tuple[np.ndarray, Tensor]:
    """Rows [B, T] that are ``steps`` from the picked (episode, place) [B, 2], and which of them would be outside it."""
    last = np.array([len(rows[episode]) - 1 for episode, _ in picked])[:, None]
    at = picked[:, 1:] + np.array(steps)
    inside = np.clip(at, 0, last)
    found = np.array([rows[episode][places] for (episode, _), places in zip(picked, inside, strict=True)])
    return found, torch.from_numpy(at != inside)


def train(
    policy: Any, before: Any, eyes: Eyes, numbers: dict[str, np.ndarray], rows: list[np.ndarray], steps: int
) -> None:
    """Behaviour cloning of the episodes ``rows``."""
    every = np.array([(episode, place) for episode, each in enumerate(rows) for place in range(len(each))])
    rng, config = np.random.default_rng(0), policy.config
    optimiser = config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(steps):
        picked = every[rng.integers(len(every), size=16)]
        ahead, outside = around(rows, picked, config.action_delta_indices)
        seen, _ = around(rows, picked, config.observation_delta_indices or [0])
        seen = seen if config.observation_delta_indices else seen[:, 0]
        batch = {STATE: torch.from_numpy(numbers[STATE][seen]).float(), eyes.key: eyes(seen)}
        batch |= {ACTION: torch.from_numpy(numbers[ACTION][ahead]).float(), "action_is_pad": outside}
        loss, _ = policy(before(batch))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 50 == 0 or step == steps - 1:
            print(f"step {step + 1}: loss {loss.item():.3f}", flush=True)


def acting(policy: Any, before: Any, after: Any, eyes: Eyes) -> Callable[[dict[str, Any]], np.ndarray]:
    """The policy as ``mvitac ablate`` calls it."""

    @torch.no_grad()
    def act(observation: dict[str, Any]) -> np.ndarray:
        state = torch.from_numpy(np.float32(observation["state"]))[None]
        batch = {STATE: state, eyes.key: eyes.see(observation["touch"][None])}
        return after(policy.select_action(before(batch)))[0].numpy()

    def reset() -> None:
        torch.manual_seed(0)  # diffusion draws the same with and without touch
        policy.reset()

    policy.eval()
    act.reset = reset  # type: ignore[attr-defined]
    return act


def only(episodes: Episodes, numbers: list[int]) -> Episodes:
    """The episodes of these numbers."""
    of = np.isin(np.repeat(range(len(episodes.rows)), [len(rows) for rows in episodes.rows]), numbers)
    begin, rows = ([each[number] for number in numbers] for each in (episodes.begin, episodes.rows))
    return replace(episodes, begin=begin, rows=rows, actions=episodes.actions[of], touched=episodes.touched[of])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("pack", type=Path)
    parser.add_argument("--policy", choices=SMALL, default="act")
    parser.add_argument("--touch", choices=("features", "frozen", "tuned", "own"), default="frozen")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--out", type=Path, help="folder of the policy; `mvitac ablate` opens one of --touch own")
    options = parser.parse_args()
    torch.manual_seed(0)
    pack = mvitac.Pack(options.pack)
    encoder = ObservationEncoder(mvitac.load(options.model), {GEL: "touch"}, tune=options.touch == "tuned")
    eyes = Eyes(encoder, options.touch, pack.images["touch"])
    values = {task.name: pack.values(task) for task in pack.spec.values}
    if not {"action", "state"} <= {*values}:
        raise SystemExit(f"{pack.path} lacks values named action and state: pack them with --values")
    numbers = {STATE: values["state"], ACTION: values["action"]}
    episodes = read_episodes(pack)
    held_out = [number for number, rows in enumerate(episodes.rows) if pack.column("split")[rows[0]] == "test"]
    shown = [rows for number, rows in enumerate(episodes.rows) if number not in held_out]
    policy, before, after = make(options.policy, options.touch, eyes, numbers, np.concatenate(shown))
    train(policy, before, eyes, numbers, shown, options.steps)
    for part in (policy, before, after) if options.out else ():
        part.save_pretrained(options.out)
    print(report(ablate(acting(policy, before, after, eyes), only(episodes, held_out))))


if __name__ == "__main__":
    main()
