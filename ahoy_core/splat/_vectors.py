"""Types of the sixteen-lane vectors and what Python's operators do with them."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Final

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

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


def broadcast(builder: Any, value: Any) -> Any:
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
        return emit(builder, sig.args[0], args[0], broadcast(builder, args[1]))

    @lower_builtin(op, types.Number, VecType)
    def _left(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, sig.args[1], broadcast(builder, args[0]), args[1])


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


def call_llvm(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    """Call an LLVM intrinsic function."""
    function_type = ir.FunctionType(result, [a.type for a in args])
    module = builder.module
    found = module.globals.get(name)
    function = found if found is not None else ir.Function(module, function_type, name)
    return builder.call(function, args)


def suffix(kind: Any) -> str:
    return f"v{LANES}f{kind.scalar.bitwidth}"


def element_pointer(context: Any, builder: Any, array_type: types.Array, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])
