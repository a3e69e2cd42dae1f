"""A vector of lanes as a value inside compiled kernels: one lane is one sample, and lanes never mix.

A `Simd` value is an LLVM vector of 32- or 64-bit floats. The arithmetic operators act lane by lane; a plain number met
on the way fills all lanes. The compiler neither reorders nor contracts operations: only `fma` and `fnma` become fused
multiply-adds. So a lane's result depends neither on other lanes nor on inlining.

Kernels keep their data in C-contiguous arrays ``(n, lanes)``, or know their `addresses`, and move rows with `load` and
`store`. The compiler must know the number of lanes: kernels take a tuple, made by `lane_token`, whose length is part of
its type.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from rfdropo_bayes.fem.native.compilers import COMPILERS

ALIGNMENT = 64
"""Bytes to which work arrays are aligned: one cache line, and the widest vector register."""


def kernel(function: Callable, **options: bool) -> Callable:
    """Decorator of functions that only kernels call.

    They have no wrappers for calls from Python. With our compilers, parts become machine code only inside a `whole`.
    """
    return COMPILERS.part(function, nogil=True, error_model="numpy", no_cpython_wrapper=True, **options)


inlined = partial(kernel, forceinline=True)
"""Decorator of kernels that are compiled into their callers, whatever their size: they return many values."""

whole = partial(COMPILERS.whole, nogil=True, cache=True, error_model="numpy")
"""Decorator of the kernel at the top, which Python calls."""

# Numba's own way, each function optimised by itself, for meshes (see `compilation`): parts of a kernel, included before
# and after its types are known, and cached kernels.
mesh_part = numba.njit(nogil=True, error_model="numpy")
mesh_pasted = numba.njit(inline="always")
mesh_inlined = numba.njit(forceinline=True, error_model="numpy")
mesh_kernel = numba.njit(nogil=True, cache=True, error_model="numpy")


class SimdType(types.Type):
    """Numba type of ``lanes`` floats of one width."""

    def __init__(self, dtype: types.Float, lanes: int) -> None:
        self.dtype, self.lanes = dtype, lanes
        super().__init__(name=f"Simd({dtype}, {lanes})")


@register_model(SimdType)
class SimdModel(models.PrimitiveModel):
    """A `SimdType` is held in one LLVM vector."""

    def __init__(self, data_model_manager, front_type: SimdType) -> None:
        super().__init__(data_model_manager, front_type, vector_type(front_type))


def vector_type(simd: SimdType) -> ir.VectorType:
    """LLVM type of a `SimdType`."""
    return ir.VectorType(ir.DoubleType() if simd.dtype.bitwidth == 64 else ir.FloatType(), simd.lanes)


@cache
def vector_width() -> int:
    """Bytes of the widest vector register of the processor that Numba compiles for: this machine's, or the processor
    that ``NUMBA_CPU_NAME`` and ``NUMBA_CPU_FEATURES`` name. At least 16, as on any 64-bit machine.
    """
    # A name such as x86-64-v3 has no list of features: LLVM is asked which registers it adds 64 bytes in.
    module = llvm.parse_assembly(
        "define void @add(ptr %at) {\n"
        "%one = load <16 x float>, ptr %at\n"
        "%two = fadd <16 x float> %one, %one\n"
        "store <16 x float> %two, ptr %at\n"
        "ret void }"
    )
    assembly = cpu_target.target_context.codegen()._tm.emit_assembly(module)
    return 64 if "zmm" in assembly else 32 if "ymm" in assembly else 16


def native_lanes(dtype: Any) -> int:
    """Lanes of ``dtype`` in a vector register of `vector_width`."""
    return vector_width() // np.dtype(dtype).itemsize


def lane_token(lanes: int) -> tuple[int, ...]:
    """The argument that gives a kernel its number of lanes at compile time."""
    return (0,) * lanes


def aligned_zeros(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Zeros whose first element lies on a boundary of `ALIGNMENT` bytes."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.zeros(size + ALIGNMENT, dtype=np.uint8)
    first = -raw.ctypes.data % ALIGNMENT
    return raw[first : first + size].view(dtype).reshape(shape)


def _pointer(context, builder, array_type, array, row, simd: SimdType):
    """Address of row ``row`` of an array ``(n, lanes)``, given as such or by its address."""
    data = (
        array
        if isinstance(array_type, types.CPointer)
        else context.make_array(array_type)(context, builder, array).data
    )
    offset = builder.mul(row, ir.Constant(row.type, simd.lanes))
    return builder.bitcast(builder.gep(data, [offset]), vector_type(simd).as_pointer())


def _loaded(context, builder, sig, arguments, simd: SimdType, count: int) -> list:
    """Rows of an array from a row on."""
    first = context.cast(builder, arguments[1], sig.args[1], types.intp)
    rows = [first, *(builder.add(first, ir.Constant(first.type, k)) for k in range(1, count))]
    pointers = [_pointer(context, builder, sig.args[0], arguments[0], row, simd) for row in rows]
    return [builder.load(pointer, align=simd.dtype.bitwidth // 8) for pointer in pointers]


@intrinsic
def load(typing_context, array, row, token):
    """Row ``row`` of an array ``(n, lanes)`` as a `Simd` value."""
    simd = SimdType(array.dtype, len(token))

    def generate(context, builder, sig, arguments):
        return _loaded(context, builder, sig, arguments, simd, 1)[0]

    return simd(array, row, token), generate


@intrinsic
def load3(typing_context, array, row, token):
    """Three rows of an array ``(n, lanes)`` from ``row`` on."""
    simd = SimdType(array.dtype, len(token))

    def generate(context, builder, sig, arguments):
        return context.make_tuple(builder, sig.return_type, _loaded(context, builder, sig, arguments, simd, 3))

    return types.UniTuple(simd, 3)(array, row, token), generate


@intrinsic
def store(typing_context, array, row, *values):
    """Write `Simd` values to the rows of an array ``(n, lanes)`` from ``row`` on."""
    if not all(isinstance(value, SimdType) for value in values):
        return None

    def generate(context, builder, sig, arguments):
        first = context.cast(builder, arguments[1], sig.args[1], types.intp)
        for k, value in enumerate(cgutils.unpack_tuple(builder, arguments[2])):
            place = builder.add(first, ir.Constant(first.type, k))
            pointer = _pointer(context, builder, sig.args[0], arguments[0], place, values[k])
            builder.store(value, pointer, align=values[k].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, row, types.BaseTuple.from_types(values)), generate


@intrinsic
def addresses(typing_context, record):
    """A named tuple of arrays as one of bare addresses, its numbers as they are.

    Arrays are structures whose owners are counted; handing addresses from kernel to kernel compiles several times
    faster. An address takes one index, without a check of bounds. The arrays must outlive the address.
    """

    def bare(kind):
        return types.CPointer(kind.dtype) if isinstance(kind, types.Array) else kind

    result = types.BaseTuple.from_types([bare(kind) for kind in record.types], record.instance_class)

    def generate(context, builder, sig, arguments):
        fields = cgutils.unpack_tuple(builder, arguments[0])
        values = [
            context.make_array(kind)(context, builder, field).data if isinstance(kind, types.Array) else field
            for field, kind in zip(fields, record.types, strict=True)
        ]
        return context.make_tuple(builder, result, values)

    return result(record), generate


def _splat(context, builder, number, number_type, simd: SimdType):
    scalar = context.cast(builder, number, number_type, simd.dtype)
    empty = ir.Constant(vector_type(simd), ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), simd.lanes), [0] * simd.lanes)
    return builder.shuffle_vector(first, empty, mask)


@intrinsic
def fill(typing_context, number, array, token):
    """A number in all lanes, in the precision of ``array``."""
    simd = SimdType(array.dtype, len(token))

    def generate(context, builder, sig, arguments):
        return _splat(context, builder, arguments[0], sig.args[0], simd)

    return simd(number, array, token), generate


def _vectors(context, builder, sig, arguments) -> list:
    """Arguments, with plain numbers broadcast to all lanes."""
    return [
        value if isinstance(kind, SimdType) else _splat(context, builder, value, kind, sig.return_type)
        for value, kind in zip(arguments, sig.args, strict=True)
    ]


def _binary(name: str) -> Callable:
    return lambda context, builder, sig, arguments: getattr(builder, name)(*_vectors(context, builder, sig, arguments))


for _operator, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    for _left, _right in ((SimdType, SimdType), (SimdType, types.Number), (types.Number, SimdType)):
        lower_builtin(_operator, _left, _right)(_binary(_name))

    @infer_global(_operator)
    class _BinaryTemplate(AbstractTemplate):
        """Lane-wise arithmetic of two vectors, or of a vector and a number."""

        def generic(self, args, kws):
            left, right = args
            if isinstance(left, SimdType) and (left == right or isinstance(right, types.Number)):
                return signature(left, left, right)
            if isinstance(right, SimdType) and isinstance(left, types.Number):
                return signature(right, left, right)
            return None


@lower_builtin(operator.neg, SimdType)
def _negate(context, builder, sig, arguments):
    return builder.fneg(arguments[0])


@infer_global(operator.neg)
class _NegateTemplate(AbstractTemplate):
    """Sign change of every lane."""

    def generic(self, args, kws):
        return signature(args[0], args[0]) if isinstance(args[0], SimdType) else None


def _lanewise(builder, name: str, simd: SimdType, arguments: list):
    """Call of LLVM's own function of vectors."""
    kind = vector_type(simd)
    signed, name = ir.FunctionType(kind, [kind] * len(arguments)), f"llvm.{name}.v{simd.lanes}f{simd.dtype.bitwidth}"
    return builder.call(cgutils.get_or_insert_function(builder.module, signed, name), arguments)


