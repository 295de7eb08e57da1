"""Sixteen-lane vectors for numba kernels, so that hot loops use the machine's vector unit without
relying on the auto-vectoriser.

Numba's automatic vectoriser gives up on loops with many arrays. These types lower to LLVM's
portable ``<16 x float>`` (and double, and bool) values, which LLVM maps to one AVX-512 register,
two AVX2 registers or four NEON registers. Arithmetic follows IEEE rules (no fast-math), except that
`fma` may round once or twice depending on the machine.

Inside a kernel: ``load``/``store`` at a flat index of a one-dimensional contiguous array, ``splat``
a scalar, the operators ``+ - * /`` on two vectors, comparisons that give masks, ``select``,
``bits`` of a mask.
"""

# Numba's extension interface is untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc,no-any-unimported"

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_I32 = ir.IntType(32)
_ELEMENTS = {"f32": ir.FloatType(), "f64": ir.DoubleType(), "bool": ir.IntType(1), "i32": _I32}
_VECTORS = {name: ir.VectorType(element, LANES) for name, element in _ELEMENTS.items()}


class VectorTypeF32(types.Type):
    """Sixteen float32 values."""

    element = "f32"


class VectorTypeF64(types.Type):
    """Sixteen float64 values."""

    element = "f64"


class VectorTypeBool(types.Type):
    """Sixteen truth values."""

    element = "bool"


class VectorTypeI32(types.Type):
    """Sixteen int32 values."""

    element = "i32"


F32X16 = VectorTypeF32("f32x16")
F64X16 = VectorTypeF64("f64x16")
MASK16 = VectorTypeBool("mask16")
I32X16 = VectorTypeI32("i32x16")
_FLOAT_VECTORS = (F32X16, F64X16)


def _register(numba_type: type) -> None:
    @register_model(numba_type)
    class Model(models.PrimitiveModel):  # type: ignore[misc,unused-ignore]
        def __init__(self, manager, front_end_type):
            super().__init__(manager, front_end_type, _VECTORS[numba_type.element])  # type: ignore[attr-defined]


for _type in (VectorTypeF32, VectorTypeF64, VectorTypeBool, VectorTypeI32):
    _register(_type)


def _vector_of(scalar: Any) -> Any:
    return {types.float32: F32X16, types.float64: F64X16, types.int32: I32X16}.get(scalar)


def _broadcast(builder, value):
    vector = ir.VectorType(value.type, LANES)
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, _I32(0))
    return builder.shuffle_vector(
        first, undefined, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES)
    )


@intrinsic
def splat(typingctx, value):
    """Return a vector whose lanes all hold ``value``."""
    vector = _vector_of(value)
    if vector is None:
        return None

    def codegen(context, builder, sig, args):
        return _broadcast(builder, args[0])

    return vector(value), codegen


