"""Does a policy use touch? Replace what it feels (or sees) in recorded episodes, and compare what it does.

A policy is a function of an observation, called for each frame of an episode in order:

    {"touch": uint8 [H, W, C], "vision": uint8 [H, W, 3], "step": 17, "state": float [S]} -> action [T]

"state" is every task of values of the pack except "action", by its own name. A policy with memory has ``reset()``, which
is called before each episode; one that draws at random seeds itself there, or its own noise counts as change. Changes and
errors are in standard deviations of the demonstrated action, the mean over its components; one that never changes is 0.
"""

import importlib
import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from mvitac.data.pack import Pack
from mvitac.data.windows import places
from mvitac.evaluation.intervals import mean_interval
from mvitac.system.progress import work

Policy = Callable[[dict[str, Any]], Any]
LAG = 10
PLAUSIBLE = ("another episode", f"{LAG} frames ago")  # what a policy may have met: others may just surprise it
KINDS = ("mean frame", *PLAUSIBLE, "noise")
SMALL = 0.02  # standard deviations of the action; below this a policy does not react


@dataclass(frozen=True)
class Episodes:
    """Recorded episodes of a pack: rows in order, demonstrated actions [N, T], and what else a policy may read."""

    pack: Pack
    rows: list[np.ndarray]
    actions: np.ndarray
    more: dict[str, np.ndarray]

    @property
    def senses(self) -> tuple[str, ...]:
        return self.pack.spec.modalities[::-1]  # touch first

    def touched(self) -> np.ndarray:
        """bool [N]: column "contact" if there is one, else whether touch differs from the episode's first frame."""
        if "contact" in self.pack.table.column_names:
            return np.isin(self.pack.column("contact").astype(str), ("True", "true", "1", "1.0"))
        found = np.zeros(self.pack.num, bool)
        for rows in self.rows:
            images = self.pack.images["touch"][rows].astype(np.float32)
            found[rows] = np.abs(images - images[0]).mean((1, 2, 3)) > 3.0  # levels; noise of a sensor is 1 to 2
        return found


def read_episodes(pack: Pack) -> Episodes:
    """The episodes of ``pack``, its groups; ValueError if it has no task of values "action", no touch or one episode."""
    values = {task.name: pack.values(task) for task in pack.spec.values}
    if "action" not in values or "touch" not in pack.spec.modalities:
        raise ValueError(
            f"{pack.path} has no touch, or no values named action: pack it with --values action=a:mm,b:deg"
        )
    which = np.unique(pack.column("group").astype(str), return_inverse=True)[1]
    by = np.lexsort((places(pack, pack.spec.window)[1], which))
    rows = np.split(by, np.cumsum(np.bincount(which))[:-1])
    if len(rows) < 2:
        raise ValueError(f"{pack.path} has one episode: episodes are its groups, give at least two")
    return Episodes(pack, rows, values.pop("action"), values)


def open_policy(text: str) -> Policy:
    """The policy that ``text`` names: module:function, FILE.py:function, or the folder of a LeRobot policy."""
    if (Path(text) / "config.json").is_file():
        return lerobot_policy(Path(text))
    place, _, name = text.rpartition(":")
    if not place:
        raise ValueError(f"{text!r} is no policy: give module:function, FILE.py:function or a LeRobot policy's folder")
    module = runpy.run_path(place) if place.endswith(".py") else vars(importlib.import_module(place))
    if not callable(found := module.get(name)):
        raise ValueError(f"{place} has no function {name}")
    return found


def lerobot_policy(folder: Path) -> Policy:
    """A LeRobot policy with its own processors. Its cameras that are tactile by their name get touch, the others vision."""
    try:
        import torch
        from lerobot.configs.policies import PreTrainedConfig  # type: ignore[import-not-found]
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors  # type: ignore[import-not-found]
    except ImportError as error:
        raise ValueError(f"{folder} is a LeRobot policy, and lerobot cannot be imported ({error})") from None
    from mvitac.datasets.lerobot.reader import FELT

    kind = PreTrainedConfig.from_pretrained(folder).type
    policy = get_policy_class(kind).from_pretrained(folder).eval()
    before, after = make_pre_post_processors(policy.config, str(folder))

    @torch.no_grad()
    def act(observation: dict[str, Any]) -> np.ndarray:
        batch: dict[str, Any] = {"task": ""}
        for key in policy.config.image_features:
            image = observation["touch" if FELT.search(key) else "vision"]
            batch[key] = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None] / 255
        if "observation.state" in policy.config.input_features:
            batch["observation.state"] = torch.from_numpy(np.float32(observation["state"]))[None]
        return after(policy.select_action(before(batch)))[0].cpu().numpy()

    def reset() -> None:
        torch.manual_seed(0)  # a policy that samples draws the same with and without a replacement
        policy.reset()

    act.reset = reset  # type: ignore[attr-defined]
    return act