def _fused(negative: bool) -> Callable:
    def generate(context, builder, sig, arguments):
        first, second, third = _vectors(context, builder, sig, arguments)
        return _lanewise(builder, "fma", sig.return_type, [builder.fneg(first) if negative else first, second, third])

    return generate


@intrinsic
def fma(typing_context, first, second, third):
    """first * second + third, rounded once; ``second`` may be a number."""
    return (first(first, second, third), _fused(False)) if isinstance(first, SimdType) else None


@intrinsic
def fnma(typing_context, first, second, third):
    """third - first * second, rounded once; ``second`` may be a number."""
    return (first(first, second, third), _fused(True)) if isinstance(first, SimdType) else None


@intrinsic
def square_root(typing_context, value):
    """Square root of every lane."""
    if not isinstance(value, SimdType):
        return None

    def generate(context, builder, sig, arguments):
        return _lanewise(builder, "sqrt", value, arguments)

    return value(value), generate


@intrinsic
def where_greater(typing_context, left, right, first, second):
    """``first`` in the lanes with left > right, ``second`` elsewhere (also for NaN)."""
    if not all(isinstance(kind, SimdType) for kind in (left, right, first, second)):
        return None

    def generate(context, builder, sig, arguments):
        return builder.select(builder.fcmp_ordered(">", arguments[0], arguments[1]), arguments[2], arguments[3])

    return first(left, right, first, second), generate


@kernel
def magnitude(value, zero):
    """Absolute value of every lane."""
    return where_greater(value, zero, value, -value)


@intrinsic
def any_greater(typing_context, left, right):
    """True if left > right in any lane."""
    if not (isinstance(left, SimdType) and left == right):
        return None

    def generate(context, builder, sig, arguments):
        bits = builder.fcmp_ordered(">", *arguments)
        return builder.icmp_unsigned(
            "!=", builder.bitcast(bits, ir.IntType(left.lanes)), ir.Constant(ir.IntType(left.lanes), 0)
        )

    return types.boolean(left, right), generate


# Numba loads this before its first kernel (0.4 s): with the other imports rather than in the first rollout.
cpu_target.target_context.refresh()
