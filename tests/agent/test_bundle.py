"""Protects policies as data: a bundle flies its network's actions, and an invalid bundle is refused in one
line.
"""

import math
import os
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from agent import network
from agent.bundle import (
    FORMAT,
    GRAPH,
    MOST_BYTES,
    PAGE,
    BundleError,
    CurvePoint,
    Page,
    flies_anywhere,
    load,
    read,
    write,
)
from agent.observation import SCHEMAS
from agent.planning.moves import HeadingAndStep, Headings, Move, Reach
from agent.policies import SHIPPED, choose
from agent.trials.rollout import mission
from link.bus.messages import Belief, Particles

Layers = list[tuple[np.ndarray, np.ndarray]]
Seen = tuple[Belief, Particles]


def layers(*widths: int, seed: int = 0) -> Layers:
    """Weights (out, in) and biases of a network with these widths."""
    draws = np.random.default_rng(seed)
    return [
        (
            draws.normal(0, 1 / math.sqrt(a), (b, a)).astype(np.float32),
            draws.normal(0, 0.1, b).astype(np.float32),
        )
        for a, b in pairwise(widths)
    ]


def said(network: Layers, observation: np.ndarray) -> np.ndarray:
    """The network's output: rectified linear layers, the last one linear."""
    flowing = observation.astype(np.float64)
    for k, (weight, bias) in enumerate(network):
        flowing = weight @ flowing + bias
        flowing = np.maximum(flowing, 0) if k < len(network) - 1 else flowing
    return flowing


def onnx_of(
    nodes: Sequence[Any], takes: Sequence[int], gives: Sequence[int], weights: Sequence[Any] = ()
) -> bytes:
    """A graph from `observation` to `said`, not checked by onnx."""
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
        for name, shape in (("observation", takes), ("said", gives))
    ]
    made = helper.make_graph(nodes, "policy", ports[:1], ports[1:], weights)
    return helper.make_model(
        made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    ).SerializeToString()


def onnx_of_layers(network: Layers) -> bytes:
    """The graph of a network of rectified linear layers."""
    nodes, weights, flowing = [], [], "observation"
    for k, (weight, bias) in enumerate(network):
        last = k == len(network) - 1
        weights += [numpy_helper.from_array(weight, f"w{k}"), numpy_helper.from_array(bias, f"b{k}")]
        nodes.append(
            helper.make_node("Gemm", [flowing, f"w{k}", f"b{k}"], ["said" if last else f"sum{k}"], transB=1)
        )
        if not last:
            nodes.append(helper.make_node("Relu", [f"sum{k}"], [f"layer{k}"]))
        flowing = f"layer{k}"
    return onnx_of(nodes, [1, network[0][0].shape[1]], [1, len(network[-1][1])], weights)


def page_of(schema: str = "paper", move: Move | None = None, **changes: Any) -> Page:
    """A valid page with these changes."""
    fields = {
        "format": FORMAT,
        "algorithm": "by hand",
        "schema": schema,
        "schema_version": SCHEMAS[schema].version,
        "observation": SCHEMAS[schema].size,
        "move": move or Headings(4),
        "seed": 3,
        "training": {"layers": [8]},
        "curve": [CurvePoint(10, 0.5, 0.25, None), CurvePoint(20, 1.0, 1.0, 31.5)],
        "evaluation": {},
    }
    return Page(**(fields | changes))


def a_bundle(path: Path, schema: str = "paper", move: Move | None = None, seed: int = 0) -> Layers:
    """Write a bundle of a small network; returns its weights."""
    page = page_of(schema, move)
    network = layers(page.observation, 8, page.move.outputs, seed=seed)
    write(path, page, onnx_of_layers(network))
    return network


@pytest.fixture(scope="module")
def beliefs() -> list[Seen]:
    """All beliefs of a few missions."""
    return [
        (step.belief, step.particles)
        for seed in (1, 2)
        for step in mission(seed, "random", 200, 0.5, 12).steps
    ]