@intrinsic
def lane_pattern(typingctx, low, high):
    """Return ``low * (lane % 4) + high * (lane // 4)``: coordinates of a 4 x 4 block of pixels, row
    by row.
    """

    def codegen(context, builder, sig, args):
        vector = _VECTORS["f32"]
        column = ir.Constant(vector, [float(i % 4) for i in range(LANES)])
        row = ir.Constant(vector, [float(i // 4) for i in range(LANES)])
        product = builder.fmul(_broadcast(builder, args[0]), column)
        return builder.fadd(product, builder.fmul(_broadcast(builder, args[1]), row))

    return F32X16(types.float32, types.float32), codegen


def _element_pointer(context, builder, array_type, array, index, vector):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Return sixteen consecutive elements of a one-dimensional contiguous array, without bounds
    check.
    """
    vector = _vector_of(array.dtype)

    def codegen(context, builder, sig, args):
        pointer = _element_pointer(
            context, builder, sig.args[0], args[0], args[1], _VECTORS[vector.element]
        )
        return builder.load(pointer, align=array.dtype.bitwidth // 8)

    return vector(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Write sixteen consecutive elements of a one-dimensional contiguous array, without bounds
    check.
    """

    def codegen(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], args[0], args[1], args[2].type)
        builder.store(args[2], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


def _operator(symbol, kinds, result, emit) -> None:
    """Give a Python operator on two vectors of one kind its result type and its instruction."""

    @infer_global(symbol)
    class Typing(AbstractTemplate):  # type: ignore[misc,unused-ignore]
        def generic(self, args, kws):
            if len(args) == 2 and args[0] == args[1] and args[0] in kinds:
                return signature(result or args[0], *args)
            return None

    for kind in kinds:
        lower_builtin(symbol, kind, kind)(lambda context, builder, sig, args: emit(builder, *args))


_operator(operator.add, _FLOAT_VECTORS, None, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, _FLOAT_VECTORS, None, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, _FLOAT_VECTORS, None, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, _FLOAT_VECTORS, None, lambda builder, a, b: builder.fdiv(a, b))
_operator(
    operator.lt, _FLOAT_VECTORS, MASK16, lambda builder, a, b: builder.fcmp_ordered("<", a, b)
)
_operator(
    operator.le, _FLOAT_VECTORS, MASK16, lambda builder, a, b: builder.fcmp_ordered("<=", a, b)
)
_operator(
    operator.gt, _FLOAT_VECTORS, MASK16, lambda builder, a, b: builder.fcmp_ordered(">", a, b)
)
_operator(
    operator.ge, _FLOAT_VECTORS, MASK16, lambda builder, a, b: builder.fcmp_ordered(">=", a, b)
)
_operator(operator.and_, (MASK16,), MASK16, lambda builder, a, b: builder.and_(a, b))
_operator(operator.or_, (MASK16,), MASK16, lambda builder, a, b: builder.or_(a, b))


def _declare(builder, name: str, vector, n_args: int):
    suffix = "f32" if vector == _VECTORS["f32"] else "f64"
    return cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(vector, [vector] * n_args), f"llvm.{name}.v{LANES}{suffix}"
    )


def _llvm_function(name: str, n_args: int):
    @intrinsic
    def unary(typingctx, a):
        def codegen(context, builder, sig, args):
            return builder.call(_declare(builder, name, args[0].type, len(args)), args)

        return a(a), codegen

    @intrinsic
    def ternary(typingctx, a, b, c):
        def codegen(context, builder, sig, args):
            return builder.call(_declare(builder, name, args[0].type, len(args)), args)

        return a(a, b, c), codegen

    return unary if n_args == 1 else ternary


fma = _llvm_function("fmuladd", 3)  # a * b + c
sqrt = _llvm_function("sqrt", 1)
absolute = _llvm_function("fabs", 1)


@intrinsic
def fnma(typingctx, a, b, c):
    """Return ``c - a * b``."""

    def codegen(context, builder, sig, args):
        function = _declare(builder, "fmuladd", args[0].type, 3)
        return builder.call(function, [builder.fneg(args[0]), args[1], args[2]])

    return a(a, b, c), codegen


@intrinsic
def negative(typingctx, a):
    """Return ``-a``."""

    def codegen(context, builder, sig, args):
        return builder.fneg(args[0])

    return a(a), codegen


@intrinsic
def select(typingctx, mask, yes, no):
    """Return lanes of ``yes`` where the mask is set, of ``no`` elsewhere; NaN in a lane not chosen
    is discarded.
    """

    def codegen(context, builder, sig, args):
        return builder.select(*args)

    return yes(mask, yes, no), codegen


def _extreme(predicate: str):
    @intrinsic
    def operation(typingctx, a, b):
        def codegen(context, builder, sig, args):
            return builder.select(builder.fcmp_ordered(predicate, *args), *args)

        return a(a, b), codegen

    return operation


minimum = _extreme("<")  # b where either is NaN, as the machine instruction does
maximum = _extreme(">")


@intrinsic
def bits(typingctx, mask):
    """Return the mask as an integer, lane 0 in the lowest bit."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.int64(mask), codegen


@intrinsic
def has_bit(typingctx, a, position):
    """Return a mask of the lanes of an int32 vector in which the bit at ``position`` is set."""

    def codegen(context, builder, sig, args):
        bit = builder.shl(_I32(1), builder.trunc(args[1], _I32))
        both = builder.and_(args[0], _broadcast(builder, bit))
        return builder.icmp_unsigned("!=", both, ir.Constant(_VECTORS["i32"], None))

    return MASK16(I32X16, types.int64), codegen


@intrinsic
def total(typingctx, a):
    """Return the sum of the lanes: halves are added onto each other, an order that is the same on
    every machine.
    """

    def codegen(context, builder, sig, args):
        value, lanes = args[0], LANES
        while lanes > 1:
            lanes //= 2
            low, high = (
                ir.Constant(ir.VectorType(_I32, lanes), list(range(first, first + lanes)))
                for first in (0, lanes)
            )
            value = builder.fadd(
                builder.shuffle_vector(value, value, low),
                builder.shuffle_vector(value, value, high),
            )
        return builder.extract_element(value, _I32(0))

    return (types.float32 if a is F32X16 else types.float64)(a), codegen


@intrinsic
def to_f32(typingctx, a):
    """Round a float64 vector to float32."""

    def codegen(context, builder, sig, args):
        return builder.fptrunc(args[0], _VECTORS["f32"])

    return F32X16(F64X16), codegen


@intrinsic
def lowest_bit(typingctx, value):
    """Return the position of the lowest set bit of a non-zero int64."""

    def codegen(context, builder, sig, args):
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), codegen


@intrinsic
def fetch_add(typingctx, array, index, value):
    """Add to an int64 element atomically and return what it held before: hands out work and room to
    threads.
    """

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.intp, types.int64), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of an element that will be read soon; the index may lie outside of the
    array.
    """

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(
            function, [pointer, _I32(0), _I32(3), _I32(1)]
        )  # read, keep in all caches, data
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
