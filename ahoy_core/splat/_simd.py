"""Sixteen-lane vectors for Numba kernels: one lane per pixel of a 4 x 4 block.

Numba's own loops vectorise only where LLVM can prove it worthwhile, and never keep a mask in a register. These types
are LLVM vectors (`<16 x float>`, `<16 x double>`, `<16 x i32>`, `<16 x i1>`) with Python operators, which LLVM maps to
whatever the machine has: one AVX-512 register, two of AVX2, four of SSE or NEON.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types

from ahoy_core.splat._jit import intrinsic
from ahoy_core.splat._vectors import LANES, VecType, broadcast, call_llvm, element_pointer, suffix


@intrinsic
def splat(typingctx: Any, value: Any) -> Any:
    """Vector with one scalar in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return broadcast(builder, args[0])

    return VecType(value)(value), codegen


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Sixteen consecutive elements of a contiguous array, from a flat index on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[0], args[0], args[1])
        kind = ir.VectorType(pointer.type.pointee, LANES)
        return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=sig.args[0].dtype.bitwidth // 8)

    return VecType(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen consecutive elements of a contiguous array, from a flat index on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[0], args[0], args[1])
        pointer = builder.bitcast(pointer, args[2].type.as_pointer())
        builder.store(args[2], pointer, align=sig.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.none(array, types.intp, value), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of an element ahead of its use."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[0], args[0], args[1])
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        hints = [ir.Constant(i32, hint) for hint in (0, 3, 1)]
        call_llvm(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, *hints])
        return context.get_dummy_value()

    return types.none(array, types.intp), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """The vector a * b + c, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_llvm(builder, f"llvm.fmuladd.{suffix(sig.return_type)}", args[0].type, list(args))

    return a(a, a, a), codegen


@intrinsic
def fnma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """The vector c - a * b, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        operands = [builder.fneg(args[0]), args[1], args[2]]
        return call_llvm(builder, f"llvm.fmuladd.{suffix(sig.return_type)}", args[0].type, operands)

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
            other = args[1] if isinstance(sig.args[1], VecType) else broadcast(builder, args[1])
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
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in the lowest bit."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask), codegen


@intrinsic
def lowest_bit(typingctx: Any, value: Any) -> Any:
    """Index of the lowest set bit of a non-zero uint64."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_llvm(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], ir.Constant(ir.IntType(1), 1)])

    return types.intp(types.uint64), codegen
