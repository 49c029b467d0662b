"""Directions of vectors in a quarter of the memory, for views and for model files."""

import numpy as np

from smal.arrays import Float32s, Int8s

#: Keyframes whose views are unpacked at once; limits memory.
BATCH = 32


def unit(vectors: Float32s) -> Float32s:
    """Scale vectors (..., r) to unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    zeros = np.zeros_like(vectors)
    scaled = np.divide(vectors, length, out=zeros, where=length > 1e-6)
    return np.asarray(scaled, dtype=np.float32)


def packed(vectors: Float32s) -> Int8s:
    """Compress the directions of vectors (..., r) to int8; cosines are off by about a thousandth."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    zeros = np.zeros_like(vectors)
    scaled = np.divide(127.0 * vectors, largest, out=zeros, where=largest > 0.0)
    return np.asarray(np.rint(scaled), dtype=np.int8)


def unpacked(vectors: Int8s) -> Float32s:
    """Return packed vectors (..., r), scaled to unit length."""
    return unit(vectors.astype(np.float32))
