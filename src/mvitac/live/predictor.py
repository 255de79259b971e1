"""Predict from the newest frames: contact, a mean answer per touch, and the age of each prediction.

The background of each touch sensor (``contact.py``) decides *whether* there is contact. The model gets frames as they
are, or minus that background if it was trained on difference images. Probabilities are averaged over one touch; values,
such as a force, are those of the newest frame. Shapes: frames uint8 RGB [H, W, 3].
"""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvitac.data.images import difference, fit
from mvitac.deploy.engine import Engine, frame_shapes, frames_of, spread_at
from mvitac.live.cameras import Recording, start_together
from mvitac.live.contact import Contact, LiveConfig
from mvitac.live.streams import Event, Frame, Stream

OURS = {"frame", "time", "contact", "touch", "id", "group", "split", "age_ms"}
"""Fields of predictions that tasks may not take."""
NUM_AGES = 10_000
"""Number of latest predictions, some minutes of them, over which the percentiles of the age are computed."""


def own_name(name: str, kind: str, taken: Iterable[str] = ()) -> str:
    """``name`` of a task, class or value in predictions; with its ``kind`` where a field of ours or another is called so."""
    return f"{name} ({kind})" if name in OURS or name in taken else name


@dataclass
class Touch:
    """One touch, from contact to release, with the sum of its predictions."""

    num_frames: int = 0
    totals: dict[str, np.ndarray] = field(default_factory=dict)
    values: dict[str, np.ndarray] = field(default_factory=dict)  # task -> values [T] of the newest frame

    def add(self, probabilities: dict[str, np.ndarray], values: dict[str, np.ndarray]) -> None:
        self.num_frames += 1
        for task, p in probabilities.items():
            self.totals[task] = self.totals.get(task, 0) + p
        self.values = values


