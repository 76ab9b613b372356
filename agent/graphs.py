"""The graphs that a bundle may hold: what `train` exports and no more, so that a decision takes bounded time and memory.

A graph is checked before onnxruntime sees it: even opening one computes what is constant in it. Only what was checked is handed on.
"""

import math
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

OPERATORS = ("Gemm", "Relu", "Tanh")
MOST_NODES = 100
MOST_WORK = 2**24
"""Most multiplications of one decision; those of the shipped policies need 120,000. A weight counts each time that it is used."""

_INT, _STRING, _BYTES, _MESSAGE, _FLOAT = 3, 9, 12, 11, 2
_FIELDS = {
    "Model": "ir_version:1:i producer_name:2:s graph:7:Graph opset_import:8:b* training_info:20:b* functions:25:b*",
    "Graph": "node:1:Node* name:2:s initializer:5:Tensor* input:11:b* output:12:b* sparse_initializer:15:b*",
    "Node": "input:1:s* output:2:s* name:3:s op_type:4:s attribute:5:Attribute* domain:7:s",
    "Attribute": "name:1:s f:2:f i:3:i t:5:b g:6:b floats:7:f* ints:8:i* tensors:10:b* graphs:11:b* type:20:i ref_attr_name:21:s "
    "sparse_tensor:22:b sparse_tensors:23:b*",
    "Tensor": "dims:1:i* data_type:2:i float_data:4:f* name:8:s raw_data:9:b external_data:13:b* data_location:14:i",
}
"""The part of ONNX's format (onnx.proto) that is read: name, number and type of each field; * is repeated. Parts that are not looked into
are bytes, and all other fields are dropped."""


class GraphError(ValueError):
    """The graph is not one that a bundle may hold; the text is one line."""


def _model() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name="policy.proto", package="policy", syntax="proto2")
    plain = {"i": _INT, "s": _STRING, "b": _BYTES, "f": _FLOAT}
    for message, fields in _FIELDS.items():
        made = file.message_type.add(name=message)
        for name, number, kind in (field.split(":") for field in fields.split()):
            field = made.field.add(name=name, number=int(number), label=3 if kind.endswith("*") else 1)
            kind = kind.rstrip("*")
            field.type = plain.get(kind, _MESSAGE)
            if kind not in plain:
                field.type_name = f".policy.{kind}"
            elif kind in "if" and field.label == 3:
                field.options.packed = True
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("policy.Model"))


_Model = _model()


def checked(data: bytes) -> bytes:
    """Return a graph without whatever was not looked at. Raises GraphError if it is not one that a bundle may hold.

    Allowed are OPERATORS of ONNX itself on float32, without subgraphs and functions, with all weights in the graph.
    """
    model = _Model()
    try:
        model.ParseFromString(data)
    except DecodeError:
        raise GraphError("not a graph that onnxruntime can run: not ONNX") from None
    model.DiscardUnknownFields()
    graph = model.graph
    for part, name in (
        (model.functions, "functions"),
        (model.training_info, "training steps"),
        (graph.sparse_initializer, "sparse weights"),
    ):
        if part:
            raise GraphError(f"has {name} of its own, which are not allowed")
    if len(graph.node) > MOST_NODES:
        raise GraphError(f"has {len(graph.node):,} nodes; wanted {MOST_NODES} at most")
    for node in graph.node:
        _check(node)
    sizes = dict(map(_size, graph.initializer))
    work = sum(_work(node, sizes) for node in graph.node)
    if work > MOST_WORK:
        raise GraphError(f"needs {work:,} multiplications for a decision; wanted {MOST_WORK:,} at most")
    return bytes(model.SerializeToString())


def _size(tensor: Any) -> tuple[str, int]:
    """Return name and number of elements of a weight."""
    if tensor.data_location or tensor.external_data:
        raise GraphError(f"weights {_shown(tensor.name)} lie in another file; wanted all of them in the graph")
    count = math.prod(tensor.dims)
    if tensor.data_type != 1 or min(tensor.dims, default=1) < 0 or count not in (len(tensor.float_data), len(tensor.raw_data) / 4):
        raise GraphError(f"weights {_shown(tensor.name)} are not the float32 array that they claim to be")
    return tensor.name, count


def _check(node: Any) -> None:
    """Check a node's operator and attributes."""
    if node.op_type not in OPERATORS or node.domain not in ("", "ai.onnx"):
        operator = f"{node.domain}.{node.op_type}".lstrip(".")
        raise GraphError(f"uses the operator {_shown(operator)}; allowed are {', '.join(OPERATORS)}")
    for attribute in node.attribute:
        if attribute.g or attribute.graphs or attribute.name not in ("transB", "alpha", "beta"):
            raise GraphError(f"has {_shown(attribute.name)} at a {node.op_type}; allowed are transB, alpha and beta")


def _work(node: Any, sizes: dict[str, int]) -> int:
    """Return the multiplications of a node.

    All that flows comes from the observation, one row, and a row that is never transposed stays one. So no product is larger than a weight.
    """
    flowing, *constants = node.input or [""]
    if flowing in sizes or not all(name in sizes for name in constants if name):
        raise GraphError(f"has a {node.op_type} of other things than the layer before it, with weights and biases of the graph")
    return sizes[constants[0]] if constants and constants[0] else 0


def _shown(text: str) -> str:
    return repr(text[:60])
