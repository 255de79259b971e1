"""Does a policy use touch? Replace what it feels (or sees) in recorded episodes, and compare what it does.

A policy is a function of an observation, called for each frame of an episode in order:

    {"touch": uint8 [H, W, C], "vision": uint8 [H, W, 3], "step": 17, "state": float [S]} -> action [T]

"state" is every task of values of the pack except "action", by its own name. A policy with memory has ``reset()``, which
is called before each episode. Changes and errors are in standard deviations of the demonstrated action, the mean over its
components, so that 1 is as large as what a policy does at all.
"""

import importlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from mvitac.data.pack import Pack
from mvitac.data.spec import ValueTask
from mvitac.data.windows import places
from mvitac.evaluation.intervals import mean_interval
from mvitac.system.progress import work

Policy = Callable[[dict[str, Any]], Any]
KINDS = ("mean frame", "another episode", "{} frames ago", "noise")
PLAUSIBLE = KINDS[
    1:3
]  # replacements that the policy may have seen in training: an effect of the others may be surprise
SMALL = 0.02  # standard deviations of the action; below this a policy does not react
LAG = 10


@dataclass(frozen=True)
class Episodes:
    """Recorded episodes of a pack: rows in order, demonstrated actions [N, T], and what else a policy may read."""

    pack: Pack
    rows: dict[str, np.ndarray]
    actions: np.ndarray
    more: dict[str, np.ndarray]

    @property
    def senses(self) -> tuple[str, ...]:
        return self.pack.spec.modalities[::-1]  # touch first

    def touched(self) -> np.ndarray:
        """bool [N]: column "contact" if there is one, else whether touch differs from the episode's first frame."""
        if "contact" in self.pack.table.column_names:
            return self.pack.column("contact").astype(float) > 0.5
        found = np.zeros(self.pack.num, bool)
        for rows in self.rows.values():
            images = self.pack.images["touch"][rows].astype(np.float32)
            found[rows] = np.abs(images - images[0]).mean((1, 2, 3)) > 3.0  # levels; noise of a sensor is 1 to 2
        return found


def read_episodes(pack: Pack) -> Episodes:
    """The episodes of ``pack``, its groups; ValueError if it has no task of values "action", no touch or one episode."""
    values = {task.name: task for task in pack.spec.values}
    action: ValueTask | None = values.pop("action", None)
    if action is None or "touch" not in pack.spec.modalities:
        raise ValueError(
            f"{pack.path} has no touch, or no values named action: pack it with --values action=a:mm,b:deg"
        )
    groups, order = pack.column("group").astype(str), places(pack, pack.spec.window)[1]
    rows = {name: np.flatnonzero(groups == name) for name in dict.fromkeys(groups.tolist())}
    rows = {name: found[np.argsort(order[found], kind="stable")] for name, found in rows.items()}
    if len(rows) < 2:
        raise ValueError(f"{pack.path} has one episode: episodes are its groups, give at least two")
    return Episodes(pack, rows, pack.values(action), {name: pack.values(task) for name, task in values.items()})


def open_policy(text: str) -> Policy:
    """The policy that ``text`` names: module:function, FILE.py:function, or the folder of a LeRobot policy."""
    if (Path(text) / "config.json").is_file():
        return lerobot_policy(Path(text))
    place, _, name = text.rpartition(":")
    if not place or not name.isidentifier():
        raise ValueError(f"{text!r} is no policy: give module:function, FILE.py:function or a LeRobot policy's folder")
    if place.endswith(".py"):
        spec = importlib.util.spec_from_file_location(Path(place).stem, place)
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        module = importlib.import_module(place)
    if not callable(found := getattr(module, name, None)):
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

    def act(observation: dict[str, Any]) -> np.ndarray:
        batch: dict[str, Any] = {"task": ""}
        for key in policy.config.image_features:
            image = observation["touch" if FELT.search(key) else "vision"]
            batch[key] = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None] / 255
        if "observation.state" in policy.config.input_features:
            batch["observation.state"] = torch.from_numpy(np.float32(observation["state"]))[None]
        with torch.no_grad():
            return after(policy.select_action(before(batch)))[0].cpu().numpy()

    act.reset = policy.reset  # type: ignore[attr-defined]
    return act


