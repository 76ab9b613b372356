"""Compiled kernels: numba's `njit`, with a cache on disk that depends on everything a kernel is made of.

Numba's own cache identifies a kernel by its file: if a called function in another file or a constant
changes, it still runs the old machine code. Here a kernel is identified by its own bytecode and by that of
every function and constant that it uses.
"""

import contextlib
import hashlib
import sys
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType, EllipsisType, FunctionType, ModuleType, NoneType
from typing import Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba import njit
from numba.core import typeinfer
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numba.core.runtime.nrt import rtsys

from plume import COMPILING

F = TypeVar("F", bound=Callable[..., Any])

LIBRARIES = {
    "numba": numba.__version__,
    "llvmlite": llvmlite.__version__,
    "numpy": np.__version__,
    "python": sys.version,
}
"""What these libraries define is identified by its name and their versions."""


def kernel(signature: str, **options: Any) -> Callable[[F], F]:
    """Compile a function for one signature, as `numba.njit` does, or load it from the cache. `options` are
    njit's.

    Raises TypeError if the function uses something that has no digest.
    """

    def compiled(function: F) -> F:
        dispatcher: Any = njit(**options)(function)
        known_by = fingerprint(
            dispatcher.py_func, signature, options, dispatcher.targetctx.codegen().magic_tuple()
        )
        try:
            dispatcher._cache = _KernelCache(dispatcher.py_func, known_by)
        except RuntimeError:  # no folder can be written to: it is compiled at every start
            _tell()
        with typeinfer.register_dispatcher(dispatcher):
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        compiled_function: F = dispatcher
        return compiled_function

    return compiled


@cache
def _tell() -> None:
    """Say, once a process, that kernels are being compiled: it takes seconds."""
    print(COMPILING, file=sys.stderr, flush=True)


def fingerprint(function: FunctionType, *more: Any) -> str:
    """Digest of a function and of everything that it uses: functions and constants, recursively; and of
    `more`.

    Equal in all processes. Raises TypeError if something that it uses has no digest.
    """
    digest = hashlib.blake2b(digest_size=12)
    for part in (*_value((LIBRARIES, *more), [], {}), *_function(function, {})):
        digest.update(f"{len(part)}:".encode() + part)
    return digest.hexdigest()


def _function(function: FunctionType, seen: dict[Any, int]) -> Iterator[bytes]:
    if function in seen:
        yield f"function {seen[function]} again".encode()
        return
    seen[function] = len(seen)
    codes = list(_codes(function.__code__))
    names = sorted({name for code in codes for name in code.co_names})
    yield function.__qualname__.encode()
    for code in codes:
        constants = tuple(constant for constant in code.co_consts if not isinstance(constant, CodeType))
        variables = (code.co_varnames, code.co_cellvars, code.co_freevars, code.co_argcount, code.co_flags)
        yield from _value(
            (code.co_code, code.co_exceptiontable, code.co_names, variables, constants), names, seen
        )
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    used = {name: function.__globals__[name] for name in names if name in function.__globals__}
    used |= {f"of the closure: {name}": cell.cell_contents for name, cell in cells}
    used |= {"defaults": function.__defaults__, "defaults by name": function.__kwdefaults__}
    for name, value in used.items():
        yield name.encode()
        try:
            yield from _value(value, names, seen)
        except TypeError as error:
            raise TypeError(f"{function.__qualname__} uses {name}: {error}") from None


def _value(value: Any, names: list[str], seen: dict[Any, int]) -> Iterator[bytes]:
    """Yield what identifies a value that a function uses. names: the names in the function, attributes of
    modules among them.
    """
    match value:
        case Dispatcher():
            compiled: Any = value
            # One that compiles on demand has no signatures of its own.
            signatures = () if compiled._can_compile else tuple(map(str, compiled.nopython_signatures))
            yield from _value((signatures, compiled.targetoptions, compiled.locals), names, seen)
            yield from _function(compiled.py_func, seen)
        case _Intrinsic():
            yield from _function(value._defn, seen)
        case FunctionType() if not _is_of_a_library(value.__module__):
            yield from _function(value, seen)
        case ModuleType():
            yield value.__name__.encode()
            if value in seen or _is_of_a_library(value.__name__):
                return
            seen[value] = len(seen)
            for name in names:
                if hasattr(value, name):
                    yield name.encode()
                    yield from _value(getattr(value, name), names, seen)
        case np.ndarray() | np.generic():
            yield repr((value.dtype, value.shape, value.flags.c_contiguous)).encode() + value.tobytes()
        case tuple():
            yield f"{type(value).__qualname__} of {len(value)}".encode()
            for item in value:
                yield from _value(item, names, seen)
        case frozenset():  # sorted: hashes of strings, and so the order, differ between processes
            yield from _value(tuple(sorted(repr(item) for item in value)), names, seen)
        case dict():
            yield from _value(tuple(sorted(value.items())), names, seen)
        case int() | float() | complex() | str() | bytes() | NoneType() | EllipsisType():
            yield repr(value).encode()
        case _ if _is_of_a_library(getattr(value, "__module__", None) or type(value).__module__):
            yield repr(getattr(value, "__qualname__", value)).encode()
        case _:
            raise TypeError(f"a {type(value).__qualname__}, which no cache of kernels can follow")


def _is_of_a_library(module: str) -> bool:
    package = module.partition(".")[0]
    return package in LIBRARIES or package in sys.stdlib_module_names


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


class _KernelCache(FunctionCache):
    """Numba's cache, in the folders that it chooses. The fingerprint is part of a file's name: each kernel
    has its own.
    """

    def __init__(self, function: FunctionType, known_by: str) -> None:
        """Raises RuntimeError if no folder can be written to."""
        super().__init__(function)  # type: ignore[no-untyped-call]
        name = f"{function.__module__}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._cache_file: Any = IndexDataCacheFile(self._cache_path, f"{name}-{known_by}", known_by)  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, _codegen: Any) -> str:
        return str(sig)  # the fingerprint covers the rest

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kept machine code; None if there is none or a crash has damaged it."""
        try:
            # Numba's own method first imports all that it needs to compile, which takes longer than to load
            # all our kernels.
            rtsys.initialize(target_context)
            kept = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # a damaged pickle can raise anything
            kept = None
            with contextlib.suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
        if kept is None:
            _tell()
        return kept

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the machine code if possible: the kernel also runs when the disk is full."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
