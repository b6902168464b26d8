"""A policy of an ONNX file, which may be a stranger's: arithmetic alone, of bounded
length and memory.

The file is looked through before a library reads it, as it is written: messages of
fields of Protocol Buffers.
"""

import os
from functools import cache
from typing import Any

import torch
from torch import Tensor

from e2rl.run.config import library
from e2rl.run.errors import InputError

MAX_FIELDS = 200_000  # for which libraries need a hundred times the memory
MAX_REST = 1 << 22  # bytes beside tensors
NO_ONNX = "its bytes are no ONNX"
MAX_MEMORY = 1 << 30  # bytes of all tensors while it runs
PARTS = {
    "model": {7: "graph"},
    "graph": {1: "node", 5: "tensor"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor"},
}
REFUSED = {
    ("attribute", 6): "a body of control flow (Loop, Scan, If)",
    ("attribute", 11): "bodies of control flow",
    ("model", 25): "functions (inline them)",
    ("graph", 15): "a sparse tensor",
    ("attribute", 22): "a sparse tensor",
    ("attribute", 23): "sparse tensors",
    ("tensor", 13): "data in another file (export with external_data=False)",
}
VARINT = 0  # ways in which a field is written
EIGHT = 1
LENGTH = 2
FOUR = 5


class OnnxPolicy:
    """A session of onnxruntime with one thread, in each process its own."""

    def __init__(self, content: bytes, where: str) -> None:
        """content: of the file; where: its name in messages. Raises InputError where it
        holds more than arithmetic."""
        self.content = content
        self.where = where
        try:
            check_arithmetic(memoryview(content))
        except ValueError as error:
            raise InputError(
                f"{where}: cannot be read as ONNX: {error}; export it again"
            ) from error
        self._open()

    def _open(self) -> None:
        onnxruntime = library(
            "onnxruntime",
            self.where,
            extra="onnx",
        )
        bound_memory()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what fails is raised
        options.add_session_config_entry("session.use_env_allocators", "1")
        try:
            self.session = onnxruntime.InferenceSession(
                self.content,
                options,
                providers=["CPUExecutionProvider"],
            )
        except Exception as error:  # onnxruntime's are of many kinds
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"{self.where}: cannot be read as ONNX ({reason}); export it again"
            ) from error
        self.name = self.session.get_inputs()[0].name
        self._process = os.getpid()

    def __call__(self, observation: Tensor) -> Any:
        if self._process != os.getpid():  # forked
            self._open()
        (action,) = self.session.run(None, {self.name: observation.numpy()})
        return torch.as_tensor(action)


@cache
def bound_memory() -> None:
    """Let all sessions of this process have MAX_MEMORY bytes of tensors together."""
    import onnxruntime as ort

    info = ort.OrtMemoryInfo(
        "Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
    )
    ort.create_and_register_allocator(info, ort.OrtArenaCfg({"max_mem": MAX_MEMORY}))


def check_arithmetic(content: memoryview) -> None:
    """Raises ValueError where the bytes of a ModelProto are none, are too many, or hold
    one of REFUSED."""
    fields = 0
    rest = 0
    messages = [("model", content)]
    while messages:
        kind, message = messages.pop()
        position = 0
        while position < len(message):
            tag, position = _varint(message, position)
            number = tag >> 3
            wire = tag & 7
            length, start = _length(message, position, wire=wire)
            position = start + length
            if tag >= 1 << 14 or not number or position > len(message):
                raise ValueError(NO_ONNX)
            if (kind, number) in REFUSED:
                raise ValueError(f"it has {REFUSED[kind, number]}")
            fields += 1
            if wire == LENGTH and number in PARTS.get(kind, {}):
                messages.append((PARTS[kind][number], message[start:position]))
            elif kind != "tensor":
                rest += length
            if fields > MAX_FIELDS or rest > MAX_REST:
                raise ValueError(
                    f"it has more than {MAX_FIELDS} parts, or {MAX_REST} bytes beside "
                    "its tensors"
                )


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """The number that begins at a position, and where it ends."""
    value = 0
    for place, byte in enumerate(message[position : position + 10]):
        value |= (byte & 127) << 7 * place
        if byte < 128:
            return value, position + place + 1
    raise ValueError(NO_ONNX)


def _length(
    message: memoryview,
    position: int,
    wire: int,
) -> tuple[int, int]:
    """The bytes of a field's content, and where they begin."""
    if wire == VARINT:
        return 0, _varint(message, position)[1]
    if wire == LENGTH:
        return _varint(message, position)
    if wire in (FOUR, EIGHT):
        return 4 if wire == FOUR else 8, position
    raise ValueError(NO_ONNX)