def direction(frame: np.ndarray, angle: float) -> np.ndarray:
    """The unit vector at an angle in a frame. Its y axis is left of its x axis, or right of it if the
    frame is mirrored.
    """
    ahead, left = frame[:2], np.array([-frame[1], frame[0]])
    return math.cos(angle) * ahead + math.sin(angle) * frame[2] * left


@pytest.mark.one_in(5)
@pytest.mark.parametrize("schema", SCHEMAS)
@pytest.mark.parametrize(
    "move", [Headings(4), Headings(16, 0.5), HeadingAndStep(), HeadingAndStep(2.0)], ids=repr
)
def test_a_bundle_flies_what_its_network_says(
    tmp_path: Path, beliefs: list[Seen], schema: str, move: Move
) -> None:
    flown = set()
    for seed, (belief, particles) in product(range(4), beliefs):
        path = tmp_path / f"{seed}.zip"
        network = a_bundle(path, schema, move, seed)
        observation, frame = SCHEMAS[schema].see(belief, particles)
        action = said(network, observation)
        if isinstance(move, Headings):
            moved = move.step_m * direction(frame, 2 * math.pi * int(action.argmax()) / move.count)
        else:
            heading, share = np.clip(action, -1, 1)
            moved = move.step_m * (share + 1) / 2 * direction(frame, math.pi * heading)
        wanted = np.clip(np.add(belief.position, moved), 0, 30)
        waypoint = load(path).waypoint(belief, particles, Reach(), np.random.default_rng())
        assert waypoint == pytest.approx(wanted, abs=1e-5)
        assert (
            choose(str(path), belief, particles, 0, Reach())
            == waypoint
            == tuple(np.float32(waypoint).tolist())
        )
        flown.add(tuple(np.round(moved, 3)))
    assert len(flown) > 1


def test_a_bundle_flies_anywhere_if_what_it_sees_knows_no_problem() -> None:
    """Which observations do so is told twice: looking into a bundle compiles none."""
    for name, schema in SCHEMAS.items():
        assert flies_anywhere(page_of(name)) == schema.anywhere


def test_what_is_written_is_read(tmp_path: Path) -> None:
    page, graph = page_of("polar", HeadingAndStep(0.5)), b"anything"
    write(tmp_path / "a.zip", page, graph)
    assert read(tmp_path / "a.zip") == (page, graph)


def test_the_same_parts_give_the_same_bytes(tmp_path: Path) -> None:
    for name, seed in (("a.zip", 0), ("b.zip", 0), ("c.zip", 1)):
        a_bundle(tmp_path / name, seed=seed)
    a, b, c = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert a == b
    assert a != c


def test_a_bundle_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    a_bundle(tmp_path / "a.zip")
    before = (tmp_path / "a.zip").read_bytes()
    with pytest.raises(TypeError):
        write(tmp_path / "a.zip", page_of(), 17)  # type: ignore[arg-type]
    assert (tmp_path / "a.zip").read_bytes() == before


@pytest.mark.one_in(4)
@pytest.mark.slow
@pytest.mark.parametrize("kinds", [("ReLU",), ("Tanh", "Tanh"), ("ReLU", "Tanh", "Tanh")], ids=" ".join)
@pytest.mark.parametrize("squashed", [False, True])
def test_a_graph_says_what_torch_says(tmp_path: Path, kinds: tuple[str, ...], squashed: bool) -> None:
    import onnxruntime
    import torch

    from agent.learn.train.export import graph

    torch.manual_seed(5)
    widths = [12, *(9 + k for k in range(len(kinds))), 3]
    modules: list[torch.nn.Module] = []
    for a, b, kind in zip(widths[:-2], widths[1:-1], kinds, strict=True):
        modules += [torch.nn.Linear(a, b), getattr(torch.nn, kind)()]
    modules += [torch.nn.Linear(*widths[-2:]), *([torch.nn.Tanh()] if squashed else [])]
    session = onnxruntime.InferenceSession(graph(modules))
    for observation in np.random.default_rng(0).normal(0, 3, (50, 1, 12)).astype(np.float32):
        (ours,) = session.run(None, {"observation": observation})
        with torch.no_grad():
            theirs = torch.nn.Sequential(*modules)(torch.from_numpy(observation)).numpy()
        assert ours == pytest.approx(theirs, abs=1e-5)


