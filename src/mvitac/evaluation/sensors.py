"""Touch sensors: images or features of a new one in the terms of known ones.

All statistics come from images without labels. Shapes: features [N, D].
"""

import copy
from collections.abc import Collection

import numpy as np

from mvitac.data.lazy import Changed
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.data.spec import listed
from mvitac.evaluation.classifiers import spread
from mvitac.evaluation.features import features, sample
from mvitac.evaluation.probe_config import Standardise
from mvitac.model import Model
from mvitac.transforms.gel_colours import MIN_IMAGES, NUM_IMAGES, GelColours, Looks, learn_colours, recolour

NUM_STATISTICS = 256  # images of a sensor that statistics are taken from, at most
COLOURS = "--standardise colours"  # the option of probe that errors name
MAX_LOOKS = 4  # known sensors in whose colours a new one is shown, at most


def sensors_of(pack: Pack, rows: np.ndarray) -> tuple[str, ...]:
    """Names of the touch sensors of pack ``rows``, sorted. Those of a mix are named by its parts themselves."""
    found, start = set(), 0
    for part in (pack.parts or {"": pack}).values():
        own = rows[(rows >= start) & (rows < start + part.num)] - start
        start += part.num
        if "touch" in part.spec.modalities:
            own = own[part.has("touch")[own]]
            found |= {part.sensor_names[number] for number in np.unique(part.sensors[own])}
    return tuple(sorted(found))


def about_new(model: Model, pack: Pack, standardise: tuple[Standardise, ...] = ()) -> str:
    """A sentence on the touch sensors of ``pack`` that ``model`` never met, and what is done about them.

    "" if there are none, or if the model's file does not say which it met (``DataSpec.sensors``).
    """
    known = model.spec.sensors if "touch" in model.encoders else ()
    new = [name for name in sensors_of(pack, np.arange(pack.num)) if name not in known]
    if not known or not new:
        return ""
    advice = "`mvitac probe RUN --on PACK --learn-on OLD --standardise colours features` says what helps"
    done = f"--standardise {' '.join(standardise)} is used" if standardise else f"nothing is done about it ({advice})"
    # Without the column, a pack's name stands for its sensor.
    found = "is" if "sensor" in pack.table.column_names else "is named by no column sensor and may be"
    return f"touch sensor {listed(new)} {found} new to the model, which knows {listed(known)}: {done}"


