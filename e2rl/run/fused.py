"""Fused functions: pure functions of tensors, each compiled into a few loops, where
that is switched on.

    @fused("G P 2", "G K 2", "G K:bool") def function(route, points, counts): ...

Eager PyTorch is the reference: a fused function does the same operations, but for what
compilers are slow at (`torch.compiler.is_compiling`), without a pass over memory for
each. AOTInductor compiles it, once on a machine; it is kept in the cache, under a hash
of its source, of PyTorch's version and of the processor's instructions, where processes
find it.
"""

import hashlib
import io
import os
import platform
import shutil
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, get_type_hints

import torch
from torch import Tensor, nn

from e2rl.run.errors import InputError
from e2rl.run.files import cache_folder, locked, write_atomically

# of a tensor, or of all of a dataclass, or of each of them
Shape = str | tuple[str, ...]
FUSED: dict[str, "Fused"] = {}
"""All fused functions of the modules that are imported, by name."""
COMPILES = "2.13"  # the version of PyTorch that all fused functions were compiled with
COMPILERS = ("c++", "g++", "clang++")
VECTOR = 8  # components of a vector, at most
# of tensors that a function is traced with: distinct primes
SIZES = (17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)
_on = False


class Declared(NamedTuple):
    """What is declared of a tensor of a fused function.

    Args:
        sizes: names of those that vary, numbers of those that do not.
        dtype: of its values.
        apart: a vector, of which compiled code reads component by component.
        truth: compiled code reads truth values as 0 and 1.
    """

    sizes: list[Any]
    dtype: torch.dtype
    apart: bool
    truth: bool

    @classmethod
    def of(cls, shape: str) -> "Declared":
        """Returns what one shape says (`Fused`)."""
        names, _, dtype = shape.removesuffix("!").partition(":")
        sizes = [int(size) if size.isdigit() else size for size in names.split()]
        last = sizes[-1] if len(sizes) > 1 else None
        as_it_lies = shape.endswith("!")
        return cls(
            sizes,
            getattr(torch, dtype or "float32"),
            apart=isinstance(last, int) and last <= VECTOR and not as_it_lies,
            truth=dtype == "bool" and not as_it_lies,
        )

    def laid_out(self, value: Tensor) -> Tensor:
        """Returns the tensor as compiled code reads it."""
        if self.truth:
            value = value.float()
        if self.apart:
            value = value.movedim(-1, 0)
        return value.contiguous()

    def restored(self, value: Tensor) -> Tensor:
        """Returns the tensor that was laid out."""
        if self.truth:
            value = value > 0
        return value.movedim(0, -1) if self.apart else value

    def example(self, size: Mapping[Any, int]) -> Tensor:
        """Returns zeros as compiled code reads them, of these sizes."""
        sizes = [size.get(name, name) for name in self.sizes]
        dtype = torch.float32 if self.truth else self.dtype
        zeros = torch.zeros(sizes, dtype=dtype)
        return zeros.movedim(-1, 0).contiguous() if self.apart else zeros

    def dynamic(self) -> dict[int, Any]:
        """Returns the dimensions that vary, as compiled code reads them."""
        shift = int(self.apart)
        return {
            position + shift: torch.export.Dim.DYNAMIC
            for position, name in enumerate(self.sizes)
            if isinstance(name, str)
        }