@pytest.mark.parametrize("policy", SHIPPED)
def test_a_shipped_network_says_what_onnxruntime_makes_of_its_file(policy: str) -> None:
    import onnxruntime

    page, graph = read(SHIPPED[policy])
    flown, session = load(SHIPPED[policy]), onnxruntime.InferenceSession(graph)
    for observation in np.random.default_rng(3).normal(0, 1, (100, page.observation)).astype(np.float32):
        (theirs,) = session.run(None, {session.get_inputs()[0].name: observation[None]})
        # Both add float32 numbers, in different orders: 184 and 256 terms, each rounded to 6e-8 of the sum so
        # far.
        assert flown.said(observation) == pytest.approx(theirs, rel=1e-5, abs=1e-5 * float(abs(theirs).max()))


def test_a_layer_adds_its_products_in_the_order_of_the_row() -> None:
    draws = np.random.default_rng(4)
    for takes, gives in ((1, 1), (3, 2), (4, 5), (11, 3), (64, 40)):
        weights, biases = (
            draws.normal(0, 1, (takes, gives)).astype(np.float32),
            draws.normal(0, 1, gives).astype(np.float32),
        )
        row = draws.normal(0, 1, takes).astype(np.float32)
        wanted = np.zeros(gives, np.float32)
        for number, its_weights in zip(row, weights, strict=True):
            wanted = wanted + number * its_weights  # each product and each sum rounded to float32
        (said,) = (network.said([network.Layer("Gemm", weights, biases, 0.5)], row),)
        assert (said == np.float32(0.5) * wanted + biases).all()


def test_tanh_is_right_to_a_float32() -> None:
    row = np.array([0.0, 1e-30, 1e-4, 0.1, 0.5, 1.0, 3.0, 9.0, 100.0, np.inf], np.float32)
    wanted = [math.tanh(x) for x in row.tolist()]
    assert network.said([network.Layer("Tanh")], row) == pytest.approx(wanted, rel=1e-7, abs=1e-16)
    assert network.said([network.Layer("Tanh")], -row) == pytest.approx(
        [-x for x in wanted], rel=1e-7, abs=1e-16
    )
    assert np.isnan(network.said([network.Layer("Tanh")], np.array([np.nan], np.float32))).all()


def test_a_layer_without_an_onnx_is_refused() -> None:
    import torch

    from agent.learn.train.export import graph

    with pytest.raises(TypeError, match="no ONNX for GELU"):
        graph([torch.nn.Linear(3, 4), torch.nn.GELU(), torch.nn.Linear(4, 2)])


def refusal(path: Path) -> str:
    """The text with which a bundle is refused."""
    with pytest.raises(BundleError) as refused:
        load(path)
    line = str(refused.value)
    assert len(line.splitlines()) == 1, line
    assert len(line) < 400
    return line


WANTED = f"wanted a zip file of {PAGE} and {GRAPH}"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "there is no such file"),
        (b"", WANTED),
        (b"PK", WANTED),
        (b"steer north", WANTED),
        (b"\x80\x04\x95" * 100, WANTED),
    ],
    ids=["no file", "empty", "two bytes", "text", "a pickle"],
)
def test_what_is_no_zip_is_refused(tmp_path: Path, content: bytes | None, words: str) -> None:
    if content is not None:
        (tmp_path / "a.zip").write_bytes(content)
    assert words in refusal(tmp_path / "a.zip")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    assert WANTED in refusal(tmp_path)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.zip")
    assert refusal(tmp_path / "pipe.zip") == f"not a bundle: it is not a file; {WANTED}"


