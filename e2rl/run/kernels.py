"""Pure functions of tensors that run as one compiled kernel each, where that is switched on.

    @kernel("G P 2", "G K 2", "G K:bool")
    def function(route, points, counts): ...

Eager PyTorch is the reference: a kernel does the same operations in the same order, as a few loops of machine code
instead of a pass over memory for each. `AOTInductor` makes it, once on a machine; it is kept in the cache under a name
that its source, PyTorch and the processor have in it, so that a process that finds it there only loads it (ms).
"""

import hashlib
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from e2rl.run.errors import InputError
from e2rl.run.files import locked

KERNELS: dict[str, "Kernel"] = {}
"""All kernels of the modules that are imported, by name."""
COMPILERS = ("c++", "g++", "clang++")
FIRST = 17  # sizes of the tensors that a kernel is traced with: distinct primes from here on
_on = False


class Kernel:
    """A function of tensors, compiled where `switch` is on: on the CPU, of the types declared, without gradients.

    shapes: of each argument, names of sizes that vary and numbers that do not, then ":" and a type (float32 by
    default). Equal names are equal sizes, none of them 0.
    """

    def __init__(self, function: Callable[..., Any], shapes: tuple[str, ...]) -> None:
        self.function = function
        self.name = f"{function.__module__}.{function.__qualname__}"
        self.sizes = [shape.partition(":")[0].split() for shape in shapes]
        self.vectors = [len(names) > 1 and names[-1].isdigit() for names in self.sizes]
        self.types = [getattr(torch, shape.partition(":")[2] or "float32") for shape in shapes]
        self.__doc__ = function.__doc__
        KERNELS[self.name] = self

    def __call__(self, *given: Tensor) -> Any:
        """What the function returns: a tensor or a tuple of them."""
        if not _on or not self._fits(given):
            return self.function(*given)
        apart = zip(given, self.vectors, strict=True)
        found = self._run([(value.movedim(-1, 0) if vector else value).contiguous() for value, vector in apart])
        return found[0] if len(found) == 1 else tuple(found)

    def _fits(self, given: tuple[Tensor, ...]) -> bool:
        size: dict[str, int] = {}
        for value, names, kind in zip(given, self.sizes, self.types, strict=True):
            if value.dtype != kind or value.is_cuda or value.dim() != len(names):
                return False
            for name, length in zip(names, value.shape, strict=True):
                if length == 0 or length != (int(name) if name.isdigit() else size.setdefault(name, length)):
                    return False
        return not (torch.is_grad_enabled() and any(value.requires_grad for value in given))

    @cached_property
    def file(self) -> Path:
        """Where the compiled kernel lies."""
        mark = hashlib.sha256(repr(machine()).encode())
        for module in sorted(_sources(sys.modules[self.function.__module__]), key=lambda module: module.__name__):
            mark.update(Path(str(module.__file__)).read_bytes())
        return cache_folder() / "kernels" / f"{self.function.__qualname__}-{mark.hexdigest()[:32]}.pt2"

    @cached_property
    def _run(self) -> Callable[[list[Tensor]], list[Tensor]]:
        self.compile()
        return torch._inductor.aoti_load_package(str(self.file), run_single_threaded=True).loader.run

    def compile(self) -> None:
        """Compile the kernel, where it is not in the cache. Raises InputError without a C++ compiler."""
        if self.file.exists():
            return
        names = (os.environ.get("CXX"), *COMPILERS)
        if not any(name and shutil.which(name) for name in names):
            raise InputError(f"compile=true: no C++ compiler found (CXX, {', '.join(COMPILERS)}): install one, or compile=false")
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with locked(self.file.with_suffix(".lock")):
            if not self.file.exists():
                self._compile()

    def _compile(self) -> None:
        free = sorted({name for names in self.sizes for name in names if not name.isdigit()})
        size = dict(zip(free, _primes(), strict=False))
        examples, dynamic = [], []
        for names, kind, vector in zip(self.sizes, self.types, self.vectors, strict=True):
            names = [names[-1], *names[:-1]] if vector else names
            examples.append(torch.zeros([size.get(name) or int(name) for name in names], dtype=kind))
            dynamic.append({at: torch.export.Dim.DYNAMIC for at, name in enumerate(names) if name in size})
        made = self.file.with_name(f"{self.file.stem}.{os.getpid()}.pt2")
        with torch.no_grad(), torch.fx.experimental._config.patch(backed_size_oblivious=True):
            graph = torch.export.export(_Module(self.function, self.vectors), tuple(examples), dynamic_shapes=(tuple(dynamic),))
            torch._inductor.aoti_compile_and_package(graph, package_path=str(made))
        made.replace(self.file)


def kernel(*shapes: str) -> Callable[[Callable[..., Any]], Kernel]:
    """Decorator: makes a Kernel of a function of tensors of these shapes."""
    return lambda function: Kernel(function, shapes)


def switch(on: bool) -> None:
    """Let kernels run compiled from now on, or as plain PyTorch."""
    global _on
    _on = on


def cache_folder() -> Path:
    """Returns the folder of caches of this user: that of XDG_CACHE_HOME, or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "e2rl"


class _Module(nn.Module):
    """A function whose vectors come component by component, which makes its loops over rows contiguous."""

    def __init__(self, function: Callable[..., Any], vectors: list[bool]) -> None:
        super().__init__()
        self.function, self.vectors = function, vectors

    def forward(self, *given: Tensor) -> Any:
        apart = zip(given, self.vectors, strict=True)
        return self.function(*(value.movedim(0, -1) if vector else value for value, vector in apart))


def _primes() -> Iterator[int]:
    number = FIRST
    while True:
        if all(number % k for k in range(2, number)):
            yield number
        number += 1


@cache
def machine() -> tuple[str, ...]:
    """What machine code depends on: PyTorch, the system and the processor's instructions."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    flags = next((line for line in lines if line.startswith("flags")), platform.processor())
    return torch.__version__, platform.platform(), flags


def _sources(module: ModuleType, found: frozenset[ModuleType] = frozenset()) -> frozenset[ModuleType]:
    """The package's modules whose names a module uses, itself and theirs among them."""
    found |= {module}
    names = {getattr(value, "__module__", None) for value in vars(module).values()}
    for name in sorted(str(name) for name in names):
        if name.split(".")[0] == "e2rl" and sys.modules[name] not in found:
            found = _sources(sys.modules[name], found)
    return found