def unlabelled_rows(pack: Pack, sensor: int, num: int = NUM_STATISTICS) -> np.ndarray:
    """Rows of ``sensor`` whose touch images say what it looks like: of train, or else of any split but test.

    Test images themselves are used only if there are fewer than ``MIN_IMAGES`` others. Labels are never read. Of a
    recording of ``mvitac live`` (column contact), it is the middle frame of each touch: its frames are near-copies.
    """
    own = np.flatnonzero(pack.has("touch") & (pack.sensors == sensor))
    contact = pack.column("contact").astype(str) if "contact" in pack.table.column_names else np.array([])
    if len(contact) and set(contact) <= {"True", "False"}:
        own = own[contact[own] == "True"]
        touches = pack.touch_groups[own]
        own = np.array([rows[len(rows) // 2] for rows in (own[touches == n] for n in np.unique(touches))], np.int64)
    split = pack.column("split").astype(str)[own]
    kinds = (np.isin(split, ("train", "unlabelled")), split != "test", np.ones(len(own), bool))
    return sample(own[next((kind for kind in kinds if kind.sum() >= MIN_IMAGES), kinds[-1])], num)


def describe_statistics(pack: Pack, standardise: tuple[Standardise, ...]) -> list[str]:
    """Sentences that say how many images of each sensor ``standardise`` used."""
    found = []
    for number, name in enumerate(pack.sensor_names if standardise else ()):
        rows = unlabelled_rows(pack, number, NUM_IMAGES if "colours" in standardise else NUM_STATISTICS)
        tested = ", test images among them" if (pack.column("split")[rows] == "test").any() else ""
        found.append(f"uses {len(rows)} unlabelled images of sensor {name}{tested}")
    return found


def touch_features(
    model: Model, pack: Pack, modality: str, rows: np.ndarray, standardise: tuple[Standardise, ...] = ()
) -> np.ndarray:
    """``features`` of pack ``rows`` (ascending), those of touch in the statistics of each row's own sensor.

    ``ProbeConfig.standardise`` says how. With colours, those of new sensors are the mean over ``RecolouredPack.looks``.
    """
    if modality != "touch" or not standardise:
        return features(model, pack, modality, rows)
    parts, sensors = [], pack.sensors[rows]
    for number in np.unique(sensors):
        looks = pack.looks if isinstance(pack, RecolouredPack) and number in pack.new else [pack]

        def mean(rows: np.ndarray, looks: list[Pack]) -> np.ndarray:
            each = [features(model, look, modality, rows) for look in looks]
            return np.asarray(np.mean(each, axis=0, dtype=np.float32))

        z = mean(rows[sensors == number], looks)
        if "features" in standardise:
            seen = mean(unlabelled_rows(pack, int(number)), looks)
            z = (z - seen.mean(0)) / spread(seen)
        parts.append(z)
    order = np.argsort(sensors, kind="stable")  # of the rows in ``parts``
    return np.concatenate(parts)[np.argsort(order)]


class RecolouredPack(JoinedPack):
    """A joined pack that also shows the touches of sensors that ``learn`` lacks in the colours of those that it has.

    ``new``: numbers of the sensors that ``learn`` lacks; ValueError if there are none, or colours cannot be learned.
    ``looks``: one pack for each known sensor (at most ``MAX_LOOKS``, those with the most rows), with its colours.
    """

    def __init__(self, learn: Pack, score: Pack, names: Collection[str] = ()) -> None:
        super().__init__(learn, score, names)
        _check_gel(self, COLOURS)
        self.new = {n for n, name in enumerate(self.sensor_names) if name not in learn.sensor_names}
        if not self.new:
            raise ValueError(f"{COLOURS}: all sensors of {score.path} are in {learn.path}, leave it out")
        learned = {number: _colours_of(self, number, COLOURS) for number in self.new}
        old = [self.sensor_names.index(name) for name in _most_used(learn)]
        self.looks = [self._look(learned, number, _colours_of(self, number, COLOURS)) for number in old]

    def _look(self, learned: dict[int, GelColours], number: int, target: GelColours) -> Pack:
        def shown(rows: np.ndarray, images: np.ndarray) -> np.ndarray:
            for n, own in learned.items():
                if (here := self.sensors[rows] == n).any():
                    images[here] = recolour(images[here], own, target)
            return images

        look: Pack = copy.copy(self)
        look.images = {**self.images, "touch": Changed(self.images["touch"], 3, shown)}
        look.digests = {**self.digests, "colours": self.sensor_names[number]}
        return look


def learn_looks(known: Pack, new: Pack, option: str) -> Looks:
    """The one sensor of ``new`` that ``known`` lacks in the colours of those that it has, as ``RecolouredPack`` shows it.

    ValueError, which names ``option``, if there is not exactly one, or the colours of a sensor cannot be learned.
    """
    _check_gel(new, option)
    if len(names := [name for name in new.sensor_names if name not in known.sensor_names]) != 1:
        given = f"{len(names)} sensors ({listed(names)})" if names else f"no sensor but {listed(known.sensor_names)}"
        raise ValueError(f"{option}: {new.path} has {given}: give images of one that {known.path} lacks")
    number, most = new.sensor_names.index(names[0]), _most_used(known)
    targets = tuple(_colours_of(known, known.sensor_names.index(name), option) for name in most)
    num = len(unlabelled_rows(new, number, NUM_IMAGES))
    return Looks(names[0], most, num, _colours_of(new, number, option), targets)


def _check_gel(pack: Pack, option: str) -> None:
    if pack.spec.touch_channels != 3 or pack.spec.frames("touch") > 1:
        raise ValueError(f"{option} knows single images of one gel only: leave it out")


def _most_used(pack: Pack) -> tuple[str, ...]:
    """The sensors of ``pack`` in whose colours others are shown: those with the most rows."""
    rows = np.bincount(pack.sensors, minlength=len(pack.sensor_names))
    return tuple(pack.sensor_names[number] for number in np.argsort(-rows, kind="stable")[:MAX_LOOKS])


def _colours_of(pack: Pack, number: int, option: str) -> GelColours:
    try:
        return learn_colours(pack.images["touch"][unlabelled_rows(pack, number, NUM_IMAGES)])
    except ValueError as error:
        raise ValueError(f"sensor {pack.sensor_names[number]!r}: {error}; or leave {option} out") from None
