"""Compiled kernels: numba's `njit`, with a cache on disk that follows all that a kernel is made of.

Numba's own cache knows a kernel by its file: after a change in a file that it calls into, or in a constant that it was given, the old
machine code runs on. Here a kernel is known by its own bytecode and by that of every function and every constant that it uses.
"""

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core import typeinfer
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

F = TypeVar("F", bound=Callable[..., Any])


def kernel(signature: str, **options: Any) -> Callable[[F], F]:
    """Compile a function for one signature, as `numba.njit` does, or load it from the cache. `options` are njit's."""

    def compiled(function: F) -> F:
        dispatcher: Any = njit(**options)(function)
        dispatcher._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
        with typeinfer.register_dispatcher(dispatcher):
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        compiled_function: F = dispatcher
        return compiled_function

    return compiled


def fingerprint(function: FunctionType) -> str:
    """Digest of a function and of all that it is made of: other functions, constants, and theirs."""
    digest = hashlib.blake2b(digest_size=12)
    for part in _parts(function, set()):
        digest.update(f"{len(part)}:".encode() + part)
    return digest.hexdigest()


def _parts(function: FunctionType, seen: set[FunctionType]) -> Iterator[bytes]:
    if function in seen:
        return
    seen.add(function)
    codes = list(_codes(function.__code__))
    names = sorted({name for code in codes for name in code.co_names})
    yield function.__qualname__.encode()
    for code in codes:
        constants = [constant for constant in code.co_consts if not isinstance(constant, CodeType)]
        yield code.co_code + repr((code.co_names, code.co_varnames, constants)).encode()
    used = [(name, function.__globals__[name]) for name in names if name in function.__globals__]
    inner = [(name, cell.cell_contents) for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)]
    for name, value in [*used, *inner, *enumerate(function.__defaults__ or ())]:
        yield str(name).encode()
        yield from _value(value, names, seen)


def _value(value: Any, names: list[str], seen: set[FunctionType]) -> Iterator[bytes]:
    match value:
        case Dispatcher():
            yield repr(sorted(value.targetoptions.items())).encode()
            yield from _parts(value.py_func, seen)
        case _Intrinsic():
            yield from _parts(value._defn, seen)
        case FunctionType():
            yield from _parts(value, seen)
        case ModuleType():
            yield f"{value.__name__} {getattr(value, '__version__', '')}".encode()
            for name in names:
                if isinstance(inner := getattr(value, name, None), Dispatcher | FunctionType | int | float):
                    yield from _value(inner, names, seen)
        case np.ndarray():
            yield repr((value.dtype.str, value.shape)).encode() + value.tobytes()
        case _:
            yield repr(value).encode()


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


@cache
def _known_by(function: FunctionType) -> str:
    return fingerprint(function)


class _KnownByContent:
    """For a locator: files are named by the fingerprint, so no kernel is ever loaded from the files of another version of it."""

    _py_func: FunctionType

    def get_source_stamp(self) -> str:
        return _known_by(self._py_func)

    def get_disambiguator(self) -> str:
        return _known_by(self._py_func)


def _locator(usual: Any) -> Any:
    def __init__(self: Any, py_func: FunctionType, py_file: str) -> None:
        usual.__init__(self, py_func, py_file)
        self._py_func = py_func

    return type(usual.__name__, (_KnownByContent, usual), {"__init__": __init__})


class _KernelCacheImpl(CompileResultCacheImpl):
    """Looks for a place to keep files as numba does: the folder that NUMBA_CACHE_DIR names, `__pycache__`, the user's own."""

    _locator_classes: list[Any] = [_locator(usual) for usual in (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator)]  # noqa: RUF012


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl
