"""Directions of vectors in a quarter of the memory, for views and for model files."""

import numpy as np

from smal.arrays import Float32s, Int8s

BATCH = 32  # Keyframes whose views are unpacked at once: memory.


def unit(vectors: Float32s) -> Float32s:
    """Scale vectors (..., r) to unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(
        np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-6),
        dtype=np.float32,
    )


def packed(vectors: Float32s) -> Int8s:
    """Keep the directions of vectors (..., r) in a quarter of the memory; cosines are off by about a thousandth."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = np.divide(127.0 * vectors, largest, out=np.zeros_like(vectors), where=largest > 0.0)
    return np.asarray(np.rint(scaled), dtype=np.int8)


def unpacked(vectors: Int8s) -> Float32s:
    """Return the vectors (..., r) that `packed` packed, of unit length."""
    return unit(vectors.astype(np.float32))
