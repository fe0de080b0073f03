"""Sixteen-lane vectors for Numba kernels: one lane per pixel of a 4 x 4 block.

Numba's own loops vectorise only where LLVM can prove it worthwhile, and never keep a mask in a register. These types
are LLVM vectors (`<16 x float>`, `<16 x double>`, `<16 x i32>`, `<16 x i1>`) with Python operators, which LLVM maps to
whatever the machine has: one AVX-512 register, two of AVX2, four of SSE or NEON.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Final

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES: Final = 16


class VecType(types.Type):
    """Sixteen float32, float64 or int32 values in registers."""

    def __init__(self, scalar: types.Type) -> None:
        self.scalar = scalar
        super().__init__(name=f"Vec{LANES}({scalar})")


class MaskType(types.Type):
    """Sixteen truth values, one per lane."""

    def __init__(self) -> None:
        super().__init__(name=f"Mask{LANES}")


MASK = MaskType()


@register_model(VecType)
class _VecModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: VecType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(dmm.lookup(fe_type.scalar).get_value_type(), LANES))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: MaskType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), LANES))


def _broadcast(builder: Any, value: Any) -> Any:
    """Scalar -> vector with the value in every lane."""
    kind = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), zeros)


def _register(op: Any, emit: Callable[[Any, VecType, Any, Any], Any], result: Callable[[VecType], types.Type]) -> None:
    """Give a binary operator to two vectors, or to a vector and a scalar in either order."""

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if len(args) != 2:
                return None
            left, right = args
            if isinstance(left, VecType) and isinstance(right, types.Number | types.Literal):
                return signature(result(left), left, left.scalar)
            if isinstance(right, VecType) and isinstance(left, types.Number | types.Literal):
                return signature(result(right), right.scalar, right)
            return signature(result(left), left, right) if isinstance(left, VecType) and left == right else None

    @lower_builtin(op, VecType, VecType)
    def _both(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, sig.args[0], args[0], args[1])

    @lower_builtin(op, VecType, types.Number)
    def _right(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, sig.args[0], args[0], _broadcast(builder, args[1]))

    @lower_builtin(op, types.Number, VecType)
    def _left(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, sig.args[1], _broadcast(builder, args[0]), args[1])


def _arithmetic(name: str) -> Callable[[Any, VecType, Any, Any], Any]:
    def emit(builder: Any, kind: VecType, a: Any, b: Any) -> Any:
        prefix = "f" if isinstance(kind.scalar, types.Float) else ("s" if name == "div" else "")
        return getattr(builder, prefix + name)(a, b)

    return emit


def _comparison(symbol: str) -> Callable[[Any, VecType, Any, Any], Any]:
    def emit(builder: Any, kind: VecType, a: Any, b: Any) -> Any:
        if isinstance(kind.scalar, types.Float):
            return builder.fcmp_ordered(symbol, a, b)
        return builder.icmp_signed(symbol, a, b)

    return emit


for _op, _name in ((operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.truediv, "div")):
    _register(_op, _arithmetic(_name), lambda kind: kind)
for _op, _name in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _register(_op, _comparison(_name), lambda kind: MASK)


@infer_global(operator.neg)
class _Negation(AbstractTemplate):
    def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
        return signature(args[0], args[0]) if isinstance(args[0], VecType) else None


@lower_builtin(operator.neg, VecType)
def _negate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


def _register_mask(op: Any, name: str) -> None:
    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            return signature(MASK, MASK, MASK) if args == (MASK, MASK) else None

    @lower_builtin(op, MaskType, MaskType)
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(args[0], args[1])


_register_mask(operator.and_, "and_")
_register_mask(operator.or_, "or_")


def _call(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    """Call an LLVM intrinsic function."""
    function_type = ir.FunctionType(result, [a.type for a in args])
    module = builder.module
    found = module.globals.get(name)
    function = found if found is not None else ir.Function(module, function_type, name)
    return builder.call(function, args)


def _suffix(kind: VecType) -> str:
    return f"v{LANES}f{kind.scalar.bitwidth}"


def _element_pointer(context: Any, builder: Any, array_type: types.Array, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def splat(typingctx: Any, value: Any) -> Any:
    """Vector with one scalar in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, args[0])

    return VecType(value)(value), codegen


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Sixteen consecutive elements of a contiguous array, from a flat index on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        kind = ir.VectorType(pointer.type.pointee, LANES)
        return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=sig.args[0].dtype.bitwidth // 8)

    return VecType(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen consecutive elements of a contiguous array, from a flat index on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        pointer = builder.bitcast(pointer, args[2].type.as_pointer())
        builder.store(args[2], pointer, align=sig.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.none(array, types.intp, value), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of an element ahead of its use."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        hints = [ir.Constant(i32, hint) for hint in (0, 3, 1)]
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, *hints])
        return context.get_dummy_value()

    return types.none(array, types.intp), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """The vector a * b + c, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, f"llvm.fmuladd.{_suffix(sig.return_type)}", args[0].type, list(args))

    return a(a, a, a), codegen


@intrinsic
def fnma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """The vector c - a * b, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        operands = [builder.fneg(args[0]), args[1], args[2]]
        return _call(builder, f"llvm.fmuladd.{_suffix(sig.return_type)}", args[0].type, operands)

    return a(a, a, a), codegen


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Lanes of a where the mask holds, of b elsewhere."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return a(mask, a, a), codegen


