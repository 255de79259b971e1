"""``--data calandra``: grasps of "The Feeling of Success" (Calandra et al., CoRL 2017) from the published HDF5 shards.

    <path>/calandra_corl2017_000.h5 ... calandra_corl2017_037.h5       any of the 38
      /data/i0 ... /data/i249                                          one grasp each; 46 in the last shard
          attributes  is_gripping (bool), object_name (bytes)
          gelsightA_<phase>, gelsightB_<phase>   uint8 [960, 1280, 3]   phase: before, during, after
          kinectA_rgb_<phase>                    uint8 [540, 960, 3]

'before' is taken with open fingers, 'during' with closed fingers before the lift, and 'after' 4 s after the lift
attempt, when the outcome is visible. Only phases in ``ask`` are labelled, so 'after' cannot be probed by mistake.

Sources: the owners' scripts (github.com/robertocalandra/the-feeling-of-success) for name repairs and the split
by object; the authors' notebook (github.com/ligerfotis/mvitac, create_dataset.ipynb) for their 32 and 8 objects.
"""

import math
import random
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from mvitac.data.images import MAX_PIXELS
from mvitac.data.source import Sample, Source, one_stamp, stamp_of
from mvitac.data.spec import PHASES, DataSpec, Task
from mvitac.datasets.base import KEEPING, DatasetConfig
from mvitac.registry import check_known, check_range, to_json
from mvitac.system.files import brief, check_ordinary, digest

VERSION = 1  # version of this reader. Increase it when the same shards would give another pack.
Phase = Literal["before", "during", "after"]
NUM_SHARDS = 38
SHARD = re.compile(r"calandra_corl2017_\d{3}\.h5")

_CLASSES = ("failure", "success")
TASKS = {
    "during": Task(name="success", classes=_CLASSES, only={"phase": "during"}),
    "before": Task(name="success_before", classes=_CLASSES, only={"phase": "before"}),
    "after": Task(name="success_after_leaks", classes=_CLASSES, only={"phase": "after"}),
    "authors": Task(name="success_trained_with_after", classes=_CLASSES),
}
Ask = Literal["during", "before", "after", "authors"]

_TEST = """international_travel_adapter 3d_printed_blue_connector soft_zebra fake_flower_in_pot metal_can french_dip
metal_cylinder_with_holes soft_beer_bottle_holder"""
_TRAIN = """cinnamon potato aspirin red_turtle happy_fall_stone monster_truck soft_red_cube lime ogx_shampoo peanut_butter
chocolate_shake webcam_box rubics_cube muffin red_bull purple_small_plastic_fruit onion soft_blue_hexagon plastic_cow
fox_head small_coffe_cup lemon red_apple 3d_printed_white_ball set_small_plastic_men_police_man dog_toy_ice_cream_cone
playdoh_container bandaid_box emergency_stop_button_for_sawyer plastic_duck brown_paper_cup_2_upside mentos_gum_can"""
AUTHORS_TEST, AUTHORS_TRAIN = tuple(_TEST.split()), tuple(_TRAIN.split())
"""The paper's 40 most attempted objects as listed by its authors (in their spelling)."""

REPAIRS = {
    "plastic_duc": "plastic_duck",
    "hair_dryer_": "hair_dryer_spiky_nozzle",
    "light_blue_": "light_blue_translucent_object",
    "brown_paper": "brown_paper_bag",
    "beans_in_pa": "beans_in_paper_container",
    "shampoo_whi": "shampoo_white_bottle",
    "small_blue_": "small_blue_plastic_spoon",
    "dove_deodor": "dove_deodorant",
    "yellow_bulb": "yellow_bulb_man",
    "toy_person_with_hat": "set_small_plastic_men_yellow_construction_worker",
}
"""Wrong name in some recordings (cut to 11 letters, or another word) -> object, from the owners' scripts."""


def repaired(name: bytes | str) -> str:
    """Return the name in an attribute object_name, repaired."""
    text = (name if isinstance(name, bytes) else str(name).encode()).decode().strip(" \0\n\r\t")
    if not text:
        raise ValueError("object_name is empty")
    return REPAIRS.get(text, text)


def owners_shuffle(names: Sequence[str], seed: int) -> list[str]:
    """Shuffle sorted ``names`` like the owners' script: Python 2's random.shuffle after random.seed(seed)."""
    shuffled, generator = sorted(names), random.Random(seed)
    for i in reversed(range(1, len(shuffled))):
        j = int(generator.random() * (i + 1))
        shuffled[i], shuffled[j] = shuffled[j], shuffled[i]
    return shuffled


