"""The int8 version of an ONNX file."""

from pathlib import Path

import numpy as np


def quantise(path: Path, inputs: list[str], examples: list[list[np.ndarray]]) -> None:
    """Replace the ONNX file by its int8 version: weights per channel, activations by ranges seen on ``examples``.

    Weights have 7 bits: a CPU without VNNI adds pairs of 8-bit products in 16 bits, where larger sums are cut off.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self.left = iter(examples)

        def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
            example = next(self.left, None)
            return None if example is None else dict(zip(inputs, example, strict=True))

    prepared = path.with_name("prepared.onnx")
    quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
    quantize_static(
        str(prepared),
        str(path),
        Reader(),
        quant_format=QuantFormat.QDQ,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        per_channel=True,
        reduce_range=True,
        # Heads and probes stay in fp32: they are small.
        op_types_to_quantize=["Conv", "Add", "MaxPool", "GlobalAveragePool"],
    )
    prepared.unlink()
