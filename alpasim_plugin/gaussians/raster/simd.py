"""Sixteen-lane vectors for numba kernels, so that hot loops use the machine's vector unit without
relying on the auto-vectoriser.

Numba's automatic vectoriser gives up on loops with many arrays. These types lower to LLVM's
portable ``<16 x float>`` (and double, and bool) values, which LLVM maps to one AVX-512 register,
two AVX2 registers or four NEON registers. Arithmetic follows IEEE rules (no fast-math), except that
`fma` may round once or twice depending on the machine.

Inside a kernel: ``load``/``store`` at a flat index of a one-dimensional contiguous array, ``splat``
a scalar, the operators ``+ - * /``, comparisons that give masks, ``select``, ``bits`` of a mask.
Every operation takes a number in place of one of its vectors, which then stands in all lanes.
"""

# Numba's extension interface is untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc,no-any-unimported"

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


class Vector(types.Type):
    """Sixteen values of one kind."""

    def __init__(self, name: str, kind: str) -> None:
        self.kind = kind
        super().__init__(name)


F32X16 = Vector("f32x16", "f32")
F64X16 = Vector("f64x16", "f64")
MASK16 = Vector("mask16", "bool")
I32X16 = Vector("i32x16", "i32")
_FLOAT_VECTORS = (F32X16, F64X16)


@register_model(Vector)
class _Model(models.PrimitiveModel):  # type: ignore[misc,unused-ignore]
    def __init__(self, manager, front_end_type):
        super().__init__(manager, front_end_type, _VECTORS[front_end_type.kind])


def _vector_of(scalar: Any) -> Any:
    return {types.float32: F32X16, types.float64: F64X16, types.int32: I32X16}.get(scalar)


def _broadcast(builder, value):
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, value, _I32(0))
    return builder.shuffle_vector(
        first, undefined, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES)
    )


def _common(args) -> Any:
    """Return the type of the float vectors among arguments whose others are numbers, or None."""
    vectors = [a for a in args if a in _FLOAT_VECTORS]
    fits = vectors and all(a == vectors[0] or isinstance(a, types.Number) for a in args)
    return vectors[0] if fits else None


def _in_all_lanes(context, builder, vector, kinds, args):
    """Return arguments as vectors: numbers are converted and stand in all lanes."""
    scalar = types.float32 if vector == F32X16 else types.float64
    return [
        arg if kind == vector else _broadcast(builder, context.cast(builder, arg, kind, scalar))
        for kind, arg in zip(kinds, args, strict=True)
    ]


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
            context, builder, sig.args[0], args[0], args[1], _VECTORS[vector.kind]
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


def _operator(symbol, result, emit) -> None:
    """Give a Python operator on float vectors its result type and its instruction."""

    @infer_global(symbol)
    class Typing(AbstractTemplate):  # type: ignore[misc,unused-ignore]
        def generic(self, args, kws):
            vector = _common(args) if len(args) == 2 else None
            return vector and signature(result or vector, *args)

    def lower(context, builder, sig, args):
        vectors = _in_all_lanes(context, builder, _common(sig.args), sig.args, args)
        return emit(builder, *vectors)

    for pair in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(symbol, *pair)(lower)


_operator(operator.add, None, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, None, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, None, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, None, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.lt, MASK16, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_operator(operator.le, MASK16, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_operator(operator.gt, MASK16, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_operator(operator.ge, MASK16, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))


@infer_global(operator.and_)
class _BothMasks(AbstractTemplate):  # type: ignore[misc,unused-ignore]
    def generic(self, args, kws):
        return signature(MASK16, *args) if args == (MASK16, MASK16) else None


lower_builtin(operator.and_, MASK16, MASK16)(
    lambda context, builder, sig, args: builder.and_(*args)
)


def _function(n_args: int, emit):
    """Return an operation of one or three float vectors; ``emit`` writes its instruction."""

    def codegen(context, builder, sig, args):
        return emit(builder, *_in_all_lanes(context, builder, sig.return_type, sig.args, args))

    def unary(typingctx, a):
        return a(a), codegen

    def binary(typingctx, a, b):
        return _common((a, b))(a, b), codegen

    def ternary(typingctx, a, b, c):
        return _common((a, b, c))(a, b, c), codegen

    return intrinsic((unary, binary, ternary)[n_args - 1])


def _call(builder, name: str, *args):
    """Call the function of LLVM for a vector's type."""
    vector = args[0].type
    suffix = "f32" if vector == _VECTORS["f32"] else "f64"
    kind = ir.FunctionType(vector, [vector] * len(args))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}{suffix}")
    return builder.call(function, args)


sqrt = _function(1, lambda builder, a: _call(builder, "sqrt", a))
absolute = _function(1, lambda builder, a: _call(builder, "fabs", a))
negative = _function(1, lambda builder, a: builder.fneg(a))
fma = _function(3, lambda builder, a, b, c: _call(builder, "fmuladd", a, b, c))  # a * b + c
fnma = _function(3, lambda builder, a, b, c: _call(builder, "fmuladd", builder.fneg(a), b, c))


def _extreme(predicate: str):
    """Return the operation that takes b where either is NaN, as the machine instruction does."""
    return _function(
        2, lambda builder, a, b: builder.select(builder.fcmp_ordered(predicate, a, b), a, b)
    )


minimum = _extreme("<")
maximum = _extreme(">")


@intrinsic
def select(typingctx, mask, yes, no):
    """Return lanes of ``yes`` where the mask is set, of ``no`` elsewhere; NaN in a lane not chosen
    is discarded.
    """

    def codegen(context, builder, sig, args):
        vectors = _in_all_lanes(context, builder, sig.return_type, sig.args[1:], args[1:])
        return builder.select(args[0], *vectors)

    return (_common((yes, no)) or F32X16)(mask, yes, no), codegen


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
        masked = builder.and_(args[0], _broadcast(builder, bit))
        return builder.icmp_unsigned("!=", masked, ir.Constant(_VECTORS["i32"], None))

    return MASK16(I32X16, types.int64), codegen


@intrinsic
def total(typingctx, a):
    """Return the sum of the lanes: halves are added onto each other, an order that is the same on
    every machine.
    """

    def codegen(context, builder, sig, args):
        value = args[0]
        lanes = LANES
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
def to_f64(typingctx, a):
    """Return a float32 vector in float64."""

    def codegen(context, builder, sig, args):
        return builder.fpext(args[0], _VECTORS["f64"])

    return F64X16(F32X16), codegen


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
        # Read access (0), kept in all caches (3), of data (1).
        builder.call(function, [pointer, _I32(0), _I32(3), _I32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