def test_a_file_that_was_cut_off_is_refused_wherever_that_was(tmp_path: Path) -> None:
    a_bundle(tmp_path / "whole.zip")
    whole = (tmp_path / "whole.zip").read_bytes()
    for kept in {*range(0, len(whole), 61), *range(len(whole) - 60, len(whole))}:
        (tmp_path / "cut.zip").write_bytes(whole[:kept])
        assert WANTED in refusal(tmp_path / "cut.zip")


@pytest.mark.slow
def test_a_changed_byte_changes_nothing_or_is_refused(tmp_path: Path) -> None:
    a_bundle(tmp_path / "whole.zip")
    whole, parts = (tmp_path / "whole.zip").read_bytes(), read(tmp_path / "whole.zip")
    draws = np.random.default_rng(0)
    lines = []
    for place in range(len(whole)):
        for mask in {1 << int(draws.integers(8)), 0xFF, int(draws.integers(1, 256))}:
            changed = bytearray(whole)
            changed[place] ^= mask
            (tmp_path / "changed.zip").write_bytes(changed)
            try:
                assert read(tmp_path / "changed.zip") == parts
            except BundleError as error:
                lines.append(str(error))
    assert all(len(line.splitlines()) == 1 for line in lines)
    assert len(lines) > len(whole)  # changes of dates, permissions and the like are harmless


def zipped(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr({"page": PAGE, "graph": GRAPH}[name], content)


@pytest.mark.parametrize(("member", "missing"), [("page", GRAPH), ("graph", PAGE)])
def test_a_missing_part_is_named(tmp_path: Path, member: str, missing: str) -> None:
    zipped(tmp_path / "a.zip", **{member: b"{}"})
    assert f"it has no {missing}; {WANTED}" in refusal(tmp_path / "a.zip")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda page: [], "Expected `object`, got `array`"),
        (lambda page: page | {"colour": "red"}, "unknown field `colour`"),
        (lambda page: page | {"format": 2}, f"bundle format 2; wanted {FORMAT}"),
        (lambda page: page | {"format": 2, "colour": "red"}, f"bundle format 2; wanted {FORMAT}"),
        (lambda page: page | {"format": "one"}, "Expected `int`, got `str` - at `$.format`"),
        (
            lambda page: {name: value for name, value in page.items() if name != "seed"},
            "missing required field `seed`",
        ),
        (lambda page: page | {"move": {"kind": "teleport"}}, "Invalid value 'teleport' - at `$.move.kind`"),
        (
            lambda page: page | {"move": {"kind": "headings", "count": 4.5}},
            "Expected `int`, got `float` - at `$.move.count`",
        ),
        (
            lambda page: page | {"move": {"kind": "headings", "count": 4, "speed": 3}},
            "unknown field `speed` - at `$.move`",
        ),
        (
            lambda page: page | {"move": {"kind": "headings", "count": 0}},
            "move of 0 headings; wanted from 2 to 1024",
        ),
        (
            lambda page: page | {"move": {"kind": "headings", "count": 4, "step_m": -1}},
            "move of -1 m; wanted above 0 up to 10",
        ),
        (
            lambda page: page | {"move": {"kind": "heading and step", "step_m": 1e9}},
            "move of 1e+09 m; wanted above 0 up to 10",
        ),
        (
            lambda page: page | {"schema": "crystal ball"},
            "observation 'crystal ball' is not known; wanted paper or polar or polar-2",
        ),
        (
            lambda page: page | {"schema_version": 7},
            "observation 'paper' version 7 of 5 numbers; wanted version 1 of 5",
        ),
        (
            lambda page: page | {"observation": 6},
            "observation 'paper' version 1 of 6 numbers; wanted version 1 of 5",
        ),
        (lambda page: page | {"observation": 0}, "Expected `int` >= 1 - at `$.observation`"),
        (lambda page: page | {"curve": [{"steps": 1}]}, "missing required field `ceased` - at `$.curve[0]`"),
    ],
)
def test_a_page_that_does_not_fit_is_refused(
    tmp_path: Path, change: Callable[[Any], Any], words: str
) -> None:
    page = msgspec.to_builtins(page_of())
    zipped(tmp_path / "a.zip", page=msgspec.json.encode(change(page)), graph=onnx_of_layers(layers(5, 8, 4)))
    assert words in refusal(tmp_path / "a.zip")


