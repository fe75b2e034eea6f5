"""The process that runs pretrained networks: pictures come by standard input, results go to standard output.

A message is a line of JSON with the shape of a picture, and its values as float32. A process of its own keeps the
network's threads from torch's, which share no OpenMP runtime, and a damaged file from ending a run.
"""

import json
import os
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, BinaryIO, Protocol, TypeAlias

import numpy as np

from gsx.regenerators.pretrained.tiles import Network, Picture

Message: TypeAlias = tuple[dict[str, Any], Picture]
"""(fields, picture)"""


class Refusal(Exception):
    """Request that cannot be answered; the message ends with a remedy."""


class Runner(Protocol):
    """A function that opens a network for a number of threads, on a GPU by Vulkan or not."""

    def __call__(self, file: str, threads: int, vulkan: bool) -> Network:
        """Returns the network of a file; Refusal: it cannot be run."""
        ...


def ncnn_network(file: str, threads: int, vulkan: bool) -> Network:
    """Opens a .param file and its .bin file."""
    import ncnn

    if vulkan and not ncnn.get_gpu_count():
        raise Refusal("ncnn has no GPU with Vulkan. Set vulkan=false.")
    net = ncnn.Net()
    net.opt.num_threads, net.opt.use_vulkan_compute = threads, vulkan
    weights = os.path.splitext(file)[0] + ".bin"
    if net.load_param(file) or net.load_model(weights):
        raise ValueError("ncnn cannot read it")
    names = net.input_names(), net.output_names()
    refuse_several(*names)

    def run(image: Picture) -> Picture:
        extractor = net.create_extractor()
        extractor.input(names[0][0], ncnn.Mat(image))  # which refers to the memory of `image`
        status, result = extractor.extract(names[1][0])
        if status:
            raise ValueError(f"ncnn returns status {status} for a picture of {image.shape[2]} x {image.shape[1]} px")
        return np.array(result)

    return run


def onnx_network(file: str, threads: int, vulkan: bool) -> Network:
    """Opens an .onnx file whose input is [1, 3, h, w]."""
    import onnxruntime

    if vulkan:
        raise Refusal("ONNX files run on the CPU. Set vulkan=false.")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    inputs = session.get_inputs()
    refuse_several(inputs, session.get_outputs())
    return lambda image: session.run(None, {inputs[0].name: image[None]})[0][0]


def refuse_several(inputs: Sequence[object], outputs: Sequence[object]) -> None:
    """Raises ValueError unless a network has one input and one output."""
    if len(inputs) != 1 or len(outputs) != 1:
        raise ValueError(f"it has {len(inputs)} inputs and {len(outputs)} outputs; one of each is needed")


RUNNERS: dict[str, Runner] = {".param": ncnn_network, ".onnx": onnx_network}


@lru_cache(maxsize=4)
def network_of(file: str, threads: int, vulkan: bool) -> Network:
    """Opens a network once."""
    return RUNNERS[os.path.splitext(file)[1]](file, threads, vulkan)


def answer(request: dict[str, Any], image: Picture) -> Picture:
    """Runs the requested network on a picture."""
    network = network_of(request["file"], request["threads"], request["vulkan"])
    return np.ascontiguousarray(network(image), np.float32)


def send(stream: BinaryIO, fields: dict[str, Any], image: Picture | None = None) -> None:
    """Writes a message."""
    shape = {} if image is None else {"shape": list(image.shape)}
    stream.write(json.dumps(fields | shape).encode() + b"\n")
    if image is not None:
        stream.write(image.tobytes())
    stream.flush()


def receive(stream: BinaryIO) -> Message | None:
    """Reads a message, without a picture an empty one; None at the end of the stream, also within a message."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    fields = json.loads(line)
    shape = fields.get("shape", [0])
    size = 4 * int(np.prod(shape))
    content = stream.read(size)
    return (fields, np.frombuffer(content, np.float32).reshape(shape)) if len(content) == size else None


def serve() -> None:
    """Answers messages until standard input ends."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no reply
    while (message := receive(sys.stdin.buffer)) is not None:
        try:
            result = answer(*message)
        except Refusal as error:
            send(replies, {"error": f"{error}"})
        except Exception as error:  # of any library
            send(replies, {"error": f"{error}".partition("\n")[0].rstrip(".") + ". Give another network."})
        else:
            send(replies, {}, result)
