"""``ExportConfig``: what `mvitac export` writes. It imports no torch."""

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Fixed, arg

Precision = Literal["fp32", "bf16", "int8"]
MIN_COSINE = {"fp32": 0.9999, "bf16": 0.99, "int8": 0.95}
"""Lowest cosine of any single embedding with the original, by the arithmetic of an export."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """What to export, and how far it may differ from the trained model."""

    precision: Precision = "fp32"
    """Arithmetic. bf16: by OpenVINO, on a CPU that computes it. int8: 8-bit activations, with ranges from train rows of the
    pack, and 7-bit weights, for any CPU."""
    modalities: tuple[Literal["vision", "touch"], ...] = ()
    """Inputs of the export. Default: all that the model has."""
    min_cosine: Fixed[float | None] = None
    """Lowest cosine of any single embedding with the original (default: .9999 for fp32, .99 for bf16, .95 for int8)."""
    accuracy_loss: float = 0.5
    """Points of accuracy (percent) that any one task may lose on the test rows."""
    value_loss: float = 0.1
    """Change of any predicted value on the test rows (root mean square), in standard deviations of that value."""
    num_rows: Annotated[int, arg(name="rows")] = 512
    """Maximum number of test rows to check on, 2 or more."""

    def __post_init__(self) -> None:
        if self.num_rows < 2 or not (0 <= self.accuracy_loss <= 100 and 0 <= self.value_loss < 1e6):
            limits = f"accuracy_loss {self.accuracy_loss:g}, value_loss {self.value_loss:g}"
            raise ValueError(f"rows {self.num_rows}, {limits}: give 2 rows or more, and losses from 0")

    @property
    def tolerance(self) -> dict[str, float]:
        """The limits of ``parity``."""
        cosine = MIN_COSINE[self.precision] if self.min_cosine is None else self.min_cosine
        return {"min_cosine": cosine, "accuracy_loss": self.accuracy_loss, "value_loss": self.value_loss}