@pytest.mark.parametrize(
    "page",
    [b"", b"{", b'{"format": NaN}', b"\xff\xfe", b"\x00" * 40, b"[" * 100_000, b'{"format": 1, "format"'],
    ids=["empty", "a bracket", "NaN", "no UTF-8", "zeros", "deep", "cut off"],
)
def test_a_page_that_is_no_json_is_refused(tmp_path: Path, page: bytes) -> None:
    zipped(tmp_path / "a.zip", page=page, graph=onnx_of_layers(layers(5, 8, 4)))
    assert refusal(tmp_path / "a.zip").startswith(f"{PAGE}: ")


ALLOWED = "allowed are Gemm, Relu, Tanh"
ZEROS = numpy_helper.from_array(np.zeros((4, 5), np.float32), "w")
GEMM = helper.make_node("Gemm", ["observation", "w"], ["said"], transB=1)


def elsewhere(name: str) -> Any:
    """Weights stored in another file."""
    said = onnx.StringStringEntryProto(key="location", value=name)
    return onnx.TensorProto(
        name="w",
        data_type=TensorProto.FLOAT,
        dims=[4, 5],
        data_location=TensorProto.EXTERNAL,
        external_data=[said],
    )


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        (b"", "is not an ONNX graph"),
        (b"steer north", "is not an ONNX graph"),
        (onnx_of_layers(layers(5, 8, 4))[:200], "is not an ONNX graph"),
        (
            onnx_of([helper.make_node("Relu", ["observation"], ["other"])], [1, 5], [1, 5]),
            "gives 'said'; wanted what its last node",
        ),
        (
            onnx_of([helper.make_node("Clairvoyance", ["observation"], ["said"])], [1, 5], [1, 4]),
            f"'Clairvoyance'; {ALLOWED}",
        ),
        (
            onnx_of([helper.make_node("Relu", ["observation"], ["said"], domain="a.b")], [1, 5], [1, 5]),
            f"'a.b.Relu'; {ALLOWED}",
        ),
        (
            onnx_of([GEMM], [1, 5], [1, 4], [elsewhere("/etc/passwd")]),
            "weights 'w' lie in another file; wanted all of them in the graph",
        ),
        (onnx_of_layers(layers(6, 8, 4)), "takes arrays of [[1, 6]]; wanted one, of [1, 5]"),
        (onnx_of_layers(layers(5, 8, 3)), "gives arrays of [[1, 3]]; wanted one, of [1, 4]"),
        (
            onnx_of([helper.make_node("Relu", ["observation"], ["said"])], [5], [5]),
            "takes arrays of [[5]]; wanted one, of [1, 5]",
        ),
        (
            onnx_of([helper.make_node("Relu", ["observation"], ["said"])], ["many", "wide"], ["many", 4]),
            "['many', 'wide']",
        ),
        (
            onnx_of([GEMM], [1, 5], [1, 4], [numpy_helper.from_array(np.zeros((4, 6), np.float32), "w")]),
            "of 5 numbers with weights for 6",
        ),
        (
            onnx_of([GEMM], [1, 5], [1, 4], [numpy_helper.from_array(np.zeros(20, np.float32), "w")]),
            "weights of [20]; wanted a matrix",
        ),
        (
            onnx_of(
                [helper.make_node("Gemm", ["observation", "w", "b"], ["said"], transB=1)],
                [1, 5],
                [1, 4],
                [ZEROS, numpy_helper.from_array(np.zeros(3, np.float32), "b")],
            ),
            "biases of [3]; wanted [4]",
        ),
        (
            onnx_of([helper.make_node("Gemm", ["observation"], ["said"])], [1, 5], [1, 4]),
            "a Gemm with 0 weights and 1 outputs",
        ),
        (
            onnx_of([helper.make_node("Gemm", ["observation", "", "w"], ["said"])], [1, 5], [1, 4], [ZEROS]),
            "a Gemm of other things than",
        ),
        (
            onnx_of([GEMM], [1, 5], [1, 4], [numpy_helper.from_array(np.zeros((1, 4, 5), np.float32), "w")]),
            "have 3 dimensions; wanted 2",
        ),
        (onnx_of([GEMM], [1] * 1000, [1, 4], [ZEROS]), "takes arrays of [[1, 1, 1, 1"),
        (onnx_of([GEMM], [2, 5], [2, 4], [ZEROS]), "takes arrays of [[2, 5]]; wanted one, of [1, 5]"),
        (onnx_of([helper.make_node("Shape", ["observation"], ["said"])], [1, 5], [1, 4]), ALLOWED),
        (
            onnx_of_layers([(np.full((4, 5), np.nan, np.float32), np.zeros(4, np.float32))]),
            "gives NaN; wanted numbers",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "graph",
)
def test_a_graph_that_does_not_fit_is_refused(
    tmp_path: Path, graph: bytes, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.zip", page_of(), graph)
    line = refusal(tmp_path / "a.zip")
    assert line.startswith(GRAPH)
    assert words in line
    assert capfd.readouterr() == ("", "")


def test_a_graph_takes_no_weights_from_a_file_that_happens_to_lie_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights.bin").write_bytes(bytes(4 * 4 * 5))
    write(tmp_path / "a.zip", page_of(), onnx_of([GEMM], [1, 5], [1, 4], [elsewhere("weights.bin")]))
    assert "weights 'w' lie in another file" in refusal(tmp_path / "a.zip")


# ---- graphs made to take all time or memory ----


def endless() -> bytes:
    """A graph whose only node is a loop that never ends: well below a kilobyte."""
    true = helper.make_tensor("true", TensorProto.BOOL, [], [True])
    ports = [
        helper.make_tensor_value_info(name, kind, [])
        for name, kind in (("i", TensorProto.INT64), ("go", TensorProto.BOOL))
    ]
    onward = helper.make_tensor_value_info("on", TensorProto.BOOL, [])
    body = helper.make_graph([helper.make_node("Identity", ["go"], ["on"])], "body", ports, [onward])
    return onnx_of(
        [helper.make_node("Loop", ["", "true"], [], body=body), GEMM], [1, 5], [1, 4], [true, ZEROS]
    )


def of_function() -> bytes:
    """A graph with a function of its own that takes the name of an allowed operator."""
    model = onnx.load_from_string(onnx_of([GEMM], [1, 5], [1, 4], [ZEROS]))
    inside = [helper.make_node("Loop", ["x"], ["y"])]
    model.functions.append(
        helper.make_function("", "Gemm", ["x"], ["y"], inside, [helper.make_opsetid("", 17)])
    )
    return bytes(model.SerializeToString())


def attributed(**attributes: Any) -> bytes:
    return onnx_of(
        [helper.make_node("Gemm", ["observation", "w"], ["said"], **attributes)], [1, 5], [1, 4], [ZEROS]
    )


def claiming_shape(*shape: int) -> bytes:
    return onnx_of(
        [GEMM],
        [1, 5],
        [1, 4],
        [onnx.TensorProto(name="w", data_type=TensorProto.FLOAT, dims=shape, raw_data=bytes(80))],
    )


WIDE = numpy_helper.from_array(np.zeros((2**16, 1), np.float32), "wide")
CONSTANT = "of other things than the layer before it, with weights and biases of the graph"


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        (endless(), f"uses the operator 'Loop'; {ALLOWED}"),
        (
            onnx_of([helper.make_node("ConstantOfShape", ["w"], ["said"])], [1, 5], [1, 4], [ZEROS]),
            f"'ConstantOfShape'; {ALLOWED}",
        ),
        (of_function(), "has functions of its own, which are not allowed"),
        (attributed(transA=1), "has 'transA' at a Gemm; allowed are transB, alpha and beta"),
        (attributed(transB=helper.make_graph([], "hidden", [], [])), "has 'transB' at a Gemm"),
        (claiming_shape(2**40, 2**40), "weights 'w' are not the float32 array that they claim to be"),
        (claiming_shape(-4, -5), "weights 'w' are not the float32 array that they claim to be"),
        (
            onnx_of([helper.make_node("Gemm", ["wide", "wide"], ["said"], transB=1)], [1, 5], [1, 4], [WIDE]),
            CONSTANT,
        ),
        (onnx_of([helper.make_node("Relu", ["wide"], ["h"]), GEMM], [1, 5], [1, 4], [WIDE, ZEROS]), CONSTANT),
        (onnx_of([GEMM] * 101, [1, 5], [1, 4], [ZEROS]), "has 101 nodes; wanted 100 at most"),
    ],
    ids=lambda value: value if isinstance(value, str) else "graph",
)
def test_a_graph_that_could_take_all_time_or_memory_is_not_opened(
    tmp_path: Path, graph: bytes, words: str
) -> None:
    assert len(graph) < 300_000
    write(tmp_path / "a.zip", page_of(), graph)
    line = refusal(tmp_path / "a.zip")
    assert line.startswith(GRAPH)
    assert words in line


