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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, get_type_hints

import torch
from torch import Tensor, nn

from e2rl.run.errors import InputError
from e2rl.run.files import cache_folder, locked, write_atomically

Shape = (
    str | tuple[str, ...]
)  # of a tensor or of all of a dataclass, or of each of them

FUSED: dict[str, "Fused"] = {}
"""All fused functions of the modules that are imported, by name."""
COMPILES = "2.13"  # the version of PyTorch that all fused functions were compiled with
COMPILERS = ("c++", "g++", "clang++")
VECTOR = 8  # components of a vector, at most
SIZES = (
    17,
    19,
    23,
    29,
    31,
    37,
    41,
    43,
    47,
    53,
    59,
    61,
)  # of tensors that a function is traced with: distinct primes
_on = False


class Fused:
    """A function of tensors, compiled where `switch` is on: on the CPU, of the types
    declared, without gradients.

    shapes: of each argument, names of sizes that vary and numbers that do not, then ":"
    and a type (float32 by default). Equal names are equal sizes. The shape of a
    dataclass or a named tuple is that of all its tensors, or one for each, those of
    what it holds in their order. Vectors, of few numbers, are copied component by
    component, so that loops over rows are contiguous, and truth values as 0 and 1; "!"
    leaves both as they lie, as is better for tables. Where a size is 0, or anything is
    not as declared, the function runs as it is. settings: on which the function depends
    besides, which their `repr` tells apart; constants: so many tensors at the end, such
    as weights, are always as declared, and not looked at.
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

    def __call__(self, *given: Any) -> Any:
        """What the function returns: a tensor, or a tuple, a named tuple or a dataclass
        of them."""
        if not is_on():
            return self.function(*given)
        flat = _tensors(given)
        varied = len(flat) - self.constants
        if not self._fits(flat[:varied]):
            return self.function(*given)
        read = [
            tensor.laid_out(value)
            for tensor, value in zip(self.declared, flat[:varied], strict=False)
        ]
        results = self._run(read + flat[varied:])
        return (
            results[0]
            if self.returns is Tensor
            else self.returns(*results)
            if _made(self.returns)
            else tuple(results)
        )

    def _fits(self, flat: list[Tensor]) -> bool:
        if [value.dtype for value in flat] != self._types[: len(flat)] or flat[
            0
        ].is_cuda:
            return False
        if torch.is_grad_enabled() and any(value.requires_grad for value in flat):
            return False
        return self._sizes_fit(tuple([value.shape for value in flat]))

    @cached_property
    def _sizes_fit(self) -> Callable[[tuple[torch.Size, ...]], bool]:
        """Whether tensors of these shapes have the sizes declared, none of them 0;
        remembered, as it is asked often."""

        @lru_cache(4096)
        def fit(shapes: tuple[torch.Size, ...]) -> bool:
            size: dict[Any, int] = {}
            for shape, (names, *_) in zip(shapes, self.declared, strict=False):
                if len(shape) != len(names):
                    return False
                for name, length in zip(names, shape, strict=True):
                    if length == 0 or length != (
                        name if isinstance(name, int) else size.setdefault(name, length)
                    ):
                        return False
            return True

        return fit

    @cached_property
    def _types(self) -> list[torch.dtype]:
        return [tensor.kind for tensor in self.declared]

    @cached_property
    def kinds(self) -> list[Any]:
        """The type of each argument."""
        kinds = [
            kind
            for name, kind in get_type_hints(self.function).items()
            if name != "return"
        ]
        return kinds + kinds[-1:] * (
            len(self.shapes) - len(kinds)
        )  # the last may be any number of tensors

    @cached_property
    def returns(self) -> Any:
        """The type of the result."""
        return get_type_hints(self.function)["return"]

    @cached_property
    def declared(self) -> list["_Declared"]:
        """What is said of each tensor."""
        declared = []
        for shapes, kind in zip(self.shapes, self.kinds, strict=True):
            for shape in (
                (shapes,) * _count(kind) if isinstance(shapes, str) else shapes
            ):
                sizes, _, name = shape.removesuffix("!").partition(":")
                names = [
                    int(size) if size.isdigit() else size for size in sizes.split()
                ]
                apart = (
                    len(names) > 1
                    and isinstance(names[-1], int)
                    and names[-1] <= VECTOR
                    and shape[-1] != "!"
                )
                truth = name == "bool" and shape[-1] != "!"
                declared.append(
                    _Declared(
                        names,
                        getattr(torch, name or "float32"),
                        apart=apart,
                        truth=truth,
                    )
                )
        return declared

    @cached_property
    def file(self) -> Path:
        """Where the compiled function lies."""
        mark = hashlib.sha256(repr((machine(), self.shapes, self.settings)).encode())
        for module in sorted(
            _sources(sys.modules[self.function.__module__]),
            key=lambda module: module.__name__,
        ):
            mark.update(Path(str(module.__file__)).read_bytes())
        return (
            cache_folder()
            / "fused"
            / f"{self.function.__qualname__}-{mark.hexdigest()[:32]}.so"
        )

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
            if not self.file.exists():
                try:
                    self._compile()
                except (InputError, OSError):  # of the cache
                    raise
                except (
                    Exception
                ) as error:  # not pickled between processes, and hundreds of lines long
                    first = str(error).partition("\n")[0]
                    why = f"{type(error).__name__}: {first}"
                    raise InputError(
                        f"compile=true: torch {torch.__version__} cannot compile "
                        f"{self.name} ({why}); take "
                        f"torch {COMPILES}, with which all were compiled, or set compile=false"
                    ) from None

    def _compile(self) -> None:
        package = io.BytesIO()
        settings = {"cpp.threads": 1}  # processes run beside each other
        with _tracing():
            torch._inductor.aoti_compile_and_package(
                self.traced(), package_path=package, inductor_configs=settings
            )
        with zipfile.ZipFile(
            package
        ) as whole:  # the library alone: packages are unpacked anew by every process
            (library,) = (name for name in whole.namelist() if name.endswith(".so"))
            write_atomically(self.file, whole.read(library))

    def traced(self) -> torch.export.ExportedProgram:
        """Returns the function as a graph of tensors, as they are laid out, of every
        size."""
        free = sorted(
            {
                name
                for tensor in self.declared
                for name in tensor.sizes
                if isinstance(name, str)
            }
        )
        size: dict[Any, int] = dict(zip(free, SIZES, strict=False))
        examples = []
        dynamic = []
        for names, kind, apart, truth in self.declared:
            names = [names[-1], *names[:-1]] if apart else names
            kind = torch.float32 if truth else kind
            examples.append(
                torch.zeros([size.get(name, name) for name in names], dtype=kind)
            )
            dynamic.append(
                {
                    at: torch.export.Dim.DYNAMIC
                    for at, name in enumerate(names)
                    if name in size
                }
            )
        module = _Module(self)
        with _tracing():
            with switched_off():
                module(*examples)  # fills the caches of constants
            return torch.export.export(
                module, tuple(examples), dynamic_shapes=(tuple(dynamic),)
            )


@contextmanager
def _tracing() -> Iterator[None]:
    """Tensors of size 1 are like others, and nothing is said of what is slow."""
    sizes_of_1 = torch.fx.experimental._config.patch(backed_size_oblivious=True)  # type: ignore[attr-defined]
    with torch.no_grad(), sizes_of_1, warnings.catch_warnings(action="ignore"):
        yield


def fused(*shapes: Shape) -> Callable[[Callable[..., Any]], Fused]:
    """Decorator: makes a Fused of a function of tensors of these shapes."""
    return lambda function: Fused(function, shapes)


def switch(on: bool) -> None:
    """Let fused functions run compiled from now on, or as plain PyTorch."""
    global _on
    _on = on


@contextmanager
def switched_off() -> Iterator[None]:
    """Fused functions run as plain PyTorch meanwhile."""
    before = _on
    switch(False)
    try:
        yield
    finally:
        switch(before)


def is_on() -> bool:
    """Whether fused functions run compiled, now; what is being compiled is not in
    parts."""
    return _on and not torch.compiler.is_compiling()


def product(a: Tensor, b: Tensor) -> Tensor:
    """`a.bmm(b)` of few numbers each, which is no call of its own in what is compiled."""
    return (
        (a[..., None] * b[:, None]).sum(2)
        if torch.compiler.is_compiling()
        else a.bmm(b)
    )


def some(truths: Tensor) -> Tensor:
    """`truths.any(1)`, by a maximum in what is compiled."""
    return (
        torch.where(truths, 1.0, 0.0).amax(1) > 0
        if torch.compiler.is_compiling()
        else truths.any(1)
    )


def has_compiler() -> bool:
    """Whether there is a C++ compiler."""
    return any(
        name and shutil.which(name) for name in (os.environ.get("CXX"), *COMPILERS)
    )


def check_compiler(option: str) -> None:
    """Raises InputError without a C++ compiler."""
    if not has_compiler():
        raise InputError(
            f"{option}=true: no C++ compiler found (CXX, {', '.join(COMPILERS)}); "
            "install one, or set false"
        )


class _Module(nn.Module):
    """A fused function, from tensors to tensors."""

    def __init__(self, fused: Fused) -> None:
        super().__init__()
        self.fused = fused

    def forward(self, *flat: Tensor) -> Any:
        rest = iter(
            [
                tensor.as_given(value)
                for value, tensor in zip(flat, self.fused.declared, strict=True)
            ]
        )
        return tuple(
            _tensors(
                self.fused.function(*(_built(kind, rest) for kind in self.fused.kinds))
            )
        )


class _Declared(NamedTuple):
    """A tensor of a fused function: its sizes, its type, and whether vectors come
    component by component, and truth values as 0 and 1."""

    sizes: list[Any]
    kind: torch.dtype
    apart: bool
    truth: bool

    def laid_out(self, value: Tensor) -> Tensor:
        """The tensor as compiled code reads it."""
        if self.apart or self.truth:
            value = value.float() if self.truth else value
            value = value.movedim(-1, 0) if self.apart else value
        return value.contiguous()

    def as_given(self, value: Tensor) -> Tensor:
        """The tensor that was laid out."""
        value = value > 0 if self.truth else value
        return value.movedim(0, -1) if self.apart else value


def _made(kind: Any) -> bool:
    """Whether a type is a dataclass or a named tuple."""
    return is_dataclass(kind) or hasattr(kind, "_fields")


def _kinds(kind: Any) -> list[Any]:
    """The types of what a dataclass or a named tuple holds."""
    return [get_type_hints(kind)[name] for name in _names(kind)]


def _count(kind: Any) -> int:
    return sum(map(_count, _kinds(kind))) if _made(kind) else 1


def _built(kind: Any, rest: Iterator[Tensor]) -> Any:
    return (
        kind(*(_built(part, rest) for part in _kinds(kind)))
        if _made(kind)
        else next(rest)
    )


def _tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    tensors = []
    kind: Any = type(value)
    for part in (
        [getattr(value, name) for name in _names(kind)]
        if is_dataclass(value)
        else value
    ):
        if isinstance(part, Tensor):
            tensors.append(part)
        else:
            tensors += _tensors(part)
    return tensors


@cache
def _names(kind: Any) -> list[str]:
    """The names of what a dataclass or a named tuple holds."""
    return (
        [part.name for part in fields(kind)]
        if is_dataclass(kind)
        else list(kind._fields)
    )


@cache
def machine() -> tuple[str, ...]:
    """What machine code depends on: PyTorch, the system and the processor's
    instructions."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    flags = next(
        (line for line in lines if line.startswith("flags")), platform.processor()
    )
    return torch.__version__, platform.platform(), flags


def _sources(
    module: ModuleType, found: frozenset[ModuleType] = frozenset()
) -> frozenset[ModuleType]:
    """The package's modules whose names a module uses, itself and theirs among them."""
    found |= {module}
    names = {getattr(value, "__module__", None) for value in vars(module).values()}
    for name in sorted(str(name) for name in names):
        if name.split(".")[0] == "e2rl" and sys.modules[name] not in found:
            found = _sources(sys.modules[name], found)
    return found
