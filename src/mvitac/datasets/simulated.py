"""Simulated touches of materials and simulated grasps (``sim/``), split by instance and by object."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro

from mvitac.data.images import difference
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Target, Task, ValueTask
from mvitac.datasets.base import KEEPING, DatasetConfig
from mvitac.registry import check_known, check_range, to_json
from mvitac.sim import grasps, materials, measured
from mvitac.sim.sensors import NAMED, SENSORS, Sensor, random_sensors

LICENCE = "Apache-2.0 (made by this package)"
CONTACT = {"depth": ["depth_mm"], "position": ["contact_x_mm", "contact_y_mm"], "patch": ["patch_mm2"]}
"""Tasks of option ``contact`` and their columns."""


def value_task(name: str, columns: Sequence[str], **about: Any) -> ValueTask:
    """Return the task of columns that end in their unit."""
    units = {"n": "N", "mm": "mm", "mm2": "mm2"}
    targets = tuple(Target(name=column, unit=units[column.rpartition("_")[2]]) for column in columns)
    return ValueTask(name=name, targets=targets, **about)


@dataclass(frozen=True, kw_only=True)
class SimulatedConfig(DatasetConfig):
    names_a_place: ClassVar[bool] = False
    least: ClassVar[int] = 1

    num: int = 6000
    """Number of pairs (materials) or of grasps with three phases each (grasps)."""
    seed: int = 0
    """Random seed of all instances and objects."""
    size: int = 72
    """Side of the rendered and stored images in pixels."""
    held_out_sensor: bool = False
    """Use the sensor that is otherwise never used, to test transfer to a new sensor."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, self.least, 10_000_000, "num")
        check_range(self, 0, (1 << 63) - 1, "seed")

    def _fingerprint(self, version: int) -> dict[str, Any]:
        own = {key: value for key, value in to_json(self).items() if key == "size" or key not in KEEPING}
        return {"simulator": own.pop("name"), "version": version, **own}


@dataclass(frozen=True, kw_only=True)
class PressConfig(SimulatedConfig):
    difference: Annotated[bool, tyro.conf.arg(name="subtract-background")] = False
    """Store (touch - background) / 2 + 128, with the background of the same sensor; no contact is mid-gray."""
    makes: tuple[str, ...] = ()
    """Sensors to press with (mvitac.sim.sensors; gelsight, gelsight_mini: real gels). Default: all not held out."""
    sensors: int = 0
    """Press with this many sensors drawn at random (palette, LED directions, dots, response), and with --makes if given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 0, 10_000, "sensors")
        check_known("sensor", self.makes, NAMED)
        if self.held_out_sensor and (self.makes or self.sensors):
            raise ValueError("held_out_sensor presses with that sensor alone: leave out makes and sensors")

    def choice(self) -> tuple[Sensor, ...]:
        """The sensors that a touch chooses from."""
        if self.sensors or self.makes:
            return (*random_sensors(self.seed, self.sensors), *(NAMED[name] for name in self.makes))
        return tuple(s for s in SENSORS.values() if s.held_out == self.held_out_sensor)

    def check_installed(self) -> None:
        """ValueError where taxim is asked for and missing; here, and not in each worker."""
        for sensor in self.choice():
            if sensor.calibration:
                measured.folder(sensor.calibration)


@dataclass(frozen=True, kw_only=True)
class MaterialsConfig(PressConfig):
    """Simulated touches of 20 material classes, labelled by category, hard/soft and rough/smooth; split by instance."""

    name: ClassVar[str] = "materials"
    phased: ClassVar[bool | None] = False

    touches: int = 5
    """Touches per instance, each with its own position, force, sensor and lamp."""
    contact: bool = False
    """Also measure depth, position and size of the contact, as tasks with values."""
    sensors_per_press: int = 1
    """Rows per touch: the same spot pressed with so many different sensors (for lambda_sensor)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 1, math.inf, "touches")
        check_range(self, 1, len(self.choice()), "sensors_per_press")

    def source(self) -> Source:
        self.check_installed()
        return Materials(self)