def test_small_weights_that_are_used_again_and_again_count_each_time(tmp_path: Path) -> None:
    square = numpy_helper.from_array(np.zeros((600, 600), np.float32), "w1")
    wide, narrow = (
        numpy_helper.from_array(np.zeros((5, 600), np.float32), "w0"),
        numpy_helper.from_array(np.zeros((600, 4), np.float32), "w2"),
    )
    names = ["observation", *(f"h{k}" for k in range(50)), "said"]
    nodes = [
        helper.make_node("Gemm", [a, f"w{(k > 0) + (k == 50)}"], [b])
        for k, (a, b) in enumerate(pairwise(names[:51] + names[-1:]))
    ]
    write(tmp_path / "a.zip", page_of(), onnx_of(nodes, [1, 5], [1, 4], [wide, square, narrow]))
    assert (
        f"needs {600 * (5 + 49 * 600 + 4):,} multiplications for a decision; wanted 16,777,216 at most"
        in refusal(tmp_path / "a.zip")
    )


def test_weights_that_are_used_again_and_again_fill_no_memory(tmp_path: Path) -> None:
    square = numpy_helper.from_array(np.zeros((1000, 1000), np.float32), "w")
    names = ["observation", *(f"h{k}" for k in range(98)), "said"]
    nodes = [helper.make_node("Gemm", [a, "w"], [b], transB=1) for a, b in pairwise(names)]
    write(tmp_path / "a.zip", page_of(), onnx_of(nodes, [1, 5], [1, 4], [square]))
    tracemalloc.start()
    try:
        assert "needs 99,000,000 multiplications" in refusal(tmp_path / "a.zip")
        assert tracemalloc.get_traced_memory()[1] < 10 * 1000 * 1000 * 4
    finally:
        tracemalloc.stop()


