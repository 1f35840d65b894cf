"""Reading and adding rows of a grid's tables, compiled by numba.

A table is larger than the nearest caches and its rows are met at random, so a plain loop waits for each.
These ask for a point's rows :data:`AHEAD` points before they are used, and take a row as one vector.
Points are taken in their order: the same bytes every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from pipeline.field.kernels import P1, P2, compiled, inlined

AHEAD = 8  # a power of two; 4 and 8 were equally fast, 16 slower beside other work
CORNERS = 8


class _Writer:
    """Writes machine instructions of one call: where numbers of arrays lie, and rows as vectors."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.context, self.builder = context, builder
        self.types, self.args = signature.args, args
        self.lanes = ir.VectorType(ir.FloatType(), len(self.types[-1]))

    def place(self, number: int, indices: Sequence[Any]) -> Any:
        """The address of an item of the argument ``number``, an array."""
        kind = self.types[number]
        array = self.context.make_array(kind)(self.context, self.builder, self.args[number])
        return cgutils.get_item_pointer(
            self.context, self.builder, kind, array, indices, wraparound=False
        )

    def index(self, number: int) -> Any:
        """The argument ``number`` as an index."""
        kind = self.types[number]
        return self.context.cast(self.builder, self.args[number], kind, numba.types.intp)

    def vector(self, place: Any) -> Any:
        """The address, of a vector."""
        return self.builder.bitcast(place, self.lanes.as_pointer())

    def corner(self, rows: int, shares: int, slot: Any, k: int) -> tuple[Any, Any]:
        """Row and share, the latter in every lane, of corner ``k`` at ``slot``."""
        here, builder = [slot, ir.Constant(slot.type, k)], self.builder
        row = builder.zext(builder.load(self.place(rows, here)), slot.type)
        one = builder.load(self.place(shares, here))
        first = builder.insert_element(
            ir.Constant(self.lanes, ir.Undefined), one, ir.Constant(ir.IntType(32), 0)
        )
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes.count), None)
        return row, builder.shuffle_vector(first, first, everywhere)

    def fused(self, share: Any, row: Any, total: Any) -> Any:
        """``share * row + total``."""
        product = self.builder.fmul(share, row, flags=("contract",))
        return self.builder.fadd(product, total, flags=("contract",))


@intrinsic
def _mix(typing, table, rows, shares, slot, out, n, first, lanes):  # type: ignore[no-untyped-def]
    """``out[n, first:first + F]`` is the sum of ``table``'s rows by their shares."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        write = _Writer(context, builder, signature, args)
        total, zero = ir.Constant(write.lanes, None), ir.Constant(ir.IntType(64), 0)
        for k in range(CORNERS):
            row, share = write.corner(1, 2, write.index(3), k)
            read = builder.load(write.vector(write.place(0, [row, zero])), align=4)
            total = write.fused(share, read, total)
        place = write.vector(write.place(4, [write.index(5), write.index(6)]))
        builder.store(total, place, align=4)
        return context.get_dummy_value()

    return numba.types.void(table, rows, shares, slot, out, n, first, lanes), generate


@intrinsic
def _spread(typing, gradient, n, first, rows, shares, slot, out, lanes):  # type: ignore[no-untyped-def]
    """``gradient[n, first:first + F]`` is added to ``out``'s rows by their shares."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        write, zero = _Writer(context, builder, signature, args), ir.Constant(ir.IntType(64), 0)
        place = write.place(0, [write.index(1), write.index(2)])
        passed = builder.load(write.vector(place), align=4)
        for k in range(CORNERS):
            row, share = write.corner(3, 4, write.index(5), k)
            place = write.vector(write.place(6, [row, zero]))
            total = write.fused(share, passed, builder.load(place, align=4))
            builder.store(total, place, align=4)
        return context.get_dummy_value()

    return numba.types.void(gradient, n, first, rows, shares, slot, out, lanes), generate


