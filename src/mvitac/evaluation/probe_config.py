"""``ProbeConfig``: what `mvitac probe` and ``mvitac.probe`` are asked to score."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mvitac.data.spec import Event
from mvitac.evaluation.probe import Probe
from mvitac.evaluation.sensors import Standardise


@dataclass(frozen=True, kw_only=True)
class ProbeConfig:
    """What to probe, and whether to score controls."""

    probes: tuple[Probe, ...] = ("linear",)
    """linear: logistic regression, or ridge for values, C or alpha chosen on held-out groups of train. paper: the paper's
    Adam probe. knn: 20 nearest. mlp: one hidden layer. attentive: attention over the trunk's last feature map."""
    tasks: tuple[str, ...] = ()
    """Tasks to probe. Default: all."""
    modalities: tuple[Literal["touch", "vision", "both"], ...] = ()
    """Modalities to probe. Default: all of the data."""
    controls: bool = True
    """Score the controls, too: majority class, untrained trunk, pixels, border, and the dataset's own. --no-controls leaves
    them out."""
    imagenet: Path | None = None
    """File with ImageNet weights of the trunk, for the frozen-ImageNet control."""
    event: tuple[str, ...] = ()
    """TASK=CLASS, e.g. slip=yes: also score this class as an event in time. How early does a recording's frame raise an
    alarm, before the first frame of this class, or before the recording's end if all of its frames have it?"""
    fps: float | None = None
    """Frames per second, if the --clock of --event counts frames. Otherwise times are in its units."""
    clock: str | None = None
    """Column with the time of each frame for --event: frame numbers, or seconds. Default: the one that orders frames
    (--data.order, else frame, seq or time)."""
    false_alarms: float = 0.1
    """Share of recordings without the --event in which an alarm is accepted. It sets the threshold, on train and val."""
    standardise: tuple[Standardise, ...] = ()
    """Statistics of each touch sensor (column sensor), from unlabelled images. features: standardise its features by
    their own mean and standard deviation. batch-norm: take the statistics of BatchNorm anew. colours: show images of a
    sensor that --learn-on lacks in the colours of those that it has, and take the mean features."""
    sensors: bool = False
    """Also say how well touch features tell the sensor, and how often they find the same press through another one."""

    def __post_init__(self) -> None:
        given = {"probe": self.probes, "task": self.tasks, "modality": self.modalities, "standardise": self.standardise}
        for name, values in given.items():
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"{name} {value!r} is given twice: give it once")
        if self.imagenet and not self.imagenet.is_file():
            raise ValueError(f"imagenet {self.imagenet}: give a file that exists")
        for name, _, happens in (asked.partition("=") for asked in self.event):
            if not (name and happens):
                raise ValueError(f"event {name or '='!r}: give a task and its class, such as slip=yes")
        if (self.fps is not None or self.clock) and not self.event:
            raise ValueError(f"{'clock' if self.clock else 'fps'} is for events: name one with --event TASK=CLASS")
        self.event_of("")

    def event_of(self, happens: str) -> Event:
        """The class ``happens`` as an event with these options."""
        return Event(happens=happens, clock=self.clock, fps=self.fps, false_alarms=self.false_alarms)
