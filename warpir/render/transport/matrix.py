"""Stored light transport: a dense matrix in a small type, a sparse one, and their products."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor

PIECE = 1 << 18
"""Entries of a matrix of small type that are converted to float32 at once, to stay in a cache."""


class SparseRows:
    """A float32 matrix that is mostly zero, stored by rows and, for the transpose, by columns.

    Where torch is to be deterministic on CUDA it is stored with its zeros.

    Args:
        row: Row of each entry, int32, rising, shape [entry].
        column: Column of each entry, int32, rising within a row, shape [entry].
        values: float32, shape [entry].
        shape: Rows and columns.
    """

    BYTES = 16
    """Memory of one entry, value and int32 index, in both copies [byte]."""

    def __init__(self, row: Tensor, column: Tensor, values: Tensor, shape: tuple[int, int]) -> None:
        self.by_row = _csr(row, column, values, shape)
        if values.is_cuda and torch.are_deterministic_algorithms_enabled():
            # cuSPARSE adds a row's parts in any order, and torch does not say so.
            self.by_row = self.by_row.to_dense()
            self.by_column = self.by_row.t()
            return
        order = torch.argsort(column, stable=True)
        self.by_column = _csr(column[order], row[order], values[order], (shape[1], shape[0]))

    @property
    def bytes(self) -> int:
        """Memory of both copies [byte]."""
        if not self.by_row.is_sparse_csr:
            return self.by_row.numel() * self.by_row.element_size()
        parts = [
            part
            for m in (self.by_row, self.by_column)
            for part in (m.values(), m.crow_indices(), m.col_indices())
        ]
        return sum(part.numel() * part.element_size() for part in parts)

    def times(self, x: Tensor) -> Tensor:
        """Return the product with ``x``, shape [column, k]."""
        return self.by_row @ x

    def transposed_times(self, d: Tensor) -> Tensor:
        """Return the transpose's product with ``d``, shape [row, k]."""
        return self.by_column @ d


def _csr(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Build a CSR matrix from entries sorted by row; int32 indices are what MKL is fast with."""
    start = torch.zeros(shape[0] + 1, dtype=torch.int32, device=values.device)
    start[1:] = torch.cumsum(torch.bincount(rows, minlength=shape[0]), 0)
    with warnings.catch_warnings():
        # Torch calls its CSR layout a beta feature.
        warnings.simplefilter("ignore", UserWarning)
        return torch.sparse_csr_tensor(start, columns, values, shape, check_invariants=False)


class DenseRows:
    """A matrix per channel in a small type, or one for all of them.

    Args:
        T: Shape [3, row, column], or [1, row, column].
    """

    def __init__(self, T: Tensor) -> None:
        self.T = T

    @property
    def bytes(self) -> int:
        """Memory of the matrix [byte]."""
        return self.T.numel() * self.T.element_size()

    def times(self, x: Tensor) -> Tensor:
        """Return each channel's product with its column of ``x``, shape [column, 3]."""
        if len(self.T) == 1:
            return _multiply(self.T[0], x)
        columns = [_multiply(self.T[c], x[:, c : c + 1]) for c in range(3)]
        return torch.cat(columns, dim=1)

    def transposed_times(self, d: Tensor) -> Tensor:
        """Return the transposes' products with the columns of ``d``, shape [row, 3]."""
        if len(self.T) == 1:
            return _multiply(self.T[0], d, is_transposed=True)
        columns = [_multiply(self.T[c], d[:, c : c + 1], is_transposed=True) for c in range(3)]
        return torch.cat(columns, dim=1)


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, T: DenseRows | SparseRows, x: Tensor) -> Tensor:
        ctx.T = T
        return T.times(x)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return None, ctx.T.transposed_times(d_outputs[0].contiguous())


def product(T: DenseRows | SparseRows, x: Tensor) -> Tensor:
    """Return ``T x`` in float32; the gradient reaches ``x`` alone.

    Args:
        T: Stored rows.
        x: float32, shape [column, 3].
    """
    out: Tensor = _Product.apply(T, x)  # type: ignore[no-untyped-call]
    return out


def _multiply(T: Tensor, x: Tensor, is_transposed: bool = False) -> Tensor:
    """Multiply a matrix of small type, or its transpose, with float32 columns.

    Two columns of the small type hold a float32 number to 16 bits, so that rounding the light does
    not scale a whole picture; reading ``T`` is what takes the time.
    """
    is_small = T.dtype != torch.float32
    if is_small and not (T.is_cuda or _has_wide_registers()):
        return _multiply_by_pieces(T, x, is_transposed)
    if is_transposed:
        T = T.t()
    if not is_small:
        return T @ x
    high = x.to(T.dtype)
    low = (x - high.to(x.dtype)).to(T.dtype)
    both = (T @ torch.cat([high, low], dim=1)).to(x.dtype)
    return both[:, : x.shape[1]] + both[:, x.shape[1] :]


def _has_wide_registers() -> bool:
    """Tell whether torch multiplies small types on this CPU as fast as memory is read."""
    return "AVX512" in torch.backends.cpu.get_cpu_capability()


def _multiply_by_pieces(T: Tensor, x: Tensor, is_transposed: bool) -> Tensor:
    """As `_multiply`, in float32: without AVX-512 torch takes ten times as long in a small type."""
    count = max(1, PIECE // max(1, T.shape[1]))
    out = x.new_zeros(x.shape[1], T.shape[1] if is_transposed else T.shape[0])
    for start in range(0, len(T), count):
        rows = slice(start, start + count)
        piece = T[rows].to(x.dtype)
        # A column at a time, which is faster than products with two or three.
        for column in range(x.shape[1]):
            if is_transposed:
                out[column].addmv_(piece.t(), x[rows, column])
            else:
                torch.mv(piece, x[:, column], out=out[column, rows])
    return out.t()
