"""Sums and maxima over the lanes of vectors, in a fixed order."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from ahoy_core.splat._jit import intrinsic
from ahoy_core.splat._vectors import LANES, call_llvm, element_pointer


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
        base = element_pointer(context, builder, sig.args[0], args[0], args[1])
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
def lane_max(typingctx: Any, value: Any) -> Any:
    """Largest of sixteen int32 lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_llvm(builder, f"llvm.vector.reduce.smax.v{LANES}i32", ir.IntType(32), list(args))

    return value.scalar(value), codegen


@intrinsic
def lane_sum(typingctx: Any, value: Any) -> Any:
    """Sum of the sixteen lanes, in a fixed order."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _lane_sum(builder, args[0])

    return value.scalar(value), codegen
