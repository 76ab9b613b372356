"""The graphs that a bundle may hold, read from ONNX: what `train` exports and no more.

So a decision takes bounded time and memory.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from agent.network import Layer

Array = NDArray[np.float32]
Field = descriptor_pb2.FieldDescriptorProto
OPERATORS = ("Gemm", "Relu", "Tanh")
MOST_NODES = 100
# Most multiplications of one decision; those of the shipped policies need 120,000. A weight counts each time
# that it is used.
MOST_WORK = 2**24

# The part of ONNX's format (onnx.proto) that is read: name, number and type of each field; * is repeated.
# Parts that are not looked into are bytes, and all other fields are dropped.
_FIELDS = {
    "Model": "ir_version:1:i producer_name:2:s graph:7:Graph opset_import:8:b* training_info:20:b* "
    "functions:25:b*",
    "Graph": "node:1:Node* name:2:s initializer:5:Tensor* input:11:Port* output:12:Port* "
    "sparse_initializer:15:b*",
    "Port": "name:1:s type:2:Type",
    "Type": "tensor_type:1:Array",
    "Array": "shape:2:Shape",
    "Shape": "dim:1:Dimension*",
    "Dimension": "dim_value:1:i dim_param:2:s",
    "Node": "input:1:s* output:2:s* name:3:s op_type:4:s attribute:5:Attribute* domain:7:s",
    "Attribute": "name:1:s f:2:f i:3:i t:5:b g:6:b floats:7:f* ints:8:i* tensors:10:b* graphs:11:b* "
    "type:20:i ref_attr_name:21:s "
    "sparse_tensor:22:b sparse_tensors:23:b*",
    "Tensor": "dims:1:i* data_type:2:i float_data:4:f* name:8:s raw_data:9:b external_data:13:b* "
    "data_location:14:i",
}


class GraphError(ValueError):
    """The graph is not one that a bundle may hold; the text is one line."""


def _model() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name="policy.proto", package="policy", syntax="proto2")
    plain = {"i": Field.TYPE_INT64, "s": Field.TYPE_STRING, "b": Field.TYPE_BYTES, "f": Field.TYPE_FLOAT}
    for message, fields in _FIELDS.items():
        made = file.message_type.add(name=message)
        for name, number, kind in (field.split(":") for field in fields.split()):
            field = made.field.add(name=name, number=int(number), label=3 if kind.endswith("*") else 1)
            kind = kind.rstrip("*")
            field.type = plain.get(kind, Field.TYPE_MESSAGE)
            if kind not in plain:
                field.type_name = f".policy.{kind}"
            elif kind in "if" and field.label == 3:
                field.options.packed = True
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("policy.Model"))


_Model = _model()


def read(data: bytes, size: int) -> list[Layer]:
    """Read a graph of a row of `size` numbers. Raises GraphError if it is not one that a bundle may hold.

    Allowed is a chain of OPERATORS of ONNX itself on float32, without subgraphs and functions, with all
    weights in the graph.
    """
    model = _Model()
    try:
        model.ParseFromString(data)
    except DecodeError:
        raise GraphError("is not an ONNX graph") from None
    graph = model.graph
    for part, name in (
        (model.functions, "functions"),
        (model.training_info, "training steps"),
        (graph.sparse_initializer, "sparse weights"),
    ):
        if part:
            raise GraphError(f"has {name} of its own, which are not allowed")
    if not graph.node:
        raise GraphError("is not an ONNX graph: it has no nodes")
    if len(graph.node) > MOST_NODES:
        raise GraphError(f"has {len(graph.node):,} nodes; wanted {MOST_NODES} at most")
    for node in graph.node:
        _check(node)
    weights = {tensor.name: _array(tensor) for tensor in graph.initializer}
    ports = [port for port in graph.input if port.name not in weights]
    takes = [[dim.dim_param or dim.dim_value for dim in port.type.tensor_type.shape.dim] for port in ports]
    if (
        len(takes) != 1
        or len(takes[0]) != 2
        or takes[0][1] != size
        or not (takes[0][0] == 1 or isinstance(takes[0][0], str))
    ):
        raise GraphError(f"takes arrays of {str(takes)[:100]}; wanted one, of [1, {size}]")
    # Before any layer is made: each has a copy of its weights.
    work = sum(
        weights[node.input[1]].size for node in graph.node if len(node.input) > 1 and node.input[1] in weights
    )
    if work > MOST_WORK:
        raise GraphError(f"needs {work:,} multiplications for a decision; wanted {MOST_WORK:,} at most")
    return list(_layers(graph, ports[0].name, size, weights))


def _layers(graph: Any, flowing: str, size: int, weights: dict[str, Array]) -> Iterator[Layer]:
    """Yield the layer of each node.

    `flowing` is the name of what the first one takes, `size` how many numbers that are.
    """
    for node in graph.node:
        name, *constants = node.input or [""]
        needed = [*constants[:1], *filter(None, constants[1:])]  # an empty name is no bias
        if name != flowing or name in weights or not all(constant in weights for constant in needed):
            raise GraphError(
                f"has a {node.op_type} of other things than the layer before it, with weights and biases of "
                "the graph"
            )
        given = [weights[constant] for constant in needed]
        if len(node.output) != 1 or not (1 <= len(given) <= 2 if node.op_type == "Gemm" else not given):
            raise GraphError(f"has a {node.op_type} with {len(given)} weights and {len(node.output)} outputs")
        (flowing,) = node.output
        layer = _product(node, *given) if given else Layer(node.op_type)
        if given:
            takes, gives = layer.weights.shape
            if takes != size:
                raise GraphError(f"has a Gemm of {size} numbers with weights for {takes}")
            size = gives
        yield layer
    if (names := [port.name for port in graph.output]) != [flowing]:
        raise GraphError(
            f"gives {_shown(', '.join(names))}; wanted what its last node makes, {_shown(flowing)}"
        )


def _product(node: Any, weights: Array, biases: Array | None = None) -> Layer:
    settings = {attribute.name: attribute for attribute in node.attribute}
    if weights.ndim != 2:
        raise GraphError(f"has a Gemm with weights of {list(weights.shape)}; wanted a matrix")
    if "transB" in settings and settings["transB"].i:
        weights = weights.T
    scale, share = (float(settings[name].f) if name in settings else 1.0 for name in ("alpha", "beta"))
    if biases is None:
        biases = np.zeros(1, np.float32)
    if biases.size not in (1, weights.shape[1]) or biases.shape not in ((), (biases.size,), (1, biases.size)):
        raise GraphError(f"has a Gemm with biases of {list(biases.shape)}; wanted [{weights.shape[1]}]")
    biases = np.float32(share) * biases.ravel() + np.zeros(weights.shape[1], np.float32)
    return Layer(node.op_type, np.ascontiguousarray(weights), biases, scale)


def _array(tensor: Any) -> Array:
    if tensor.data_location or tensor.external_data:
        raise GraphError(
            f"weights {_shown(tensor.name)} lie in another file; wanted all of them in the graph"
        )
    if len(tensor.dims) > 2:
        raise GraphError(
            f"weights {_shown(tensor.name)} have {len(tensor.dims):,} dimensions; wanted 2 at most"
        )
    count = math.prod(tensor.dims)
    if (
        tensor.data_type != 1
        or min(tensor.dims, default=1) < 0
        or count not in (len(tensor.float_data), len(tensor.raw_data) / 4)
    ):
        raise GraphError(f"weights {_shown(tensor.name)} are not the float32 array that they claim to be")
    numbers = (
        np.frombuffer(tensor.raw_data, "<f4") if tensor.raw_data else np.array(tensor.float_data, np.float32)
    )
    return numbers.astype(np.float32).reshape(tensor.dims)


def _check(node: Any) -> None:
    if node.op_type not in OPERATORS or node.domain not in ("", "ai.onnx"):
        operator = f"{node.domain}.{node.op_type}".lstrip(".")
        raise GraphError(f"uses the operator {_shown(operator)}; allowed are {', '.join(OPERATORS)}")
    for attribute in node.attribute:
        if attribute.g or attribute.graphs or attribute.name not in ("transB", "alpha", "beta"):
            raise GraphError(
                f"has {_shown(attribute.name)} at a {node.op_type}; allowed are transB, alpha and beta"
            )


def _shown(text: str) -> str:
    return repr(text[:60])