class Materials(Source):
    """Item i is touch (i // 20) % touches of instance i // (20 touches) of class i % 20: a larger num only appends."""

    def __init__(self, config: MaterialsConfig) -> None:
        self.config = config

    def spec(self) -> DataSpec:
        tasks = {"category": materials.CLASSES, "soft": ("hard", "soft"), "rough": ("smooth", "rough")}
        contact = [value_task(task, CONTACT[task]) for task in CONTACT] * self.config.contact
        return DataSpec(
            name="materials",
            vision_channels=3,
            touch_channels=3,
            tasks=tuple(Task(name=name, classes=classes) for name, classes in tasks.items()),
            values=(value_task("force", ["force_n"]), *contact),
            group_by="instance",
            licence=LICENCE,
            source=f"mvitac.sim.materials version {materials.VERSION}",
            difference=self.config.difference,
        )

    def items(self) -> list[str]:
        return ["{:02d}-{:04d}-{:02d}".format(*self._address(i)) for i in range(self.config.num)]

    def fingerprint(self) -> dict[str, Any]:
        return self.config._fingerprint(materials.VERSION)

    def samples_per_item(self) -> list[int]:
        return [self.config.sensors_per_press] * self.config.num

    def _address(self, item: int) -> tuple[int, int, int]:
        num_classes, touches = len(materials.CLASSES), self.config.touches
        return item % num_classes, item // num_classes // touches, item // num_classes % touches

    def read(self, item: int) -> list[Sample]:
        return [self._through(number, *self._address(item)) for number in range(self.config.sensors_per_press)]

    def _through(self, number: int, category: int, instance: int, touch: int) -> Sample:
        config = self.config
        asked: Any = {"background": config.difference, "measured": config.contact, "sensors": config.choice()}
        made = materials.touch(config.seed, category, instance, touch, size=config.size, through=number, **asked)
        labels = {f"label_{task}": int(made.pop(task)) for task in ("category", "soft", "rough")}
        vision, pressed = made.pop("vision"), made.pop("touch")
        if self.config.difference:
            pressed = difference(pressed, made.pop("background"))
        group = f"{category:02d}-{instance:04d}"
        name, press = f"{group}-{touch:02d}", {}
        if config.sensors_per_press > 1:
            name, press = f"{name}-{number:02d}", {"press": name}
        # Of 20 instances of a class, 4 are in test and 3 in val. Instances are independent, so any fixed rule is fair.
        split = "test" if instance % 20 in (2, 7, 12, 17) else "val" if instance % 20 in (5, 10, 15) else "train"
        columns = {"id": name, "group": group, "touch_group": group, **press, "split": split, **labels, **made}
        return Sample(vision=vision, touch=pressed, columns=columns)


@dataclass(frozen=True, kw_only=True)
class GraspsConfig(SimulatedConfig):
    """Simulated two-finger grasps of 106 objects, before, during and after the lift, labelled by success."""

    name: ClassVar[str] = "grasps"
    phased: ClassVar[bool | None] = True

    num: int = 5300
    """Number of grasps; each gives three rows (before, during, after)."""
    contact: bool = False
    """Also measure depth, position and size of the contact and the shear force, as tasks with values."""

    def source(self) -> Source:
        return Grasps(self)


class Grasps(Source):
    """Item i is grasp i // 106 of object i % 106. Touch is both gels stacked on channels (6), as in the paper."""

    def __init__(self, config: GraspsConfig) -> None:
        self.config = config

    def spec(self) -> DataSpec:
        known, during = {"normal force": ["normal_n"]}, {"phase": "during"}
        if self.config.contact:
            known |= {**CONTACT, "shear force": ["shear_x_n", "shear_y_n"]}
        return DataSpec(
            name="grasps",
            vision_channels=3,
            touch_channels=6,
            # 'after' shows the outcome, so only 'during' (fingers closed, before the lift) has the label.
            tasks=(Task(name="success", classes=("failure", "success"), only=during),),
            values=tuple(
                value_task(task, [grasps.side_name(n, side) for n in names for side in ("left", "right")], only=during)
                for task, names in known.items()
            ),
            group_by="object",
            controls={"contact only": ("contact_left", "contact_right")},
            licence=LICENCE,
            source=f"mvitac.sim.grasps version {grasps.VERSION}",
        )

    def items(self) -> list[str]:
        return [f"{i % grasps.NUM_OBJECTS:03d}-{i // grasps.NUM_OBJECTS:04d}" for i in range(self.config.num)]

    def fingerprint(self) -> dict[str, Any]:
        return self.config._fingerprint(grasps.VERSION)

    def samples_per_item(self) -> list[int]:
        return [3] * self.config.num

    def read(self, item: int) -> list[Sample]:
        obj, index = item % grasps.NUM_OBJECTS, item // grasps.NUM_OBJECTS
        place = int(np.flatnonzero(np.random.default_rng(106).permutation(grasps.NUM_OBJECTS) == obj)[0])
        split = "test" if place < 26 else "val" if place < 42 else "train"
        config, samples = self.config, []
        asked: Any = {"held_out_sensor": config.held_out_sensor, "measured": config.contact}
        for made in grasps.grasp(config.seed, obj, index, size=config.size, **asked):
            vision = made.pop("vision")
            both = np.concatenate([made.pop("touch_left"), made.pop("touch_right")], axis=2)
            grasp_id = f"{obj:03d}-{index:04d}"
            known = {"id": f"{grasp_id}-{made['phase']}", "group": made["object"], "touch_group": grasp_id}
            columns = {**known, "split": split, "label_success": int(made.pop("success")), **made}
            samples.append(Sample(vision=vision, touch=both, columns=columns))
        return samples
