"""Does a policy use touch? Replace what it feels (or sees), and compare what it does, and how well.

A policy is a function of an observation, called for each step of an episode in order:

    {"touch": uint8 [H, W, C], "vision": uint8 [H, W, 3], "step": 17, "state": float [S]} -> action [T]

"state" is every task of values of a pack except "action", by its own name; in a suite the way in mm, or the hand's x and
turn. A policy with memory has ``reset()``, which is called before each episode; one that draws at random seeds itself
there, or its own noise counts as change.

Changes are in standard deviations of the action, the mean over its components; one that never changes is 0. The error in
recorded episodes is the distance to the demonstrated action, in the same unit; in those of a suite what an episode lost.
"""

import copy
import runpy
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import torch
from tabulate import tabulate

from mvitac.control.learn import encoding, pixels, ridge
from mvitac.control.suite import OWN
from mvitac.data.pack import Pack
from mvitac.data.windows import places, recordings
from mvitac.datasets.lerobot import FELT
from mvitac.deploy.artifact import load
from mvitac.evaluation.intervals import interval, least_p, mean_interval
from mvitac.registry import check_known
from mvitac.system.files import brief
from mvitac.system.progress import work

Policy = Callable[[dict[str, Any]], Any]
Watch = Callable[[Any, dict[str, Any]], None]
LAG = 10
PLAUSIBLE = ("another episode", f"{LAG} frames ago")  # what a policy may have met: others may just surprise it
KINDS = ("mean frame", *PLAUSIBLE, "noise")
SMALL = 0.02  # standard deviations of the action; below this a policy does not react
SAME = 1e-3  # standard deviations by which answers to the same images may differ, as a GPU's do
MOST = 1e60  # below which lie actions: their squares, in any unit, are finite
FRAMES = 200  # read at a time


@dataclass
class Episodes:
    """Episodes to act in: each is begun as a world (``control.suite``)."""

    begin: Sequence[Callable[[], Any]]
    senses: tuple[str, ...]
    images: dict[str, Any] = field(default_factory=dict)  # by sense: all that is seen without replacement, and
    rows: Sequence[np.ndarray] = ()  # those of each episode; of a suite, ``ablate`` fills both in
    actions: np.ndarray | None = None  # demonstrated, [N, T], episode after episode
    touched: np.ndarray | None = None  # bool [N]
    unit: str = "standard deviations of the action"  # of the error
    of: str = ""  # which ones of the data they are


