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

MAX_FIELDS, MAX_REST = (
    200_000,
    1 << 22,
)  # fields, and bytes beside tensors: libraries need a hundred times as much
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
VARINT, EIGHT, LENGTH, FOUR = 0, 1, 2, 5  # how a field is written


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
        onnxruntime = library("onnxruntime", self.where, extra="onnx")
        bound_memory()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what fails is raised
        options.add_session_config_entry("session.use_env_allocators", "1")
        try:
            self.session = onnxruntime.InferenceSession(
                self.content, options, providers=["CPUExecutionProvider"]
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
    waiting = [("model", content)]
    while waiting:
        kind, message = waiting.pop()
        at = 0
        while at < len(message):
            tag, at = _varint(message, at)
            number = tag >> 3
            written = tag & 7
            length, start = _length(message, at, written=written)
            at = start + length
            if tag >= 1 << 14 or not number or at > len(message):
                raise ValueError("its bytes are no ONNX")
            if (kind, number) in REFUSED:
                raise ValueError(f"it has {REFUSED[kind, number]}")
            fields += 1
            if written == LENGTH and number in PARTS.get(kind, {}):
                waiting.append((PARTS[kind][number], message[start:at]))
            elif kind != "tensor":
                rest += length
            if fields > MAX_FIELDS or rest > MAX_REST:
                raise ValueError(
                    f"it has more than {MAX_FIELDS} parts, or {MAX_REST} bytes beside its tensors"
                )


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number that begins at a place, and where it ends."""
    value = 0
    for place, byte in enumerate(message[at : at + 10]):
        value |= (byte & 127) << 7 * place
        if byte < 128:
            return value, at + place + 1
    raise ValueError("its bytes are no ONNX")


def _length(message: memoryview, at: int, written: int) -> tuple[int, int]:
    """The bytes of a field's content, and where they begin."""
    if written == VARINT:
        return 0, _varint(message, at)[1]
    if written == LENGTH:
        return _varint(message, at)
    if written in (FOUR, EIGHT):
        return 4 if written == FOUR else 8, at
    raise ValueError("its bytes are no ONNX")
