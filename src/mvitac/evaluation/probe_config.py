"""``ProbeConfig``: what `mvitac probe` and ``mvitac.probe`` are asked to score. It imports no torch."""

from dataclasses import dataclass
from typing import Literal, get_args

from mvitac.evaluation import few_labels
from mvitac.registry import check_known

Probe = Literal["linear", "paper", "knn"]
Standardise = Literal["colours", "features"]


@dataclass(frozen=True, kw_only=True)
class ProbeConfig:
    """What to probe, and whether to score controls."""

    probes: tuple[Probe, ...] = ("linear",)
    """linear: logistic regression, or ridge for values, C or alpha chosen on split val. paper: the paper's
    Adam probe. knn: 20 nearest."""
    tasks: tuple[str, ...] = ()
    """Tasks to probe. Default: all."""
    modalities: tuple[Literal["touch", "vision", "both"], ...] = ()
    """Modalities to probe. Default: all of the data."""
    controls: bool = True
    """Score the controls, too: a frozen ImageNet trunk (where weights are installed or cached), the untrained trunk, pixels,
    border, majority class, and the dataset's own. --no-controls leaves them out."""
    fractions: tuple[float, ...] = ()
    """Also fit the linear probe on these percentages of the labels, such as 1 10."""
    folds: int = 0
    """Test every group once, in this many folds by group, stratified: for small sets. Groups that a run learned from are
    fitted on, and never tested. 0: score the split test."""
    standardise: tuple[Standardise, ...] = ()
    """Statistics of each touch sensor (column sensor), from unlabelled images. features: standardise its features by
    their own mean and standard deviation. colours: show images of a sensor that --learn-on lacks in the colours of those
    that it has, and take the mean features. Retrieval stays as it is."""

    def __post_init__(self) -> None:
        given = {"probe": self.kinds, "task": self.tasks, "modality": self.modalities, "standardise": self.standardise}
        for name, values in given.items():
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"{name} {value!r} is given twice: give it once")
        check_known("probe", self.probes, get_args(Probe))
        if not self.probes:
            raise ValueError("no probe given: choose from linear, paper, knn")
        if self.folds < 0 or self.folds == 1 or (self.folds and self.standardise):
            raise ValueError(f"folds {self.folds}: give 2 or more, without --standardise; or 0 for none")
        if not all(0 < percent <= 100 for percent in self.fractions):
            raise ValueError(f"fractions {self.fractions}: give percentages, above 0, at most 100")

    @property
    def kinds(self) -> tuple[str, ...]:
        """``probes``, and the linear probes on ``fractions`` of the labels."""
        return (*self.probes, *map(few_labels.name, self.fractions))