class Recorded:
    """An episode of a pack as a world: what a policy does changes nothing."""

    loss = 0.0

    def __init__(self, pack: Pack, rows: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        self.pack, self.rows, self.all, self.steps = pack, rows, values, 0
        self.senses = pack.spec.modalities[::-1]  # touch first

    @property
    def values(self) -> dict[str, np.ndarray]:
        return {key: values[self.rows[self.steps]] for key, values in self.all.items()}

    @property
    def over(self) -> bool:
        return self.steps == len(self.rows)

    def look(self, sense: str) -> np.ndarray:
        return self.pack.images[sense][self.rows[self.steps]]

    def step(self, action: np.ndarray) -> None:
        self.steps += 1


def read_episodes(pack: Pack) -> Episodes:
    """Episodes are the recordings of ``pack`` (column touch_group, else group), of split test if it has two.

    ValueError without touch, action or two of them, or if two rows of one have the same place in it.
    """
    values = {task.name: pack.values(task) for task in pack.spec.values}
    if "action" not in values or "touch" not in pack.spec.modalities:
        raise ValueError(f"{pack.path} has no touch, or no values named action: pack with --values action=a:mm,b:deg")
    for sense in pack.spec.modalities:
        if not (there := pack.has(sense)).all():  # it would be black, which no policy can use
            raise ValueError(f"{pack.path}: {(~there).sum()} rows have no {sense}: pack them without --allow-missing")
    least, most = np.fmin.reduce(values["action"]), np.fmax.reduce(values["action"])
    if not (least < most).any():
        raise ValueError(f"{pack.path}: values action never change, so no policy can be told from another")
    rows = list(recordings(pack, places(pack, pack.spec.window)[1]))
    unseen = [each for each in rows if (pack.column("split")[each] == "test").all()]
    of, rows = (" of split test", unseen) if len(unseen) > 1 else ("", rows)
    if len(rows) < 2:
        raise ValueError(f"{pack.path} has one episode: episodes are its touch groups, give at least two")
    actions = values.pop("action")[np.concatenate(rows)]
    begin = [partial(Recorded, pack, each, values) for each in rows]
    return Episodes(begin, begin[0]().senses, pack.images, rows, actions, _touched(pack, rows), of=of)


def _touched(pack: Pack, rows: Sequence[np.ndarray]) -> np.ndarray:
    """bool [N]: column "contact" if there is one, else whether touch differs from the episode's first frame."""
    if "contact" in pack.table.column_names:
        said = np.char.lower(pack.column("contact").astype(str))[np.concatenate(rows)]
        yes, no = np.isin(said, ("true", "yes", "1", "1.0")), np.isin(said, ("false", "no", "0", "0.0"))
        if len(other := said[~(yes | no)]):
            raise ValueError(f"{pack.path}: column contact has {str(other[0])!r}: give yes or no in every row")
        return yes
    touches = (pack.images["touch"][each].astype(np.float32) for each in rows)
    change = [np.abs(images - images[0]).mean((1, 2, 3)) for images in touches]
    return np.concatenate(change) > 3.0  # levels; noise of a sensor is 1 to 2


def suite_episodes(suite: Any, cell: tuple[str, ...]) -> Episodes:
    check_known(f"task and condition of {suite.name}", ["/".join(cell)], [*map("/".join, suite.cells(OWN))])
    begin = [partial(suite.world, *cell, number) for number in range(suite.num)]
    return Episodes(begin, begin[0]().senses, unit=suite.failure)


def suite_policy(suite: Any, cell: tuple[str, ...], text: str) -> Policy:
    """A policy that ``open_policy`` takes; or that of an encoder, or of "pixels", which learns as rows of the suite do."""
    code = text.endswith(".py") or (":" in text and not text.startswith("external:"))
    if code or (Path(text) / "config.json").is_file():
        return open_policy(text)
    learn = ridge(pixels if text == "pixels" else encoding(load(text)))
    estimate, world = learn(*suite.taught(suite.lesson(cell))), suite.world(*cell, 0)
    return lambda given: world.answer(estimate(lambda sense: given[sense][None])[0])


def open_policy(text: str) -> Policy:
    """The policy that ``text`` names: FILE.py:function, or the folder of a LeRobot policy."""
    if (Path(text) / "config.json").is_file():
        return lerobot_policy(Path(text))
    file, _, name = text.rpartition(":")
    if not file.endswith(".py"):
        raise ValueError(f"{text!r} is no policy: give FILE.py:function or a LeRobot policy's folder")
    try:
        found = runpy.run_path(file)
    except (Exception, SystemExit) as error:  # whatever the owner's code raises
        raise ValueError(f"{text} cannot be imported ({type(error).__name__}: {brief(error)})") from None
    if not callable(found.get(name)):
        raise ValueError(f"{file} has no function {name!r}")
    return found[name]


def lerobot_policy(folder: Path) -> Policy:
    """A LeRobot policy with its own processors. Its cameras that are tactile by their name get touch, the others vision."""
    try:
        from lerobot.configs.policies import PreTrainedConfig  # type: ignore[import-not-found]
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors  # type: ignore[import-not-found]
    except ImportError as error:
        raise ValueError(f"{folder} is a LeRobot policy, and lerobot cannot be imported ({error})") from None
    policy = get_policy_class(PreTrainedConfig.from_pretrained(folder).type).from_pretrained(folder).eval()
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


def act(
    policy: Policy | None, episodes: Episodes, sense: str = "", kind: str = "", watch: Watch | None = None
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Actions [N, T] of every step with ``sense`` replaced by ``kind``, what its episode lost [N], steps of each episode.

    Without a policy, of one that knows the truth. ``watch`` is called in each step, before the action.
    """
    replaced = replacement(kind, episodes.images[sense], episodes.rows) if kind else None
    actions, losses, lengths = [], [], []
    for number, begin in enumerate(episodes.begin):
        _given(getattr(policy, "reset", lambda: None), f"when reset before episode {number + 1}")
        world, seen, step = begin(), deque(maxlen=LAG + 1), 0
        while not world.over:
            given = {**getattr(world, "values", {}), "step": step, **{each: world.look(each) for each in world.senses}}
            given = copy.deepcopy(given)  # a task, a policy and a step may each fill one buffer again and again
            if replaced:
                seen.append(given[sense])
                given[sense] = replaced(number, step, seen[0])
            if watch:
                watch(world, given)
            action = _action(policy, given, number) if policy else np.ravel(world.answer(world.known))
            width = len(world.most) if episodes.actions is None else episodes.actions.shape[1]
            if len(action) != width:
                raise ValueError(f"the policy gives {len(action)} numbers, episodes have actions of {width}")
            actions.append(action)
            world.step(action.copy())
            step += 1
        if not step or not np.isfinite(world.loss):
            raise ValueError(f"episode {number + 1} has {f'a loss of {world.loss}' if step else 'no step'}")
        losses += [world.loss] * step
        lengths.append(step)
    return np.stack(actions), np.array(losses), np.split(np.arange(len(losses)), np.cumsum(lengths)[:-1])


def _action(policy: Policy, given: dict[str, Any], number: int) -> np.ndarray:
    """What ``policy`` answers [T]; ValueError if that is not finite numbers, or it raises anything."""
    place = f"in step {given['step']} of episode {number + 1}"
    own = copy.deepcopy(given)  # which it may change in place
    action = _given(lambda: np.array(policy(own), float).ravel(), place)
    if not (np.abs(action) < MOST).all():
        raise ValueError(f"the policy gives {action} {place}: give finite numbers below {MOST:g}")
    return action


def _given(call: Callable[[], Any], place: str) -> Any:
    try:
        return call()
    except (Exception, SystemExit) as error:  # whatever the owner's code raises
        raise ValueError(f"the policy fails ({type(error).__name__}: {brief(error)}) {place}") from None


def replacement(kind: str, images: Any, rows: Sequence[np.ndarray]) -> Callable[[int, int, np.ndarray], np.ndarray]:
    """What replaces an image: a function of the episode's number, its step, and the image of ``LAG`` steps ago."""
    every = np.sort(np.concatenate(rows))
    total, squares = 0.0, 0.0
    for part in np.array_split(every, -(-len(every) // FRAMES)):
        found = np.asarray(images[part], np.float64)
        total, squares = total + found.sum(0), squares + (found**2).mean((1, 2)).sum(0)
    mean: Any = total / len(every)
    spread = np.sqrt(np.maximum(squares / len(every) - mean.mean((0, 1)) ** 2, 0))

    def give(number: int, step: int, ago: np.ndarray) -> np.ndarray:
        if kind == "mean frame":
            return (mean + 0.5).astype(np.uint8)
        if kind == "another episode":
            other = rows[(number + 1) % len(rows)]
            return images[other[min(step, len(other) - 1)]]
        if kind == "noise":
            drawn = np.random.default_rng([0xAB1A7E, number, step]).standard_normal(mean.shape)
            return np.clip(mean.mean((0, 1)) + spread * drawn, 0, 255).astype(np.uint8)
        return ago

    return give


def ablate(policy: Policy, episodes: Episodes) -> dict[str, Any]:
    """What changes with each replacement of each sense, JSON-ready: {"error", "rows": [...], "verdicts": {sense: ...}}."""
    seen: dict[str, list[np.ndarray]] = {sense: [] for sense in episodes.senses}

    def keep(world: Any, given: dict[str, Any]) -> None:
        for sense in seen:
            seen[sense].append(given[sense])

    rows: list[dict[str, Any]] = []
    with work("acting", 1 + len(episodes.senses) * len(KINDS), "times") as advance:
        normal, own, steps = act(policy, episodes, watch=keep if episodes.actions is None else None)
        advance()
        if episodes.actions is None:  # also where they are of another policy
            episodes.images, episodes.rows = {sense: np.stack(images) for sense, images in seen.items()}, steps
        wanted = normal if episodes.actions is None else episodes.actions
        scale = np.where(np.nanmax(wanted, axis=0) == np.nanmin(wanted, axis=0), np.inf, np.nanstd(wanted, axis=0))
        kept = [each[np.isfinite(wanted[each]).all(1)] for each in steps]
        parts = _parts(episodes.touched, kept)
        if episodes.actions is not None:
            own = away(normal, wanted, scale)
        for sense, kind in ((sense, kind) for sense in episodes.senses for kind in KINDS):
            changed, lost, there = act(policy, episodes, sense, kind)
            advance()
            # Of an episode that ends earlier then, its last step stands for those after it.
            pairs = zip(steps, there, strict=True)
            same = np.concatenate([each[np.minimum(np.arange(len(one)), len(each) - 1)] for one, each in pairs])
            changed, lost = changed[same], lost[same]
            both = [each[: len(other)] for each, other in zip(kept, there, strict=True)]
            worse = (lost if episodes.actions is None else away(changed, wanted, scale)) - own
            of = {part: _paired(worse, each) for part, each in parts.items()}
            paired = {"change": _paired(away(changed, normal, scale), both), "error": _paired(worse, kept), "parts": of}
            rows.append({"sense": sense, "kind": kind, **paired})
        again, *_ = act(policy, episodes)  # last: what a policy keeps adds up
    if again.shape != normal.shape or away(again, normal, scale).max() > SAME:
        raise ValueError("the policy acts differently on the same episodes: give it reset(), and seed what it draws")
    found = {s: verdict(s, [row for row in rows if row["sense"] == s], len(kept)) for s in episodes.senses}
    error = np.maximum(_paired(own, kept, level=True)[:3], 0).tolist()
    if episodes.unit == "failures":  # 0 or 1 of each episode
        error = list(interval([{"group_sizes": [1] * len(kept), "group_correct": [own[each[0]] for each in kept]}]))
    about = {"episodes": len(kept), "of": episodes.of, "unit": episodes.unit, "error": error}
    return {**about, "rows": rows, "verdicts": found}


def away(actions: np.ndarray, others: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return (np.abs(actions - others) / scale).mean(1)


def _parts(touched: np.ndarray | None, kept: Sequence[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """Parts of recorded episodes -> their steps: thirds of the time, and with and without contact."""
    if touched is None:
        return {}
    thirds = [np.array_split(steps, 3) for steps in kept]
    found = {name: [third[i] for third in thirds] for i, name in enumerate(("first third", "second", "last"))}
    found["in contact"] = [steps[touched[steps]] for steps in kept]
    found["no contact"] = [steps[~touched[steps]] for steps in kept]
    return {name: parts for name, parts in found.items() if sum(map(bool, map(len, parts))) > 1}


def _paired(values: np.ndarray, episodes: Sequence[np.ndarray], *, level: bool = False) -> list[float]:
    """Mean over episodes, ends of the 95 % interval, p."""
    return list(mean_interval(np.array([[values[steps].mean() for steps in episodes if len(steps)]]), level=level))


def verdict(sense: str, rows: Sequence[Mapping[str, Any]], num: int) -> str:
    """One sentence: whether the policy uses ``sense``. p is corrected for the number of plausible replacements. Of ``num``
    episodes under seven no p is small enough."""
    for row in rows:
        mean, p = row["error"][0], row["error"][3] * len(PLAUSIBLE)
        if row["kind"] in PLAUSIBLE and mean > 0 and p < 0.05:
            size = f"by {mean:.2g} with it replaced by {row['kind']} (corrected p {p:.2g})"
            return f"The policy uses {sense}: its error grows {size}."
    if max(row["change"][2] for row in rows) < SMALL:
        return f"The policy does not use {sense}: no replacement changes its action by {SMALL} standard deviations."
    if least_p(num) * len(PLAUSIBLE) >= 0.05:
        return f"Cannot tell whether the policy uses {sense}: {num} episodes are too few."
    return f"Cannot tell whether the policy uses {sense}: its action changes, its error does not grow beyond chance."


def report(result: Mapping[str, Any]) -> str:
    rows, text = result["rows"], "{0:.2f} [{1:.2f}, {2:.2f}]".format
    lines = [[r["sense"], r["kind"], text(*r["change"]), text(*r["error"]), f"{r['error'][3]:.2g}"] for r in rows]
    about = [f"{result['episodes']} episodes{result['of']}, error {text(*result['error'])}, in {result['unit']}"]
    about += [tabulate(lines, ["replaced", "by", "change of action", "change of error", "p"], disable_numparse=True)]
    if of := [*rows[0]["parts"]]:
        parts = [[r["sense"], r["kind"], *(f"{v[0]:+.2f}" for v in r["parts"].values())] for r in rows]
        about += ["Change of error in parts:", tabulate(parts, ["replaced", "by", *of], disable_numparse=True)]
    return "\n".join([*about, *(fill(text, 80) for text in result["verdicts"].values())])