class Fused:
    """A function of tensors, compiled where `switch` is on: on the CPU, of the types
    declared, without gradients.

    Where a size is 0, or anything is not as declared, the function runs as it is. It
    takes tensors, and dataclasses and named tuples of them, by position.

    Args:
        function: returns a tensor, or a tuple, a named tuple or a dataclass of them.
        shapes: of each argument, names of sizes that vary and numbers that do not, then
            ":" and a type (float32 by default). Equal names are equal sizes. The shape
            of a dataclass or a named tuple is that of all its tensors, or one for each,
            those of what it holds in their order. Vectors, of few numbers, are copied
            component by component, so that loops over rows are contiguous, and truth
            values as 0 and 1; "!" leaves both as they lie, as is better for tables.
        settings: on which the function depends besides, which their `repr` tells apart.
        constants: so many tensors at the end, such as weights, are always as declared,
            and not looked at.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        shapes: tuple[Shape, ...],
        settings: object = None,
        constants: int = 0,
    ) -> None:
        self.function = function
        self.shapes = shapes
        self.settings = settings
        self.constants = constants
        self.name = f"{function.__module__}.{function.__qualname__}"
        self.__doc__ = function.__doc__
        FUSED[self.name] = self

    def __call__(self, *arguments: Any) -> Any:
        """Returns what the function returns."""
        if not is_on():
            return self.function(*arguments)
        tensors = tensors_of(arguments)
        varied = len(tensors) - self.constants
        if not self._fits(tensors[:varied]):
            return self.function(*arguments)
        read = [
            declared.laid_out(value)
            for declared, value in zip(self.declared, tensors[:varied], strict=False)
        ]
        results = self._run(read + tensors[varied:])
        returned = self.kinds["return"]
        if returned is Tensor:
            return results[0]
        return returned(*results) if holds_tensors(returned) else tuple(results)

    def _fits(self, tensors: list[Tensor]) -> bool:
        """Whether tensors are as declared."""
        if [value.dtype for value in tensors] != self._types[: len(tensors)]:
            return False
        if tensors[0].is_cuda:
            return False
        if torch.is_grad_enabled() and any(value.requires_grad for value in tensors):
            return False
        return self._sizes_fit(tuple([value.shape for value in tensors]))

    @cached_property
    def _sizes_fit(self) -> Callable[[tuple[torch.Size, ...]], bool]:
        """Whether tensors of these shapes have the sizes declared, none of them 0;
        remembered, as it is asked often."""

        @lru_cache(4096)
        def fit(shapes: tuple[torch.Size, ...]) -> bool:
            size: dict[str, int] = {}
            for shape, declared in zip(shapes, self.declared, strict=False):
                if len(shape) != len(declared.sizes):
                    return False
                for name, length in zip(declared.sizes, shape, strict=True):
                    if isinstance(name, str):
                        name = size.setdefault(name, length)
                    if length == 0 or length != name:
                        return False
            return True

        return fit

    @cached_property
    def _types(self) -> list[torch.dtype]:
        return [declared.dtype for declared in self.declared]

    @cached_property
    def kinds(self) -> dict[str, Any]:
        """The type of each argument, and of what is returned."""
        return get_type_hints(self.function)

    @cached_property
    def taken(self) -> list[Any]:
        """The type of each argument, of which the last may be any number of tensors."""
        kinds = [kind for name, kind in self.kinds.items() if name != "return"]
        return kinds + kinds[-1:] * (len(self.shapes) - len(kinds))

    @cached_property
    def declared(self) -> list[Declared]:
        """What is declared of each tensor."""
        declared: list[Declared] = []
        for shapes, kind in zip(self.shapes, self.taken, strict=True):
            if isinstance(shapes, str):
                shapes = (shapes,) * count_of(kind)
            declared += map(Declared.of, shapes)
        return declared

    @cached_property
    def file(self) -> Path:
        """Where the compiled function lies."""
        mark = hashlib.sha256(repr((machine(), self.shapes, self.settings)).encode())
        modules = sources_of(sys.modules[self.function.__module__])
        for module in sorted(modules, key=lambda module: module.__name__):
            mark.update(Path(str(module.__file__)).read_bytes())
        name = f"{self.function.__qualname__}-{mark.hexdigest()[:32]}.so"
        return cache_folder() / "fused" / name

    @cached_property
    def _run(self) -> Callable[[list[Tensor]], list[Tensor]]:
        self.compile()
        return torch._C._aoti.AOTIModelContainerRunnerCpu(str(self.file), 1).run

    def compile(self) -> None:
        """Compile the function, where it is not in the cache. Raises InputError without
        a C++ compiler."""
        if self.file.exists():
            return
        check_compiler("compile")
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with locked(self.file.with_suffix(".lock")):
            if self.file.exists():
                return
            try:
                self._compile()
            except (InputError, OSError):  # of the cache
                raise
            except Exception as error:  # which no process could send, of many lines
                reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
                raise InputError(
                    f"compile=true: torch {torch.__version__} cannot compile "
                    f"{self.name} ({reason}); take torch {COMPILES}, with which all "
                    "were compiled, or set compile=false"
                ) from None

    def _compile(self) -> None:
        package = io.BytesIO()
        settings = {"cpp.threads": 1}  # processes run beside each other
        with tracing():
            torch._inductor.aoti_compile_and_package(
                self.traced(),
                package_path=package,
                inductor_configs=settings,
            )
        # the library alone: packages are unpacked anew by every process
        with zipfile.ZipFile(package) as archive:
            (library,) = (name for name in archive.namelist() if name.endswith(".so"))
            write_atomically(self.file, archive.read(library))

    def traced(self) -> torch.export.ExportedProgram:
        """Returns the function as a graph of tensors, as they are laid out, of every
        size."""
        names = {
            name
            for declared in self.declared
            for name in declared.sizes
            if isinstance(name, str)
        }
        size = dict(zip(sorted(names), SIZES, strict=False))
        examples = tuple(declared.example(size) for declared in self.declared)
        dynamic = tuple(declared.dynamic() for declared in self.declared)
        module = _Module(self)
        with tracing():
            with switched_off():
                module(*examples)  # fills the caches of constants
            return torch.export.export(module, examples, dynamic_shapes=(dynamic,))


@contextmanager
def tracing() -> Iterator[None]:
    """Let tensors of size 1 be like others in the block, and say nothing of what is
    slow."""
    sizes_of_1 = torch.fx.experimental._config.patch(backed_size_oblivious=True)  # type: ignore[attr-defined]
    with torch.no_grad(), sizes_of_1, warnings.catch_warnings(action="ignore"):
        yield


def fused(*shapes: Shape) -> Callable[[Callable[..., Any]], Fused]:
    """Returns a decorator that makes a Fused of a function of tensors of these shapes."""
    return lambda function: Fused(function, shapes)


def switch(on: bool) -> None:
    """Let fused functions run compiled from now on, or as plain PyTorch."""
    global _on
    _on = on


@contextmanager
def switched_off() -> Iterator[None]:
    """Let fused functions run as plain PyTorch in the block."""
    before = _on
    switch(False)
    try:
        yield
    finally:
        switch(before)


def is_on() -> bool:
    """Returns whether fused functions run compiled; what is being compiled does not,
    part by part."""
    return _on and not torch.compiler.is_compiling()


def product(a: Tensor, b: Tensor) -> Tensor:
    """Returns `a.bmm(b)` of few numbers each, which is no call of its own in what is
    compiled."""
    if torch.compiler.is_compiling():
        return (a[..., None] * b[:, None]).sum(2)
    return a.bmm(b)


def some(truths: Tensor) -> Tensor:
    """Returns `truths.any(1)`, by a maximum in what is compiled."""
    if torch.compiler.is_compiling():
        return torch.where(truths, 1.0, 0.0).amax(1) > 0
    return truths.any(1)


def running_sum(values: Tensor) -> Tensor:
    """Returns `values.cumsum(0)`, in what is compiled by one addition after the other:
    its compiler would call a function for it."""
    if not torch.compiler.is_compiling():
        return values.cumsum(0)
    total = values[0]
    sums = [total]
    for value in values[1:]:
        total = total + value
        sums.append(total)
    return torch.stack(sums)


def has_compiler() -> bool:
    """Returns whether there is a C++ compiler."""
    names = filter(None, (os.environ.get("CXX"), *COMPILERS))
    return any(map(shutil.which, names))


def check_compiler(option: str) -> None:
    """Raises InputError without a C++ compiler."""
    if not has_compiler():
        raise InputError(
            f"{option}=true: no C++ compiler found (CXX, {', '.join(COMPILERS)}); "
            "install one, or set false"
        )


class _Module(nn.Module):
    """A fused function, from tensors as compiled code reads them to tensors."""

    def __init__(self, fused: Fused) -> None:
        super().__init__()
        self.fused = fused

    def forward(self, *tensors: Tensor) -> Any:
        restored = iter(
            [
                declared.restored(value)
                for value, declared in zip(tensors, self.fused.declared, strict=True)
            ]
        )
        arguments = [packed(kind, restored) for kind in self.fused.taken]
        return tuple(tensors_of(self.fused.function(*arguments)))


# --- dataclasses and named tuples of tensors


def holds_tensors(kind: Any) -> bool:
    """Returns whether a type is a dataclass or a named tuple."""
    return hasattr(kind, "__match_args__")


def kinds_of(kind: Any) -> list[Any]:
    """Returns the types of what a dataclass or a named tuple holds."""
    hints = get_type_hints(kind)
    return [hints[name] for name in kind.__match_args__]


def count_of(kind: Any) -> int:
    """Returns how many tensors a type holds."""
    return sum(map(count_of, kinds_of(kind))) if holds_tensors(kind) else 1


def packed(kind: Any, tensors: Iterator[Tensor]) -> Any:
    """Returns the next of some tensors as a type."""
    if not holds_tensors(kind):
        return next(tensors)
    return kind(*[packed(part, tensors) for part in kinds_of(kind)])


def tensors_of(value: Any) -> list[Tensor]:
    """Returns the tensors that a tensor, a tuple or a dataclass holds, in their order."""
    if isinstance(value, Tensor):
        return [value]
    parts = value
    if is_dataclass(value):
        kind: Any = type(value)
        parts = [getattr(value, name) for name in kind.__match_args__]
    return [tensor for part in parts for tensor in tensors_of(part)]


# --- what machine code depends on


@cache
def machine() -> tuple[str, ...]:
    """Returns PyTorch's version, the system and the processor's instructions."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    flags = [line for line in lines if line.startswith("flags")]
    return torch.__version__, platform.platform(), (*flags, platform.processor())[0]


def sources_of(
    module: ModuleType, visited: frozenset[ModuleType] = frozenset()
) -> frozenset[ModuleType]:
    """Returns the package's modules whose names a module uses, itself and theirs among
    them, besides those that were visited."""
    visited |= {module}
    names = {getattr(value, "__module__", None) for value in vars(module).values()}
    for name in sorted(map(str, names)):
        if name.split(".")[0] == "e2rl" and sys.modules[name] not in visited:
            visited = sources_of(sys.modules[name], visited)
    return visited