@intrinsic
def _fetch(typing, table, rows, slot, lanes):  # type: ignore[no-untyped-def]
    """The rows of ``table`` at ``slot`` set out for the nearest cache."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        write, zero = _Writer(context, builder, signature, args), ir.Constant(ir.IntType(64), 0)
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        for k in range(CORNERS):
            here = [write.index(2), ir.Constant(ir.IntType(64), k)]
            row = builder.zext(builder.load(write.place(1, here)), ir.IntType(64))
            place = builder.bitcast(write.place(0, [row, zero]), byte)
            builder.call(prefetch, [place, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return numba.types.void(table, rows, slot, lanes), generate


@inlined
def _corners(x, n, sizes, dense, last_row, rows, shares, slot):  # type: ignore[no-untyped-def]
    """Fills ``rows`` and ``shares`` (AHEAD, 8) at ``slot``: the corners around point ``n`` of ``x`` (3, N)."""
    one, zero = np.float32(1.0), np.int32(0)
    px = x[0, n] * np.float32(sizes[0] - 1)
    py = x[1, n] * np.float32(sizes[1] - 1)
    pz = x[2, n] * np.float32(sizes[2] - 1)
    sy = np.int32(sizes[0]) if dense else P1
    sz = np.int32(sizes[0] * sizes[1]) if dense else P2
    # Rows stay within the table even where a broken fit asks for NaN.
    i = max(min(np.int32(px), np.int32(sizes[0] - 2)), zero)
    j = max(min(np.int32(py), np.int32(sizes[1] - 2)), zero)
    k = max(min(np.int32(pz), np.int32(sizes[2] - 2)), zero)
    fx, fy, fz = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
    gx, gy, gz = one - fx, one - fy, one - fz
    i1, j0, k0 = np.int32(i + 1), np.int32(j * sy), np.int32(k * sz)
    j1, k1 = np.int32(j0 + sy), np.int32(k0 + sz)
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    shares[slot, 0], shares[slot, 1] = a * gz, a * fz
    shares[slot, 2], shares[slot, 3] = b * gz, b * fz
    shares[slot, 4], shares[slot, 5] = c * gz, c * fz
    shares[slot, 6], shares[slot, 7] = d * gz, d * fz
    if dense:
        rows[slot, 0], rows[slot, 1] = i + j0 + k0, i + j0 + k1
        rows[slot, 2], rows[slot, 3] = i + j1 + k0, i + j1 + k1
        rows[slot, 4], rows[slot, 5] = i1 + j0 + k0, i1 + j0 + k1
        rows[slot, 6], rows[slot, 7] = i1 + j1 + k0, i1 + j1 + k1
    else:
        rows[slot, 0], rows[slot, 1] = (i ^ j0 ^ k0) & last_row, (i ^ j0 ^ k1) & last_row
        rows[slot, 2], rows[slot, 3] = (i ^ j1 ^ k0) & last_row, (i ^ j1 ^ k1) & last_row
        rows[slot, 4], rows[slot, 5] = (i1 ^ j0 ^ k0) & last_row, (i1 ^ j0 ^ k1) & last_row
        rows[slot, 6], rows[slot, 7] = (i1 ^ j1 ^ k0) & last_row, (i1 ^ j1 ^ k1) & last_row


@compiled
def read_rows(x, sizes, dense, last_row, table, first, out, lanes):  # type: ignore[no-untyped-def]
    """Fills ``out`` (N, C), from column ``first``, with rows of ``table`` (T, F) mixed around ``x`` (3, N).

    Each point gets the trilinear mixture of the rows at its cell's corners. ``sizes`` (3,) int32 vertices
    per axis, ``last_row`` of a table of a power of two rows, ``lanes`` a tuple of F numbers, whose length
    the compiler knows.
    """
    rows, shares = np.empty((AHEAD, CORNERS), np.int32), np.empty((AHEAD, CORNERS), np.float32)
    count = x.shape[1]
    for ahead in range(count + AHEAD):
        n, slot = ahead - AHEAD, ahead & (AHEAD - 1)
        if n >= 0:
            _mix(table, rows, shares, slot, out, n, first, lanes)
        if ahead < count:
            _corners(x, ahead, sizes, dense, last_row, rows, shares, slot)
            _fetch(table, rows, slot, lanes)


@compiled
def add_rows(x, sizes, dense, last_row, gradient, first, out, lanes):  # type: ignore[no-untyped-def]
    """Adds to ``out`` (T, F) what :func:`read_rows` passes back of ``gradient`` (N, C)."""
    rows, shares = np.empty((AHEAD, CORNERS), np.int32), np.empty((AHEAD, CORNERS), np.float32)
    count = x.shape[1]
    for ahead in range(count + AHEAD):
        n, slot = ahead - AHEAD, ahead & (AHEAD - 1)
        if n >= 0:
            _spread(gradient, n, first, rows, shares, slot, out, lanes)
        if ahead < count:
            _corners(x, ahead, sizes, dense, last_row, rows, shares, slot)
            _fetch(out, rows, slot, lanes)