@dataclass(frozen=True, kw_only=True)
class CalandraConfig(DatasetConfig):
    """Grasps of about 106 objects with two GelSights (stacked, 6 channels) and a Kinect, labelled by success."""

    name: ClassVar[str] = "calandra"
    phased: ClassVar[bool | None] = True

    path: Path = Path("data/calandra")
    """Folder with some or all of the shards calandra_corl2017_000.h5 to _037.h5."""
    split: str = "authors"
    """authors: the 32 training and 8 test objects of the paper's authors. object: the owners' split, 75 % of all objects
    in train and 25 % in test, by split_seed."""
    split_seed: int = 0
    """Random seed for the splits of objects (object) and for the choice of val."""
    val_share: float = 0.15
    """Fraction of the training objects in the validation split; the authors and the owners have none."""
    ask: tuple[Ask, ...] = ("during",)
    """Tasks to probe. during: success (the paper). before: success_before. after: success_after_leaks, which shows the
    outcome. authors: success_trained_with_after, their protocol (train on all phases, choose and test on 'during')."""
    phases: tuple[Phase, ...] = PHASES
    """Phases that become rows. All of them are used for pre-training."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_known("split", [self.split], ("authors", "object"))
        check_range(self, 0, 0.9, "val_share")
        check_range(self, 0, math.inf, "split_seed")
        for asked in self.ask:
            if (needed := "during" if asked == "authors" else asked) not in self.phases:
                raise ValueError(f"ask {asked}: phases leaves {needed!r} out, add it")

    def source(self) -> Source:
        return Calandra(self)


@dataclass(frozen=True)
class Grasp:
    """Metadata of one grasp; ``damage`` is the reason if it cannot be read, else ""."""

    file: Path
    shard: int
    index: int
    object: str = ""
    gripping: bool = False
    damage: str = ""


class Calandra(Source):
    """One item is one grasp, sorted by shard and number. Names and outcomes are read first, images by ``read``."""

    def __init__(self, config: CalandraConfig) -> None:
        self.config = config
        if not (shards := sorted(file for file in config.path.glob("*.h5") if SHARD.fullmatch(file.name))):
            raise ValueError(f"{config.path} has no calandra_corl2017_NNN.h5: download some (doi 10.25532/OPARA-700)")
        self._files = {file: one_stamp([stamp_of(str(file))]) for file in shards}
        everything = [grasp for file in self._files for grasp in list_grasps(file)]
        self._splits = split_objects(config, sorted({grasp.object for grasp in everything if not grasp.damage}))
        # Objects that the split leaves out are not read; damaged grasps are kept, to be listed.
        self._grasps = [grasp for grasp in everything if grasp.damage or grasp.object in self._splits]

    def spec(self) -> DataSpec:
        return DataSpec(
            name=f"calandra ({self.config.split}{', partial' if len(self._files) < NUM_SHARDS else ''})",
            vision_channels=3,
            touch_channels=6,
            tasks=tuple(TASKS[asked] for asked in self.config.ask),
            group_by="object",
            licence="CC BY-NC-ND 4.0 (stated by a second source)",
            source="Calandra et al., The Feeling of Success, doi 10.25532/OPARA-700",
        )

    def items(self) -> list[str]:
        return [f"{grasp.file.name} i{grasp.index}" for grasp in self._grasps]

    def fingerprint(self) -> dict[str, Any]:
        known = [[g.shard, g.index, g.object, g.gripping, bool(g.damage)] for g in self._grasps]
        options = {k: v for k, v in to_json(self.config).items() if k not in ("path", *KEEPING)}
        files = [file.name for file in self._files]
        return {"reader": f"calandra {VERSION}", "files": files, "grasps": digest(known), "options": options}

    def stamps(self) -> list[int]:
        return [self._files[grasp.file] for grasp in self._grasps]

    def samples_per_item(self) -> list[int]:
        return [len(self.config.phases)] * len(self._grasps)

    def read(self, item: int) -> list[Sample]:
        import h5py

        grasp, samples = self._grasps[item], []
        if grasp.damage:
            raise ValueError(grasp.damage)
        split = self._splits[grasp.object]
        where = f"{grasp.shard:03d}-{grasp.index:03d}"
        with h5py.File(grasp.file) as file:
            for phase in (phase for phase in PHASES if phase in self.config.phases):
                names = (f"data/i{grasp.index}/{name}_{phase}" for name in ("gelsightA", "gelsightB", "kinectA_rgb"))
                left, right, vision = (_image(file, name) for name in names)
                if left.shape != right.shape:
                    raise ValueError(f"the gels of {phase} are of {left.shape[:2]} and {right.shape[:2]} pixels")
                labelled = {phase, "authors"} if phase == "during" or split == "train" else {phase}
                outcome = int(grasp.gripping)
                labels = {f"label_{TASKS[a].name}": outcome if a in labelled else -1 for a in self.config.ask}
                known = {"id": f"{where}-{phase}", "group": grasp.object, "touch_group": where, "split": split}
                columns = {**known, **labels, "phase": phase, "outcome": outcome, "shard": grasp.shard}
                # One element of three bytes per pixel: five times as fast as by channel.
                both = np.concatenate([left.view("V3"), right.view("V3")], axis=2).view(np.uint8)
                samples.append(Sample(vision=vision, touch=both, columns=columns))
        return samples


def list_grasps(file: Path) -> list[Grasp]:
    import h5py

    try:
        check_ordinary(file)  # a pipe never ends
        with h5py.File(file) as opened:
            indices = sorted(int(name[1:]) for name in _within(opened, "data") if re.fullmatch(r"i\d+", name))
            return [_describe(opened, Grasp(file, int(file.stem[-3:]), index)) for index in indices]
    except (OSError, KeyError, RuntimeError, TypeError, ValueError) as error:  # h5py raises these for damaged files
        raise ValueError(f"{file} cannot be read ({brief(error)}): download it again, or remove it") from None


def _describe(file: Any, grasp: Grasp) -> Grasp:
    try:
        attributes = _within(file, f"data/i{grasp.index}").attrs
        name, gripping = (np.asarray(attributes[key]).item() for key in ("object_name", "is_gripping"))
        if gripping not in (0, 1):
            raise ValueError(f"is_gripping is {gripping!r}, not a bool")
        return replace(grasp, object=repaired(name), gripping=bool(gripping))
    except (OSError, KeyError, RuntimeError, TypeError, ValueError) as error:
        return replace(grasp, damage=f"attributes cannot be read ({brief(error)})")


def _within(file: Any, name: str) -> Any:
    """What is called ``name``; ValueError if it is a link, which may lead to another grasp, or into another file."""
    import h5py

    for path in accumulate(name.split("/"), "{}/{}".format):
        if isinstance(file.get(path, getlink=True), (h5py.SoftLink, h5py.ExternalLink)):
            raise ValueError(f"{path} is a link: copy what it shows into the file")
    return file[name]


def _image(file: Any, name: str) -> np.ndarray:
    try:
        data = _within(file, name)
        if (dtype := getattr(data, "dtype", None)) != np.uint8 or data.ndim != 3 or data.shape[2] != 3:
            raise ValueError(f"it is {dtype} {getattr(data, 'shape', None)}, not uint8 [H, W, 3]")
        if data.external or data.is_virtual:
            raise ValueError("it shows the content of other files")
        if (pixels := data.shape[0] * data.shape[1]) > MAX_PIXELS:
            raise ValueError(f"it has {pixels:,} pixels: at most {MAX_PIXELS:,} are read")
        return data[()]
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise ValueError(f"{name} cannot be read ({brief(error)})") from None


def split_objects(config: CalandraConfig, names: Sequence[str]) -> dict[str, str]:
    """Return object -> split, for the objects that are used. Val consists of objects taken from train."""
    if config.split == "authors":
        splits = {name: "train" for name in names if name in AUTHORS_TRAIN}
        splits |= {name: "test" for name in names if name in AUTHORS_TEST}
    else:
        shuffled = owners_shuffle(names, config.split_seed)
        splits = {name: "train" if i < int(0.75 * len(shuffled)) else "test" for i, name in enumerate(shuffled)}
    if not names:
        raise ValueError(f"{config.path} holds no grasp that can be read: see its files, or download them again")
    if not splits:
        raise ValueError(f"{config.path} holds none of the authors' 40 objects: use split object, or more shards")
    train = sorted(name for name, split in splits.items() if split == "train")
    num_val = round(config.val_share * len(train))
    chosen = np.random.default_rng([40, config.split_seed]).permutation(train)[:num_val].tolist()
    return splits | dict.fromkeys(chosen, "val")