def test_a_graph_may_leave_the_number_of_rows_open(tmp_path: Path) -> None:
    write(tmp_path / "a.zip", page_of(), onnx_of([GEMM], ["rows", 5], ["rows", 4], [ZEROS]))
    load(tmp_path / "a.zip")


@pytest.mark.parametrize("move", [Headings(5), HeadingAndStep()], ids=repr)
def test_a_network_that_says_nan_in_flight_flies_nowhere(
    tmp_path: Path, beliefs: list[Seen], move: Move
) -> None:
    """Infinity less infinity, of numbers that are zero in the trial run."""
    huge = np.full((2, 5), 3e38, np.float32), np.tile(np.float32([3e38, -3e38]), (move.outputs, 1))
    network = [(weight, np.zeros(len(weight), np.float32)) for weight in huge]
    write(tmp_path / "a.zip", page_of(move=move), onnx_of_layers(network))
    with pytest.raises(
        ValueError, match=f"policy .*a.zip failed: BundleError: {GRAPH} gives NaN; wanted numbers"
    ):
        choose(str(tmp_path / "a.zip"), *beliefs[0], 0, Reach())


def claiming(path: Path, size: int) -> None:
    """Make the last member of a zip claim a wrong size."""
    content = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x01\x02", 24), (b"PK\x03\x04", 22)):
        at = content.rindex(signature) + offset
        content[at : at + 4] = struct.pack("<I", size)
    path.write_bytes(content)