def act(policy: Policy, episodes: Episodes, sense: str = "", kind: str = "", lag: int = LAG) -> np.ndarray:
    """Actions [N, T] of ``policy`` in every row, with ``sense`` replaced by ``kind`` of ``KINDS``; NaN where no row is."""
    found = np.full(episodes.actions.shape, np.nan)
    names = list(episodes.rows)
    images, mean, spread = episodes.pack.images, np.zeros((1, 1, 3)), np.ones(3)
    if kind in ("mean frame", "noise"):
        every = np.concatenate([np.asarray(images[sense][rows], np.float32) for rows in episodes.rows.values()])
        mean, spread = every.mean(0), every.std((0, 1, 2))
    for number, rows in enumerate(episodes.rows.values()):
        if hasattr(policy, "reset"):
            policy.reset()  # type: ignore[attr-defined]
        other = episodes.rows[names[(number + 1) % len(names)]]
        rng = np.random.default_rng([0xAB1A7E, number])
        for step, row in enumerate(rows):
            observation: dict[str, Any] = {each: images[each][row] for each in episodes.senses}
            if kind == "mean frame":
                observation[sense] = (mean + 0.5).astype(np.uint8)
            elif kind == "another episode":
                observation[sense] = images[sense][other[min(step, len(other) - 1)]]
            elif kind == "noise":
                shape = observation[sense].shape
                observation[sense] = np.clip(mean.mean((0, 1)) + spread * rng.standard_normal(shape), 0, 255).astype(
                    "u1"
                )
            elif kind:
                observation[sense] = images[sense][rows[max(0, step - lag)]]
            observation |= {"step": step, **{key: values[row] for key, values in episodes.more.items()}}
            action = np.asarray(policy(observation), float).ravel()
            if action.shape != found[row].shape:
                raise ValueError(f"the policy gives {len(action)} numbers, episodes have actions of {len(found[row])}")
            found[row] = action
    return found


def ablate(policy: Policy, episodes: Episodes, lag: int = LAG) -> dict[str, Any]:
    """What changes with each replacement of each sense, JSON-ready: {"error", "rows": [...], "verdicts": {sense: ...}}."""
    wanted, scale = episodes.actions, np.nanstd(episodes.actions, axis=0) + 1e-12
    kept = [rows[np.isfinite(wanted[rows]).all(1)] for rows in episodes.rows.values()]
    parts = _parts(episodes, kept)
    with work("acting", 1 + len(episodes.senses) * len(KINDS), "times") as advance:
        normal = act(policy, episodes)
        advance()
        own = (np.abs(normal - wanted) / scale).mean(1)
        rows = []
        for sense in episodes.senses:
            for kind in KINDS:
                changed = act(policy, episodes, sense, kind, lag)
                advance()
                change = (np.abs(changed - normal) / scale).mean(1)
                worse = (np.abs(changed - wanted) / scale).mean(1) - own
                of = {part: _paired(worse, mask) for part, mask in parts.items()}
                row = {"sense": sense, "kind": kind.format(lag), "plausible": kind in PLAUSIBLE}
                rows.append({**row, "change": _paired(change, kept), "error": _paired(worse, kept), "parts": of})
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
    plausible = [row for row in rows if row["plausible"]]
    for row in plausible:
        if row["error"][0] > 0 and row["error"][3] * len(plausible) < 0.05:
            size = (
                f"by {row['error'][0]:.2g} with it replaced by {row['kind']} (p {row['error'][3] * len(plausible):.2g})"
            )
            return f"The policy uses {sense}: its error grows {size}."
    if max(row["change"][2] for row in rows) < SMALL:
        return f"The policy does not use {sense}: no replacement changes its action by {SMALL} standard deviations."
    return f"Cannot tell whether the policy uses {sense}: its action changes, its error does not grow beyond chance."


def report(result: Mapping[str, Any]) -> str:
    """The result as text."""
    head = ["replaced", "by", "change of action", "change of error", "p", *next(iter(result["rows"]))["parts"]]
    lines = []
    for row in result["rows"]:
        change, worse = (f"{v[0]:.2f} [{v[1]:.2f}, {v[2]:.2f}]" for v in (row["change"], row["error"]))
        parts = [f"{value[0]:+.2f}" for value in row["parts"].values()]
        lines.append([row["sense"], row["kind"], change, worse, f"{row['error'][3]:.2g}", *parts])
    mean, low, high = result["error"]
    about = (
        f"{result['episodes']} episodes, error {mean:.2f} [{low:.2f}, {high:.2f}], in standard deviations of the action"
    )
    return "\n".join([about, tabulate(lines, head), *result["verdicts"].values()])
