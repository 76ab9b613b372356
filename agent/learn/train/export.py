"""Export of a trained learner to a bundle, its network as an ONNX graph."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from agent.bundle import FORMAT, CurvePoint, Page, write
from agent.learn.env import Settings
from agent.learn.train.loop import layers_of
from agent.learn.train.recipes import Recipe
from agent.observation import SCHEMAS

OPSET, IR = 17, 8  # old enough for every onnxruntime in use
KINDS: dict[type[nn.Module], str] = {nn.ReLU: "Relu", nn.Tanh: "Tanh"}


def export(model: BaseAlgorithm, recipe: Recipe, seed: int, curve: list[CurvePoint], path: Path) -> None:
    """Write the policy of a learner to a bundle, with its recipe and training curve."""
    settings = Settings(**recipe.env | recipe.flown)
    schema = SCHEMAS[settings.observation]
    page = Page(
        format=FORMAT,
        algorithm=recipe.algorithm,
        schema=settings.observation,
        schema_version=schema.version,
        observation=schema.size,
        move=settings.move,
        seed=seed,
        training=msgspec.to_builtins(recipe),
        curve=curve,
        evaluation={},
    )
    write(path, page, graph(layers_of(model)))


def graph(layers: Sequence[nn.Module]) -> bytes:
    """Return linear layers and their activations as an ONNX graph (1, F) -> (1, A).

    It goes from the observation to the scores of headings or the action.
    Raises TypeError on another kind of layer.
    """
    nodes, weights = [], []
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    flowing = "observation"
    for k, layer in enumerate(layers):
        out = "said" if k == len(layers) - 1 else f"layer{k}"
        if isinstance(layer, nn.Linear):
            names = [f"weight{k}", f"bias{k}"]
            weights += [
                numpy_helper.from_array(
                    np.ascontiguousarray(parameter.detach().cpu().numpy(), np.float32), name
                )
                for name, parameter in zip(names, (layer.weight, layer.bias), strict=True)
            ]
            nodes.append(helper.make_node("Gemm", [flowing, *names], [out], transB=1))
        elif type(layer) in KINDS:
            nodes.append(helper.make_node(KINDS[type(layer)], [flowing], [out]))
        else:
            raise TypeError(f"no ONNX for {layer}")
        flowing = out
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size])
        for name, size in (("observation", linear[0].in_features), ("said", linear[-1].out_features))
    ]
    made = helper.make_graph(nodes, "policy", ports[:1], ports[1:], weights)
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="plumeward"
    )
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
