"""Feature channels of a Gaussian held in registers: tuples of vectors, unrolled for the number of channels.

`like` is a tuple whose length is the (padded) number of channels; only its type matters.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from ahoy_core.splat._jit import intrinsic
from ahoy_core.splat._vectors import LANES, VecType, broadcast, call_llvm, element_pointer, suffix


def _load(builder: Any, pointer: Any, offset: int, array_type: Any) -> Any:
    pointer = builder.gep(pointer, [ir.Constant(ir.IntType(64), offset)])
    kind = ir.VectorType(pointer.type.pointee, LANES)
    return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=array_type.dtype.bitwidth // 8)


def _fma(builder: Any, kind: VecType, a: Any, b: Any, c: Any) -> Any:
    return call_llvm(builder, f"llvm.fmuladd.{suffix(kind)}", a.type, [a, b, c])


@intrinsic
def splat_channels(typingctx: Any, array: Any, index: Any, like: Any) -> Any:
    """Consecutive elements of an array, each in all lanes of its own vector."""
    kind = VecType(array.dtype)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[0], args[0], args[1])
        parts = []
        for channel in range(sig.return_type.count):
            element = builder.gep(pointer, [ir.Constant(ir.IntType(64), channel)])
            parts.append(broadcast(builder, builder.load(element, align=array.dtype.bitwidth // 8)))
        return context.make_tuple(builder, sig.return_type, parts)

    return types.UniTuple(kind, like.count)(array, types.intp, like), codegen


@intrinsic
def zero_channels(typingctx: Any, zero: Any, like: Any) -> Any:
    """A vector, usually of zeros, for every channel."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_tuple(builder, sig.return_type, [args[0]] * sig.return_type.count)

    return types.UniTuple(zero, like.count)(zero, like), codegen


@intrinsic
def channel_dot(typingctx: Any, colors: Any, array: Any, index: Any) -> Any:
    """Sum over channels of a colour times the stored plane of that channel."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[1], args[1], args[2])
        total = None
        for channel, color in enumerate(cgutils.unpack_tuple(builder, args[0])):
            plane = _load(builder, pointer, channel * LANES, sig.args[1])
            total = builder.fmul(color, plane) if total is None else _fma(builder, sig.return_type, color, plane, total)
        return total

    return colors.dtype(colors, array, types.intp), codegen


@intrinsic
def channel_weigh(typingctx: Any, sums: Any, weight: Any, array: Any, index: Any) -> Any:
    """Each channel's sum plus weight times the stored plane of that channel."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[2], args[2], args[3])
        parts = []
        for channel, total in enumerate(cgutils.unpack_tuple(builder, args[0])):
            plane = _load(builder, pointer, channel * LANES, sig.args[2])
            parts.append(_fma(builder, sig.args[1], args[1], plane, total))
        return context.make_tuple(builder, sig.return_type, parts)

    return sums(sums, weight, array, types.intp), codegen


@intrinsic
def channel_blend(typingctx: Any, colors: Any, weight: Any, array: Any, index: Any) -> Any:
    """Add weight times colour to the stored plane of every channel."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = element_pointer(context, builder, sig.args[2], args[2], args[3])
        align = sig.args[2].dtype.bitwidth // 8
        for channel, color in enumerate(cgutils.unpack_tuple(builder, args[0])):
            plane = _load(builder, pointer, channel * LANES, sig.args[2])
            target = builder.gep(pointer, [ir.Constant(ir.IntType(64), channel * LANES)])
            target = builder.bitcast(target, plane.type.as_pointer())
            builder.store(_fma(builder, sig.args[1], args[1], color, plane), target, align=align)
        return context.get_dummy_value()

    return types.none(colors, weight, array, types.intp), codegen
