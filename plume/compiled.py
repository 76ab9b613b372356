"""Compiled kernels: numba's `njit`, with its cache in a folder named after all that a kernel is made of.

Numba knows a kernel by its own file alone: if a function or a constant of another file changes, it still
runs the old machine code. Here a kernel may use what stands in its own folder, in plume/ and in
plume/sensors/. A digest of these sources and tables and of the libraries' versions names the folder, so a
change of any leads to an empty one. Within a folder numba tells processors apart.

Numba numbers functions by the order in which a process compiles them, and calls a function of a library by
its name and number: a sort that one process has compiled would run for an argsort of another. So each kernel
has numbers of its own.

Numba makes machine code of every function that a kernel calls, and a wrapper for Python. The kernel has a
copy of its own, so nobody runs them: without them kernels are compiled in two thirds of the time.

Numba loads all that it compiles with, SciPy's BLAS included, before it looks into its cache, and reads what
others would inline of a kernel. One that is kept does not wait for either here: the estimator, which has
eighteen, is loaded in a third of the time.
"""

import hashlib
import itertools
import os
import shutil
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryFile
from threading import RLock
from typing import Any, TypeVar, cast

import llvmlite
import llvmlite.binding
import numba
import numpy as np
import numpy.ma  # numba imports it at a process's first call of a kernel: 10 ms of a service's first answer
from numba import njit
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys
from numba.core.typeinfer import register_dispatcher

from plume import COMPILING

F = TypeVar("F", bound=Callable[..., Any])

KINDS = ("*.py", "*.npy")  # of what a kernel is made of: sources and tables
VERSIONS = (
    f"numba {numba.__version__}, llvmlite {llvmlite.__version__}, numpy {np.__version__}, {sys.version}"
)
CONFIG: Any = numba.config
# Held while numba's settings are ours. A module that runs as a program is imported again meanwhile.
SETTING = RLock()


class KeptLibrary(JITCodeLibrary):
    """The machine code of a kernel that was kept, and as bitcode what others would inline of it."""

    _bitcode: bytes

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> "KeptLibrary":
        name, _, (code, bitcode) = state
        self = cls(codegen, name)
        self.enable_object_caching()  # type: ignore[no-untyped-call]
        self._set_compiled_object(code)  # type: ignore[no-untyped-call]
        self._bitcode = bitcode
        self._finalize_final_module()  # type: ignore[no-untyped-call]
        return self

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = llvmlite.binding.parse_bitcode(self._bitcode)
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of one of its functions; numba's own looks it up in the bitcode first."""
        return int(self._codegen._engine.get_function_address(name))


class KernelCache(FunctionCache):
    """Numba's cache, loading without what only compiling needs."""

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the kept result for a signature, or None: then numba loads the rest itself, and compiles."""
        rtsys.initialize(target)  # kernels allocate arrays
        codegen = target.codegen()
        usual, codegen._library_class = codegen._library_class, KeptLibrary
        try:
            return self._load_overload(signature, target)  # type: ignore[no-untyped-call]
        finally:
            codegen._library_class = usual


class InnerLibrary(JITCodeLibrary):
    """The code of a function that only compiled ones call: it becomes machine code as a part of theirs."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True


class InnerCompiler(_FunctionCompiler):  # type: ignore[misc]
    """Numba's compiler of functions that only compiled ones call: without what lets Python call them."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        return flags

    def _compile_core(self, args: Any, return_type: Any) -> Any:
        compiled = super()._compile_core(args, return_type)
        compiled.library.__class__ = InnerLibrary
        # Stands for it in the callers' code, and is what Python calls.
        compiled = compiled._replace(entry_point=partial(njit(error_model="numpy")(self.py_func)))
        self.targetdescr.target_context.insert_user_function(
            compiled.entry_point, compiled.fndesc, [compiled.library]
        )
        return compiled


def subroutine(function: F, **options: Any) -> F:
    """Let numba compile a function for the kernels that call it; `options` are njit's.

    If Python calls it, which tests do, it is compiled once more, with what this needs.
    """
    dispatcher: Any = njit(error_model="numpy", **options)(function)
    usual = dispatcher._compiler
    dispatcher._compiler = InnerCompiler(
        usual.py_func, usual.targetdescr, usual.targetoptions, usual.locals, usual.pipeline_class
    )
    dispatcher.add_overload = lambda compiled: dispatcher.overloads.__setitem__(
        tuple(compiled.signature.args), compiled
    )
    return cast(F, dispatcher)


def kernel(signature: Any, **options: Any) -> Callable[[F], F]:
    """Compile a function for one signature, as `numba.njit` does, or load it from the cache.

    `options` are njit's. Damaged files are made anew; where nothing can be written, each start compiles.
    """

    def compiled(function: F) -> F:
        folder = folder_of(Path(function.__code__.co_filename).parent)
        try:
            return _compiled(function, signature, options, folder)
        except Exception:  # of a file that a crash cut off: unpickling can raise anything
            if folder is None:
                raise
            shutil.rmtree(folder, ignore_errors=True)
        try:
            return _compiled(function, signature, options, folder)
        except OSError:  # the disk is full
            return _compiled(function, signature, options, None)

    return compiled


def _compiled(function: F, signature: Any, options: dict[str, Any], folder: Path | None) -> F:
    with SETTING:
        usual, CONFIG.CACHE_DIR = CONFIG.CACHE_DIR, str(folder or "")
        numbers, FunctionIdentity._unique_ids = FunctionIdentity._unique_ids, _numbers(function, folder)
        try:
            dispatcher: Any = njit(**options)(function)
            if folder is not None:
                dispatcher._cache = KernelCache(function)  # type: ignore[no-untyped-call]
            with register_dispatcher(dispatcher):  # it may call itself
                dispatcher.compile(signature)
            dispatcher.disable_compile()
        finally:
            CONFIG.CACHE_DIR, FunctionIdentity._unique_ids = usual, numbers
    if sum(dispatcher.stats.cache_misses.values()):
        _tell()
    return cast(F, dispatcher)


def _numbers(function: F, folder: Path | None) -> "itertools.count[int]":
    """Return numba's numbers for all that is compiled with a kernel, which no other kernel has."""
    name = f"{folder and folder.name} {function.__module__}.{function.__qualname__}"
    return itertools.count(int.from_bytes(hashlib.blake2b(name.encode(), digest_size=6).digest()) << 16)


@cache
def _tell() -> None:
    """Say, once a process, that kernels are being compiled: it takes seconds."""
    print(COMPILING, file=sys.stderr, flush=True)


@cache
def folder_of(sources: Path) -> Path | None:
    """Return the folder for the kernels of a folder of sources; None if none can be written to.

    It is in NUMBA_CACHE_DIR, else beside the sources, else in the user's own cache.
    """
    digest = hashlib.blake2b(VERSIONS.encode(), digest_size=12)
    plume = Path(__file__).parent
    folders = (sources, plume, plume / "sensors")
    for path in [path for folder in folders for kind in KINDS for path in sorted(folder.glob(kind))]:
        digest.update(f"{path.name} {path.stat().st_size}\n".encode() + path.read_bytes())
    users = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    for place in filter(None, (CONFIG.CACHE_DIR, sources / "__pycache__", Path(users, "plumeward"))):
        folder = Path(place, f"kernels-{digest.hexdigest()}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None
