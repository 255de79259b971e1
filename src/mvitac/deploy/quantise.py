"""ONNX files, their int8 versions, and the CPU that an int8 version is for.

A CPU without VNNI adds pairs of 8-bit products in 16 bits, and larger sums are cut off (they saturate). With weights
of 7 bits the sums fit; this is onnxruntime's ``reduce_range`` and OpenVINO's overflow fix.
"""

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from mvitac.deploy.engine import FILES, import_openvino, open_engine
from mvitac.system.files import brief

Target = Literal["auto", "avx2", "vnni"]
"""CPU of an int8 export: avx2 = any (7-bit weights), vnni = 8-bit weights, for CPUs that do not saturate (x86 with VNNI
or AMX, ARM), auto = this machine's."""


def write_onnx(
    module: torch.nn.Module,
    inputs: tuple[torch.Tensor, ...],
    folder: Path,
    names: list[str],
    outputs: list[str],
    shapes: Any,
) -> Path:
    """Write ``module`` as model.onnx into ``folder``; ``shapes`` are the dynamic shapes of torch.export."""
    path = folder / "model.onnx"
    torch.onnx.export(
        module,
        inputs,
        path,
        dynamo=True,
        dynamic_shapes=shapes,
        input_names=names,
        output_names=outputs,
        opset_version=18,
        external_data=False,
        verbose=False,
    )
    return path


def to_openvino(path: Path) -> None:
    """Convert the ONNX file for OpenVINO, into the same folder.

    Not by ``openvino.convert_model``, which reports each use (``import_openvino``).
    """
    openvino = import_openvino()
    model, out = openvino.Core().read_model(path), path.with_name(FILES["openvino"][0])
    try:
        openvino.save_model(model, out, compress_to_fp16=False)
    except RuntimeError as error:  # it does not say why
        raise ValueError(f"{out} cannot be written ({brief(error)}): is the disk full?") from None


def quantise(path: Path, inputs: list[str], examples: list[list[np.ndarray]], *, seven_bits: bool) -> None:
    """Replace the ONNX file by its int8 version: weights per channel, activations by ranges seen on ``examples``."""
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
        reduce_range=seven_bits,
        # Heads and probes stay in fp32: they are small.
        op_types_to_quantize=["Conv", "Add", "MaxPool", "GlobalAveragePool"],
    )


def this_machine(kind: str) -> Literal["avx2", "vnni"]:
    """The target of this machine: the engine of ``kind`` computes the mean of 576 ones in int8; saturated, it is about half.

    Measured on the engine, not read from the CPU's flags: it chooses its instructions itself, and variables restrict it.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    ones, weight = np.ones((1, 64, 8, 8), np.float32), np.full((64, 64, 3, 3), 1 / 576, np.float32)
    given = helper.make_tensor_value_info("ones", TensorProto.FLOAT, ones.shape)
    mean = helper.make_tensor_value_info("mean", TensorProto.FLOAT, (1, 64, 6, 6))
    conv = helper.make_node("Conv", ["ones", "weight"], ["mean"])
    graph = helper.make_graph([conv], "mean", [given], [mean], [numpy_helper.from_array(weight, "weight")])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)
        quantise(path, ["ones"], [[ones]], seven_bits=False)
        if kind == "openvino":
            to_openvino(path)
        found = open_engine(Path(folder), kind)([ones])[0]
    return "vnni" if np.abs(found - 1).max() < 0.02 else "avx2"
