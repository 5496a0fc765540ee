"""CUDA devices: kernels by NVRTC, kept as machine code in the user's cache, launched on torch's stream.

NVRTC is NVIDIA's compiler as a library: that of `cuda.bindings` and `cuda.core` (the extra ``cuda``) or the
one that torch brings. Machine code is loaded and launched by the driver itself, which every device has: a
launch is then two microseconds of Python, knows nothing of tensors, and is recorded by a graph.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib
import itertools
import logging
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ...signs import Sign
from ..compilation.cache import cache, found, keep, kept
from ..emit.cuda import FEWER_REGISTERS, KERNEL, with_shared_memory
from ..threads import Mutex

_log = logging.getLogger(__name__)
REMEDY = "install torch with CUDA, or `pip install staf-torch[cuda]`"
_OPTIONS = ("--std=c++17", "--fmad=false", "--ptxas-options=-v")
_STACK = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores")
_USED, _SHARED = re.compile(r"Used (\d+) registers"), re.compile(r"(\d+) bytes smem")
_REGISTERS, _STEP, _WARPS = 512, 8, 16  # that warps share of a lane, are given at once; warps at most
_SHARED_SPILLS = 13000  # the first version of CUDA that keeps in shared memory what registers lack room for
_LONG_ARGUMENTS = 12010  # the first version of CUDA of which a kernel's arguments may take 32764 bytes
_WARP, _BLOCK = 32, 128
_FEW = 8  # warps a multiprocessor up to which every warp is a block, so that all multiprocessors have some
_NO_CONTEXT = (3, 201)  # not initialised, invalid context
_MOST_THREADS = 0  # an attribute of a function
_lock = Mutex()


class LoadedKernel(ctypes.c_void_p):
    """A kernel that is loaded."""

    block = _BLOCK  # threads


class CudaDevice:
    """A CUDA device."""

    def __init__(self, index: int) -> None:
        self.index = index
        properties = torch.cuda.get_device_properties(index)
        self._few = _FEW * _WARP * int(properties.multi_processor_count)
        self.architecture = 10 * int(properties.major) + int(properties.minor)
        self._memory = int(properties.total_memory)
        self._kernels: dict[str, LoadedKernel] = {}
        self._launch = _driver().cuLaunchKernel
        self._stream = torch._C._cuda_getCurrentRawStream

    def compile(self, text: str) -> LoadedKernel:
        """Return the kernel of a text, loaded.

        Raises:
            OSError: if there is no compiler, or it or the driver refuses the text.
        """
        with _lock:
            kernel = self._kernels.get(text)
            if kernel is None:
                code = machine_code(text, self.architecture)
                with torch.cuda.device(self.index):
                    kernel = self._kernels[text] = self._loaded(code)
            return kernel

    def _loaded(self, code: bytes) -> LoadedKernel:
        driver, module, kernel, most = _driver(), ctypes.c_void_p(), LoadedKernel(), ctypes.c_int()
        self._with_context()
        _checked(driver.cuModuleLoadData(ctypes.byref(module), code))
        _checked(driver.cuModuleGetFunction(ctypes.byref(kernel), module, KERNEL.encode()))
        _checked(driver.cuFuncGetAttribute(ctypes.byref(most), _MOST_THREADS, kernel))
        kernel.block = min(_BLOCK, most.value)
        return kernel

    def _with_context(self) -> None:
        """Let this thread have the context of the device that torch uses, which its calls need not make."""
        driver, number, context = _driver(), ctypes.c_int(), ctypes.c_void_p()
        _checked(driver.cuInit(0))
        _checked(driver.cuDeviceGet(ctypes.byref(number), self.index))
        _checked(driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), number))
        _checked(driver.cuCtxSetCurrent(context))

    def arguments(self) -> int:
        """Return the bytes that the arguments of a kernel may take: more since CUDA 12.1."""
        version, compiler = ctypes.c_int(), _nvrtc()
        _checked(_driver().cuDriverGetVersion(ctypes.byref(version)))
        known = compiler is not None and compiler.number >= _LONG_ARGUMENTS
        return 32764 if known and version.value >= _LONG_ARGUMENTS else 4096

    def memory(self) -> int:
        """Return the bytes of all its memory."""
        return self._memory

    def free(self) -> int:
        """Return the bytes that are free, those that torch keeps for itself among them."""
        kept = torch.cuda.memory_reserved(self.index) - torch.cuda.memory_allocated(self.index)
        return int(torch.cuda.mem_get_info(self.index)[0]) + kept

    def launch(self, kernel: LoadedKernel, arguments: ctypes.Array[ctypes.c_char], rows: int) -> None:
        """Put a kernel for so many rows on the stream that torch has on this device now."""
        if torch._C._cuda_getDevice() != self.index:
            with torch.cuda.device(self.index):
                return self.launch(kernel, arguments, rows)
        block = _WARP if rows <= self._few else kernel.block
        given = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
        grid = -(-rows // block), 1, 1, block, 1, 1
        failed = self._launch(kernel, *grid, 0, self._stream(self.index), given, None)
        if failed in _NO_CONTEXT:  # of a thread that has not asked torch for anything yet
            self._with_context()
            failed = self._launch(kernel, *grid, 0, self._stream(self.index), given, None)
        return _checked(failed) if failed else None


@functools.cache
def _driver() -> Any:
    """Return the driver.

    Raises:
        OSError: if there is none.
    """
    driver = None
    for name in ("libcuda.so.1", "nvcuda.dll"):
        try:
            driver = ctypes.CDLL(name)
            break
        except OSError:
            continue
    if driver is None:
        raise OSError("the CUDA driver (libcuda.so.1) was not found")
    word, size = ctypes.c_void_p, ctypes.c_uint
    driver.cuCtxSetCurrent.argtypes = (word,)
    driver.cuLaunchKernel.argtypes = (word, *[size] * 6, size, word, word, word)
    driver.cuModuleLoadData.argtypes = (word, ctypes.c_char_p)
    driver.cuModuleGetFunction.argtypes = (word, word, ctypes.c_char_p)
    driver.cuFuncGetAttribute.argtypes = (word, ctypes.c_int, word)
    return driver


def _checked(failed: int) -> None:
    if failed:
        told = ctypes.c_char_p()
        _driver().cuGetErrorString(failed, ctypes.byref(told))
        raise OSError(f"the CUDA driver reports {(told.value or b'?').decode()} ({failed})")


def machine_code(text: str, architecture: int) -> bytes:
    """Return the machine code of a text for an architecture (90 of sm_90), from the cache where it is.

    Raises:
        OSError: if there is no compiler, or it refuses the text.
    """
    compiler = _nvrtc()
    version = "none" if compiler is None else compiler.version
    parts = (text, *_OPTIONS, str(architecture))
    made_of = f"kernel-{_digest(*parts)[:24]}"
    names = f"{made_of}-{_digest(version)[:8]}.cubin" if compiler is not None else f"{made_of}-*.cubin"
    for path in found(names):
        code = kept(path)
        if code is not None:
            return code
    if compiler is None:
        raise OSError(f"the CUDA compiler (NVRTC) was not found: {REMEDY}")
    lines = text.count("\n")
    with Sign(f"compiling {lines} lines for sm_{architecture}, once"):
        code = compiler.compile(text, architecture)
    keep(cache() / names, code)
    return code


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


class Nvrtc:
    """NVIDIA's compiler as a library."""

    def __init__(self, path: str) -> None:
        if os.path.isabs(path):  # it opens another by its bare name, which must be there by then
            beside = Path(path).parent.glob("libnvrtc-builtins.so.*")
            self._builtins = [ctypes.CDLL(str(each)) for each in beside if ".alt." not in each.name]
        self.path, self._library = path, ctypes.CDLL(path)
        word, call = ctypes.c_void_p, self._library
        call.nvrtcCreateProgram.argtypes = (word, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int, word, word)
        call.nvrtcCompileProgram.argtypes = (word, ctypes.c_int, word)
        for name in ("ProgramLog", "CUBIN", "PTX"):
            getattr(call, f"nvrtcGet{name}").argtypes = (word, ctypes.c_char_p)
            getattr(call, f"nvrtcGet{name}Size").argtypes = (word, word)
        major, minor = ctypes.c_int(), ctypes.c_int()
        call.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
        self.version = f"{major.value}.{minor.value}"
        self.number = 1000 * major.value + 10 * minor.value

    def architectures(self) -> list[int]:
        """Return the architectures for which it makes machine code."""
        count = ctypes.c_int()
        self._library.nvrtcGetNumSupportedArchs(ctypes.byref(count))
        held = (ctypes.c_int * count.value)()
        self._library.nvrtcGetSupportedArchs(held)
        return list(held)

    def compile(self, text: str, architecture: int) -> bytes:
        """Return machine code, or PTX of the latest that it knows where a card is newer.

        What does not fit into registers is compiled in other ways, too (`best`).
        Where a few registers less let one more warp run beside the others it has those, if nothing is
        stored for it (six percent of a chase with three centers on an H200).

        Raises:
            OSError: with what it says.
        """

        def compiled(text: str, *more: str) -> MachineCode:
            return self._compiled(text, architecture, more)

        found, spilled = best(text, compiled, shared=self.number >= _SHARED_SPILLS)
        most = _with_one_more_warp(found.registers)
        if most and not spilled:
            other = compiled(text, f"--maxrregcount={most}")
            found = found if other.stack > found.stack else other
        return found.code

    def _compiled(self, text: str, architecture: int, more: tuple[str, ...]) -> MachineCode:
        known = self.architectures()
        latest = max((each for each in known if each <= architecture), default=architecture)
        kind = "sm" if architecture in known else "compute"
        options = [*_OPTIONS, *more, f"--gpu-architecture={kind}_{architecture if kind == 'sm' else latest}"]
        words = (ctypes.c_char_p * len(options))(*(each.encode() for each in options))
        program, library = ctypes.c_void_p(), self._library
        library.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"lanes.cu", 0, None, None)
        try:
            if library.nvrtcCompileProgram(program, len(options), words):
                raise OSError(f"NVRTC {self.version}: {self._read('ProgramLog', program).decode()[:600]}")
            code = self._read("CUBIN" if kind == "sm" else "PTX", program)
            told = self._read("ProgramLog", program).decode(errors="replace")
        finally:
            library.nvrtcDestroyProgram(ctypes.byref(program))
        return measured(code, told)

    def _read(self, what: str, program: ctypes.c_void_p) -> bytes:
        size = ctypes.c_size_t()
        getattr(self._library, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
        held = ctypes.create_string_buffer(size.value)
        getattr(self._library, f"nvrtcGet{what}")(program, held)
        return held.raw


class MachineCode(NamedTuple):
    """Machine code; its registers, the bytes of a thread's memory, and of registers that are stored there."""

    code: bytes
    registers: int
    stack: int
    spilled: int
    shared: int = 0  # bytes of a block's memory


def measured(code: bytes, told: str) -> MachineCode:
    """Return machine code with what the compiler logs of it (``-v``)."""
    stack, spilled = zip(*_STACK.findall(told) or [(0, 0)], strict=True)
    most = max(map(int, _USED.findall(told)), default=0)
    shared = max(map(int, _SHARED.findall(told)), default=0)
    return MachineCode(code, most, sum(map(int, stack)), sum(map(int, spilled)), shared)


def _with_one_more_warp(registers: int) -> int:
    """Return how many registers a thread may have for one more warp to fit; 0 where it would lack many."""
    warps = _REGISTERS // (-(-max(registers, 1) // _STEP) * _STEP)
    most = _REGISTERS // (warps + 1) // _STEP * _STEP
    return most if warps < _WARPS and registers - most <= _STEP else 0


def best(text: str, compiled: Callable[..., MachineCode], *, shared: bool = True) -> tuple[MachineCode, bool]:
    """Compile a kernel; where registers are spilled for fewer of them, too, then with shared memory.

    Some numbers that are spilled, and read rarely, cost less than whole vectors in memory: for fewer
    registers it is taken with less of a thread's memory, or where nothing is spilled and it is little more;
    with shared memory, which the cache of a thread's memory then lacks, where nothing is spilled any more.

    It returns the machine code that is taken, and whether the first one spilled registers; ``shared`` says
    whether the compiler can keep in shared memory what it spills.
    """
    first = found = compiled(text)
    options: tuple[str, ...] = ()
    if not first.spilled:
        return first, False
    fewer = compiled(text, FEWER_REGISTERS)
    if fewer.stack < first.stack or (fewer.spilled == 0 and 2 * fewer.stack <= 3 * first.stack):
        found, options = fewer, (FEWER_REGISTERS,)
    if found.spilled and shared:
        with contextlib.suppress(OSError):  # of a compiler that does not take it
            other = compiled(with_shared_memory(text), *options)
            found = found if other.spilled else other
    return found, True


@functools.cache
def _nvrtc() -> Nvrtc | None:
    for path in _libraries():
        try:
            return Nvrtc(path)
        except (OSError, AttributeError):
            continue
    return None


def kernel_compiler() -> str:
    """Return what compiles kernels here, in a few words."""
    found = _nvrtc()
    return f"none: {REMEDY}" if found is None else f"NVRTC {found.version}"


def _libraries() -> Iterator[str]:
    """Yield where NVRTC may be: what `cuda.bindings` finds, what torch brings, what the system has."""
    try:
        pathfinder: Any = importlib.import_module("cuda.pathfinder")
        yield str(pathfinder.load_nvidia_dynamic_lib("nvrtc").abs_path)
    except Exception as error:  # not installed, or it finds none: of any kind
        _log.debug("cuda.pathfinder finds no NVRTC: %s", error)
    version = (torch.version.cuda or "").partition(".")[0]
    packages = Path(torch.__file__).parent.parent / "nvidia"
    places = (
        packages.glob("*/lib/libnvrtc.so.*"),
        (Path(torch.__file__).parent / "lib").glob("libnvrtc*.so*"),
    )
    there = [
        str(path)
        for path in itertools.chain(*places)
        if "builtins" not in path.name and ".alt." not in path.name
    ]
    yield from sorted(there, key=lambda path: not path.endswith(f".so.{version}"))
    yield from (f"libnvrtc.so.{version}", "libnvrtc.so")