def test_a_part_that_claims_to_be_huge_is_not_read(tmp_path: Path) -> None:
    zipped(tmp_path / "a.zip", page=msgspec.json.encode(page_of()), graph=b"steer north")
    claiming(tmp_path / "a.zip", MOST_BYTES + 1)
    assert refusal(tmp_path / "a.zip") == f"{GRAPH} is larger than 64 MiB"


def test_a_part_that_is_larger_than_it_claims_fills_no_memory(tmp_path: Path) -> None:
    zipped(tmp_path / "a.zip", page=msgspec.json.encode(page_of()), graph=bytes(2 * MOST_BYTES))
    assert (tmp_path / "a.zip").stat().st_size < 2**18
    claiming(tmp_path / "a.zip", 1000)
    tracemalloc.start()
    try:
        assert WANTED in refusal(tmp_path / "a.zip")
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_compression_that_could_hide_a_bomb_is_refused(tmp_path: Path, method: int) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", method) as file:
        file.writestr(PAGE, msgspec.json.encode(page_of()))
        file.writestr(GRAPH, onnx_of_layers(layers(5, 8, 4)))
    assert refusal(tmp_path / "a.zip") == f"{PAGE} is compressed by method {method}; wanted deflate, or none"


FLY = """
import sys
for hidden in ("torch", "gymnasium", "stable_baselines3", "onnx", "tensorboard"):
    sys.modules[hidden] = None
from agent.trials.rollout import rollout
flown, trace = rollout(1, sys.argv[1], particles=100, budget=9)
print(len(trace))
"""

LOAD = """
import sys
from pathlib import Path
from agent.policies import SHIPPED, choose
from agent.planning.moves import Reach
from agent.trials.rollout import mission
step = next(mission(1, "random", 100, 0.5, 1).steps)
def watch(event, arguments):
    if event.startswith(("pickle.", "marshal.", "exec", "subprocess.", "os.system", "socket.", "ctypes.")):
        print(event, arguments)
for path in sys.argv[1:]:
    choose(path, step.belief, step.particles, 0, Reach())
    print("flown")
    sys.addaudithook(watch)  # from here on, all modules are loaded
"""


@pytest.mark.slow
def test_flying_a_bundle_needs_nothing_that_training_needs(tmp_path: Path) -> None:
    a_bundle(tmp_path / "policy.zip", "polar", Headings(16))
    ended = subprocess.run(
        [sys.executable, "-c", FLY, str(tmp_path / "policy.zip")], capture_output=True, text=True, timeout=400
    )
    assert (ended.returncode, ended.stdout) == (0, "10\n"), ended.stderr


@pytest.mark.slow
def test_flying_a_bundle_unpickles_and_executes_nothing(tmp_path: Path) -> None:
    bundles = [str(tmp_path / "a.zip"), str(tmp_path / "b.zip")]
    for path in bundles:
        a_bundle(Path(path), "polar", HeadingAndStep())
    ended = subprocess.run(
        [sys.executable, "-c", LOAD, *bundles], capture_output=True, text=True, timeout=400
    )
    assert (ended.returncode, ended.stdout) == (0, "flown\nflown\n"), ended.stderr