def _extremum(symbol: str) -> Callable[[Any, Any, Any], Any]:
    """Typing and code of a lane-wise choice between a vector and a vector or scalar."""

    def define(typingctx: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            other = args[1] if isinstance(sig.args[1], VecType) else _broadcast(builder, args[1])
            return builder.select(builder.fcmp_ordered(symbol, args[0], other), args[0], other)

        return a(a, a if isinstance(b, VecType) else a.scalar), codegen

    return define


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane-wise minimum; b where a is NaN."""
    return _extremum("<")(typingctx, a, b)


@intrinsic
def maximum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane-wise maximum; b where a is NaN."""
    return _extremum(">")(typingctx, a, b)


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Lane-wise square root."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, f"llvm.sqrt.{_suffix(sig.return_type)}", args[0].type, list(args))

    return a(a), codegen


_LOG2_TERMS: Final = 12


@intrinsic
def log2(typingctx: Any, value: Any) -> Any:
    """Base-2 logarithm of float64 lanes that are positive normal numbers; other lanes give garbage.

    With the mantissa m in [sqrt(1/2), sqrt(2)) and s = (m - 1) / (m + 1): log2 m = 2 / ln 2 (s + s^3 / 3 + ...), of
    which twelve terms leave less than 1e-17.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = args[0].type
        integers = ir.VectorType(ir.IntType(64), LANES)

        def whole(number: int) -> Any:
            return ir.Constant(integers, [number] * LANES)

        def real(number: float) -> Any:
            return ir.Constant(kind, [number] * LANES)

        root_half = 0x3FE6A09E667F3BCD
        shifted = builder.sub(builder.bitcast(args[0], integers), whole(root_half))
        exponent = builder.ashr(shifted, whole(52))
        mantissa = builder.sub(builder.bitcast(args[0], integers), builder.shl(exponent, whole(52)))
        m = builder.bitcast(mantissa, kind)
        s = builder.fdiv(builder.fsub(m, real(1.0)), builder.fadd(m, real(1.0)))
        square = builder.fmul(s, s)
        total = real(1.0 / (2 * _LOG2_TERMS - 1))
        for k in range(_LOG2_TERMS - 2, -1, -1):
            total = _call(builder, f"llvm.fmuladd.{_suffix(sig.args[0])}", kind, [total, square, real(1 / (2 * k + 1))])
        fraction = builder.fmul(builder.fmul(s, total), real(2 / 0.6931471805599453))
        return builder.fadd(builder.sitofp(exponent, kind), fraction)

    return value(value), codegen


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in the lowest bit."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask), codegen


@intrinsic
def lowest_bit(typingctx: Any, value: Any) -> Any:
    """Index of the lowest set bit of a non-zero uint64."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], ir.Constant(ir.IntType(1), 1)])

    return types.intp(types.uint64), codegen


_EXP2_TERMS: Final = {32: 6, 64: 13}
_EXP2_MAGIC: Final = {32: 1.5 * 2.0**23, 64: 1.5 * 2.0**52}
_EXP2_MINIMAX_32: Final = (0.00132764721, 0.0096755414, 0.0555071327, 0.240221197, 0.693146967, 1.00000007)


def _exp2_coefficients(bitwidth: int) -> list[float]:
    """Highest power first. float64 takes the Taylor series, whose 14th term is under 1e-17 on [-1/2, 1/2]."""
    if bitwidth == 32:
        return list(_EXP2_MINIMAX_32)
    coefficients, term = [], 1.0
    for k in range(_EXP2_TERMS[64] + 1):
        coefficients.append(term)
        term *= 0.6931471805599453 / (k + 1)
    return coefficients[::-1]


@intrinsic
def exp2(typingctx: Any, power: Any) -> Any:
    """2**power for powers whose result is a normal number; lanes outside give garbage and must be masked.

    The integer part goes into the exponent by the round-to-nearest trick of adding 1.5 * 2**mantissa bits, the rest
    through a polynomial (relative error 2e-7 in float32, where the minimax fit alone has 7.5e-8; 1e-15 in float64).
    """
    width = power.scalar.bitwidth

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = args[0].type
        integers = ir.VectorType(ir.IntType(width), LANES)

        def constant(value: float) -> Any:
            return ir.Constant(kind, [value] * LANES)

        magic = constant(_EXP2_MAGIC[width])
        shifted = builder.fadd(args[0], magic)
        rest = builder.fsub(args[0], builder.fsub(shifted, magic))
        terms = _exp2_coefficients(width)
        total = constant(terms[0])
        for term in terms[1:]:
            total = _call(builder, f"llvm.fmuladd.{_suffix(sig.args[0])}", kind, [total, rest, constant(term)])
        places = ir.Constant(integers, [23 if width == 32 else 52] * LANES)
        exponent = builder.shl(builder.bitcast(shifted, integers), places)
        return builder.bitcast(builder.add(builder.bitcast(total, integers), exponent), kind)

    return power(power), codegen


def _pairwise(builder: Any, a: Any, b: Any, low: list[int], high: list[int]) -> Any:
    """Sum of two shuffles of (a, b): halves what is left to add of both."""
    index = ir.VectorType(ir.IntType(32), len(low))
    parts = [builder.shuffle_vector(a, b, ir.Constant(index, order)) for order in (low, high)]
    return builder.fadd(*parts)


def _transposed_sums(builder: Any, vectors: list[Any]) -> Any:
    """Eight vectors -> one `<8 x float>` of their sums, by a tree of in-register transpositions (23 operations)."""
    quads = range(0, LANES, 4)
    low1 = [i for q in quads for i in (q, q + LANES, q + 1, q + LANES + 1)]
    high1 = [i + 2 for i in low1]
    level = [_pairwise(builder, vectors[k], vectors[k + 1], low1, high1) for k in (0, 2, 4, 6)]
    low2 = [i for q in quads for i in (q, q + 1, q + LANES, q + LANES + 1)]
    high2 = [i + 2 for i in low2]
    level = [_pairwise(builder, level[k], level[k + 1], low2, high2) for k in (0, 2)]
    low3 = [*range(8), *range(LANES, LANES + 8)]
    high3 = [i + 8 for i in low3]
    both = _pairwise(builder, level[0], level[1], low3, high3)
    low4 = [0, 1, 2, 3, 8, 9, 10, 11]
    return _pairwise(builder, both, both, low4, [i + 4 for i in low4])


def _lane_sum(builder: Any, vector: Any) -> Any:
    """Scalar sum of a vector's lanes, halving in a fixed order."""
    width = LANES
    while width > 1:
        width //= 2
        vector = _pairwise(builder, vector, vector, list(range(width)), list(range(width, 2 * width)))
    return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))