class Live:
    """Predictions from streams of frames. Call ``tick`` whenever a frame may have come."""

    max_age = 0.0
    num_predictions = num_stale = num_touches = 0
    touch: Touch | None = None
    last: Touch | None = None
    answer: Touch | None = None
    """What the latest prediction says: the current touch, or a frame without contact (``always``)."""
    contact: bool | None = None
    _seen = -1

    def __init__(
        self,
        engine: Engine,
        streams: dict[str, Sequence[Stream]],
        config: LiveConfig = LiveConfig(),
        *,
        clock: Callable[[], float] = time.monotonic,
        record: Callable[[dict[str, np.ndarray], dict[str, Any]], None] | None = None,
        tell: Callable[[Event], None] = lambda event: None,
        free: Sequence[np.ndarray] = (),
        always: bool = False,
    ) -> None:
        """
        Args:
            streams: one stream per camera and sensor, by modality; two touch sensors are stacked in channels.
            clock: time in seconds, that of the streams.
            record: called with every pair that was used (images, columns).
            tell: called with every fault as it happens, in the thread that noticed it.
            free: an image of each touch sensor without contact; none: the first frames show it.
            always: predict from every frame; without contact, an answer is that of its frame alone.

        Raises:
            ValueError: the engine takes other inputs, or backgrounds that live cannot learn; recordings of other times.
        """
        given = {m: len(several) for m, several in streams.items()}
        if given != (wanted := {m: shape[2] // 3 for m, shape in frame_shapes(engine).items()}):
            raise ValueError(f"number of sources: the model takes {wanted}, given are {given}")
        self.engine, self.streams, self.clock = engine, streams, clock
        self.record, self.tell, self.always = record, tell, always
        self.all = [s for several in streams.values() for s in several]
        self._leads = "touch" if "touch" in streams else "vision"
        self.leading = streams[self._leads][0]  # the stream whose new frames start predictions
        if files := [stream.origin for stream in self.all if isinstance(stream.origin, Recording)]:
            start_together(files)
        window = engine.window or {"minus_first": False}
        if window["minus_first"] and (engine.difference or "vision" in window["of"]):
            raise ValueError("live learns the background of touch alone: not that of vision, nor frames minus it twice")
        self.minus_rest = engine.difference or (window["minus_first"] and "touch" in window["of"])
        """Whether the learned background is subtracted from touch. It also stands for the first frame of a touch."""
        side = engine.inputs["touch"][0] if self.minus_rest and "touch" in streams else 0
        self._since: dict[str, float] = {}
        felt = streams.get("touch", ())
        if len(free) not in (0, len(felt)):
            raise ValueError(f"{len(free)} background(s) for {len(felt)} touch sensor(s): give one of each, or none")
        shown = [s.origin.cropped(image) for s, image in zip(felt, free, strict=True)] if free else [None] * len(felt)
        self.contacts = {s.name: Contact(config, side, image) for s, image in zip(felt, shown, strict=True)}
        self.counts: Counter[str] = Counter()
        self.ages: deque[float] = deque(maxlen=NUM_AGES)
        """Seconds from the capture of the leading frame to the answer, the latest prediction's last."""
        self.outputs: dict[str, np.ndarray] = {}  # of the engine, for the latest prediction
        self._judged: dict[str, int] = {}
        self._changed: set[str] = set()
        for stream in self.all:
            stream.tell = self._heard
        self.remember()

    def tick(self) -> bool:
        """Use the newest frames if the leading stream has a new one; True if that made a prediction."""
        self.remember()
        for stream in self.all:
            stream.check()
        leading = self.leading.newest(take=False)
        if leading is None or leading.number == self._seen:
            if any(stream.fault for stream in self.all):
                self._lose()
            return False
        frames = {m: [s.newest() for s in several] for m, several in self.streams.items()}
        # A newer frame may have come since ``leading`` was read: the one that is used counts.
        self._seen = (frames[self._leads][0] or leading).number
        now = self.clock()
        # Every stream must run and have a frame that shows the present; an old one would give an answer about the past.
        pairs = zip(self.all, (frame for found in frames.values() for frame in found), strict=True)
        if not all(f and not stream.fault and now - f.time <= stream.stale_after for stream, f in pairs):
            self.num_stale += 1
            self._lose()
            return False
        images, given = self.see({m: [frame for frame in found if frame] for m, found in frames.items()})
        if not self.contact:
            self.finish()
        if given:  # add a prediction to the current touch, or start one
            self.answer = self.touch or Touch()
            if self.contact:
                self.touch = self.answer
            self.outputs = outputs = self.engine(**{m: image[None] for m, image in given.items()})
            classes = {task: outputs[f"probability_{task}"][0] for task in self.engine.classes}
            self.answer.add(classes, {task: outputs[f"value_{task}"][0] for task in self.engine.values})
            self.ages.append(self.clock() - min(f.time for f in frames[self._leads] if f))
            self.max_age = max(self.max_age, self.ages[-1])
            self.num_predictions += 1
        # Before the first calibration it shows no contact (docs/live.md); after it, what is not known is no rest.
        if self.record and (self.contact is not None or not self.counts["calibrated"]):
            self.record(images, {"time": now, "contact": bool(self.contact), "touch_number": self.num_touches})
        return given is not None

    def see(self, frames: dict[str, list[Frame]]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None]:
        """Find contact in the newest ``frames`` of every stream.

        Returns them at the model's size, and what the model gets of them, both uint8 [S, S, C] by modality; None instead
        of the latter where there is nothing to predict.
        """
        before, self.contact = self.contact, self._contact(frames.get("touch", []))
        seen = {m: [fit(f.image, self.engine.inputs[m][0]) for f in found] for m, found in frames.items()}
        images = {m: np.concatenate(several, axis=2) for m, several in seen.items()}
        if self.contact and not before:
            self.num_touches += 1
        if bool(self.contact) != bool(before) or not self._since:
            self._since = {s.name: f.time for m in frames for s, f in zip(self.streams[m], frames[m], strict=True)}
        if not (self.contact or (self.always and (self.contact is False or not self.minus_rest))):
            return images, None
        given = {m: self._as_trained(m, self._window(m, frames[m], image)) for m, image in images.items()}
        return images, {m: np.concatenate(several, axis=2) for m, several in given.items()}

    def step(self) -> dict[str, Any] | None:
        """``tick``, and what is new: a prediction, or that a touch has ended, JSON-ready; else None."""
        before = self.touch is not None
        return self.prediction() if self.tick() or (before and self.touch is None) else None

    def finish(self) -> None:
        """End the current touch."""
        self.last, self.touch, self.answer = self.touch or self.last, None, None

    def _contact(self, frames: Sequence[Frame]) -> bool | None:
        """Whether any touch sensor is in contact; None during calibration; always True without a sensor."""
        if not self.contacts:
            return True
        while self._changed:
            self.contacts[self._changed.pop()].forget()
        for name, frame in zip(self.contacts, frames, strict=True):
            if self._judged.get(name) == frame.number:
                continue
            self._judged[name] = frame.number
            contact = self.contacts[name]
            before = contact.background is None, contact.uneasy
            contact(frame.image)
            if contact.uneasy and not before[1]:
                text = f"{name} was touched or moved while its background was learned: release it, it is learned again"
                self._heard(Event(name, "uneasy calibration", text))
            if before[0] and contact.background is not None:
                self._heard(Event(name, "calibrated", f"{name} is calibrated without contact"))
        states = self.contacts.values()
        return None if any(c.background is None for c in states) else any(c.touched for c in states)

    def _window(self, modality: str, frames: list[Frame], newest: np.ndarray) -> list[np.ndarray]:
        """The frames [S, S, C] that the model looks at, newest first: ``newest``, and older ones by their time."""
        if frames_of(self.engine.window, modality) == 1:
            return [newest]
        pairs = zip(self.streams[modality], frames, strict=True)
        sensors = [stream.window(frame, self._back(stream), self._since[stream.name]) for stream, frame in pairs]
        return [newest, *(np.concatenate(each, axis=2) for each in list(zip(*sensors, strict=True))[1:])]

    def _back(self, stream: Stream) -> list[float]:
        window = self.engine.window or {}
        unit = 1.0 if window["order"] == "time" else stream.interval() or 0.0
        return [k * window["stride"] * unit for k in range(window["frames"])]

    def remember(self) -> None:
        """Let the streams keep as much as a window needs."""
        for modality in (m for m in self.streams if frames_of(self.engine.window, m) > 1):
            for stream in self.streams[modality]:
                seconds = self._back(stream)[-1] if stream.interval() else math.inf
                stream.remember(seconds, self.engine.inputs[modality][0])

    def _as_trained(self, modality: str, frames: list[np.ndarray]) -> list[np.ndarray]:
        """Frames [S, S, C] as the model was trained on them; recorded images stay as they came."""
        if modality != "touch" or not (self.minus_rest and self.contacts):
            return frames
        free = np.concatenate([c.picture for c in self.contacts.values() if c.picture is not None], axis=2)
        return [difference(frame, np.rint(free).astype(np.uint8)) for frame in frames]

    def _lose(self) -> None:
        """End the touch when frames are missing: contact is then unknown."""
        self.finish()
        self.contact = None

    def _heard(self, event: Event) -> None:
        self.counts[event.what] += 1
        self.tell(event)
        # Another lens, crop or gel: the learned background no longer holds. The capture thread reports it before it
        # shows the frame, while ``tick`` may use the frame before in its own thread: so ``tick`` forgets it.
        if event.what in ("resolution changed", "back") and event.stream in self.contacts:
            self._changed.add(event.stream)

    def answers(self, touch: Touch) -> dict[str, tuple[str, float]]:
        """By task the likeliest class of a touch, and its mean probability."""
        means = {task: touch.totals[task] / touch.num_frames for task in self.engine.classes}
        return {task: (self.engine.classes[task][int(p.argmax())], float(p.max())) for task, p in means.items()}

    def prediction(self) -> dict[str, Any]:
        """The newest prediction, JSON-ready; without contact, that alone (unless ``always``)."""
        said: dict[str, Any] = {"touch": self.num_touches, "contact": self.contact if self.answer else False}
        if self.answer is None:
            return said
        said["age_ms"] = 1000 * self.ages[-1]
        for task, (name, confidence) in self.answers(self.answer).items():
            said[own_name(task, "label", said)] = {"class": name, "confidence": confidence}
        for task, targets in self.engine.values.items():
            found = zip(targets, self.answer.values[task].tolist(), strict=True)
            told = {t["name"]: {"value": v, "unit": t["unit"], "spread": spread_at(t, v)} for t, v in found}
            said[own_name(task, "value", said)] = told
        return said

    def summary(self) -> dict[str, Any]:
        """Counts, ages in ms from capture to prediction, and events, JSON-ready."""
        p50, p99 = (1000 * float(np.percentile(self.ages, q)) if self.ages else None for q in (50, 99))
        ages = {"p50": p50, "p99": p99, "max": 1000 * self.max_age if self.ages else None}
        found = {s.name: {"frames": s.num_frames, "dropped": s.num_dropped, "damaged": s.num_damaged} for s in self.all}
        known = {"predictions": self.num_predictions, "touches": self.num_touches, "age_ms": ages}
        return {**known, "stale": self.num_stale, "streams": found, "events": dict(self.counts)}