def act(policy: Policy, episodes: Episodes, sense: str = "", kind: str = "") -> np.ndarray:
    """Actions [N, T] of ``policy`` in every row, with ``sense`` replaced by ``kind`` of ``KINDS``."""
    found, images = np.zeros(episodes.actions.shape), episodes.pack.images
    mean, spread = _moments(images[sense], episodes.rows) if kind in ("mean frame", "noise") else (np.zeros(0),) * 2
    for number, rows in enumerate(episodes.rows):
        getattr(policy, "reset", lambda: None)()
        other = episodes.rows[(number + 1) % len(episodes.rows)]
        rng = np.random.default_rng([0xAB1A7E, number])
        for step, row in enumerate(rows):
            observation: dict[str, Any] = {key: values[row] for key, values in episodes.more.items()}
            observation |= {"step": step, **{each: images[each][row] for each in episodes.senses}}
            if kind == "mean frame":
                observation[sense] = (mean + 0.5).astype(np.uint8)
            elif kind == "another episode":
                observation[sense] = images[sense][other[min(step, len(other) - 1)]]
            elif kind == "noise":
                levels = mean.mean((0, 1)) + spread * rng.standard_normal(mean.shape)
                observation[sense] = np.clip(levels, 0, 255).astype(np.uint8)
            elif kind:
                observation[sense] = images[sense][rows[max(0, step - LAG)]]
            action = np.asarray(policy(observation), float).ravel()
            if action.shape != found[row].shape:
                raise ValueError(f"the policy gives {len(action)} numbers, episodes have actions of {len(found[row])}")
            found[row] = action
    return found


def _moments(images: Any, episodes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The mean frame [H, W, C], and the standard deviation [C] of all pixels, read episode by episode."""
    num, total, square = 0, np.zeros(images.shape[1:]), np.zeros(images.shape[-1])
    for rows in episodes:
        part = np.asarray(images[rows], np.float64)
        num, total, square = num + len(rows), total + part.sum(0), square + (part**2).mean((1, 2)).sum(0)
    mean = total / num
    return mean, np.sqrt(square / num - mean.mean((0, 1)) ** 2)


def ablate(policy: Policy, episodes: Episodes) -> dict[str, Any]:
    """What changes with each replacement of each sense, JSON-ready: {"error", "rows": [...], "verdicts": {sense: ...}}."""
    wanted = episodes.actions
    still = np.nanmax(wanted, axis=0) == np.nanmin(wanted, axis=0)
    scale = np.where(still, np.inf, np.nanstd(wanted, axis=0))
    kept = [rows[np.isfinite(wanted[rows]).all(1)] for rows in episodes.rows]
    parts, rows = _parts(episodes, kept), []
    with work("acting", 1 + len(episodes.senses) * len(KINDS), "times") as advance:
        normal = act(policy, episodes)
        advance()
        own = (np.abs(normal - wanted) / scale).mean(1)
        for sense, kind in ((sense, kind) for sense in episodes.senses for kind in KINDS):
            changed = act(policy, episodes, sense, kind)
            advance()
            change = (np.abs(changed - normal) / scale).mean(1)
            worse = (np.abs(changed - wanted) / scale).mean(1) - own
            of = {part: _paired(worse, each) for part, each in parts.items()}
            paired = {"change": _paired(change, kept), "error": _paired(worse, kept), "parts": of}
            rows.append({"sense": sense, "kind": kind, **paired})
    found = {sense: verdict(sense, [row for row in rows if row["sense"] == sense]) for sense in episodes.senses}
    return {"episodes": len(kept), "error": _paired(own, kept)[:3], "rows": rows, "verdicts": found}


def _parts(episodes: Episodes, kept: Sequence[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """Parts of the episodes -> their rows: thirds of the time, and with and without contact."""
    touched = episodes.touched()
    thirds = [np.array_split(rows, 3) for rows in kept]
    found = {name: [third[i] for third in thirds] for i, name in enumerate(("first third", "second", "last"))}
    found["in contact"] = [rows[touched[rows]] for rows in kept]
    found["no contact"] = [rows[~touched[rows]] for rows in kept]
    return {name: parts for name, parts in found.items() if sum(map(bool, map(len, parts))) > 1}


def _paired(values: np.ndarray, episodes: Sequence[np.ndarray]) -> list[float]:
    """Mean over episodes, ends of the 95 % interval, p."""
    return list(mean_interval(np.array([[values[rows].mean() for rows in episodes if len(rows)]])))


def verdict(sense: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """One sentence: whether the policy uses ``sense``. p is corrected for the number of plausible replacements."""
    for row in rows:
        mean, p = row["error"][0], row["error"][3] * len(PLAUSIBLE)
        if row["kind"] in PLAUSIBLE and mean > 0 and p < 0.05:
            size = f"by {mean:.2g} with it replaced by {row['kind']} (p {p:.2g})"
            return f"The policy uses {sense}: its error grows {size}."
    if max(row["change"][2] for row in rows) < SMALL:
        return f"The policy does not use {sense}: no replacement changes its action by {SMALL} standard deviations."
    return f"Cannot tell whether the policy uses {sense}: its action changes, its error does not grow beyond chance."


def report(result: Mapping[str, Any]) -> str:
    """The result as text."""
    head = ["replaced", "by", "change of action", "change of error", "p", *result["rows"][0]["parts"]]
    lines = []
    for row in result["rows"]:
        change, worse = (f"{v[0]:.2f} [{v[1]:.2f}, {v[2]:.2f}]" for v in (row["change"], row["error"]))
        parts = [f"{value[0]:+.2f}" for value in row["parts"].values()]
        lines.append([row["sense"], row["kind"], change, worse, f"{row['error'][3]:.2g}", *parts])
    error = "{:.2f} [{:.2f}, {:.2f}]".format(*result["error"])
    about = f"{result['episodes']} episodes, error {error}, in standard deviations of the action"
    return "\n".join([about, tabulate(lines, head), *result["verdicts"].values()])