def sums_width(count: int) -> int:
    """Elements that `add_sums` writes for this many vectors: up to two left over are added one by one."""
    return count if count % 8 <= 2 else -(-count // 8) * 8


@intrinsic
def add_sums(typingctx: Any, array: Any, index: Any, vectors: Any) -> Any:
    """Add the lane sums of a tuple of vectors to consecutive elements of an array (`sums_width` of them)."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        base = _element_pointer(context, builder, sig.args[0], args[0], args[1])
        align = sig.args[0].dtype.bitwidth // 8
        parts = cgutils.unpack_tuple(builder, args[2])
        parts += [ir.Constant(parts[0].type, [0.0] * LANES)] * (sums_width(len(parts)) - len(parts))
        eights = len(parts) // 8 * 8
        sums = [_transposed_sums(builder, parts[k : k + 8]) for k in range(0, eights, 8)]
        sums += [_lane_sum(builder, part) for part in parts[eights:]]
        offset = 0
        for value in sums:
            pointer = builder.gep(base, [ir.Constant(ir.IntType(64), offset)])
            pointer = builder.bitcast(pointer, value.type.as_pointer())
            builder.store(builder.fadd(builder.load(pointer, align=align), value), pointer, align=align)
            offset += 8 if isinstance(value.type, ir.VectorType) else 1
        return context.get_dummy_value()

    return types.none(array, types.intp, vectors), codegen


@intrinsic
def lane_sum(typingctx: Any, value: Any) -> Any:
    """Sum of the sixteen lanes, in a fixed order."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _lane_sum(builder, args[0])

    return value.scalar(value), codegen
