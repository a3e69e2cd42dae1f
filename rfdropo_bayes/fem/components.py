"""Vectors, quaternions and 3 x 3 matrices with their components in the first axes: (3, ...), (4, ...), (3, 3, ...).

All other axes are stations or elements, and lanes of a batch: every operation runs over long contiguous rows.
Quaternions are (w, x, y, z).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Vector = Float[Array, "3 ..."]
Quaternion = Float[Array, "4 ..."]
Matrix = Float[Array, "3 3 ..."]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: Float[Array, "k ..."], b: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Sum of the products of the components."""
    return sum((a[i] * b[i] for i in range(1, len(a))), a[0] * b[0])


def times(matrix: Float[Array, "i k ..."], vector: Float[Array, "k ..."]) -> Float[Array, "i ..."]:
    """Matrix times vector, or matrix times matrix."""
    return sum((matrix[:, k] * vector[k] for k in range(1, len(vector))), matrix[:, 0] * vector[0])


def transposed_times(matrix: Float[Array, "k i ..."], vector: Float[Array, "k ..."]) -> Float[Array, "i ..."]:
    """Transpose of a matrix times a vector."""
    return sum((matrix[k] * vector[k] for k in range(1, len(vector))), matrix[0] * vector[0])


def product(a: Matrix, b: Matrix) -> Matrix:
    """Product of two matrices."""
    return sum((a[:, k, None] * b[k][None] for k in range(1, 3)), a[:, 0, None] * b[0][None])


def transposed(matrix: Matrix) -> Matrix:
    """Transpose."""
    return jnp.swapaxes(matrix, 0, 1)


def skew(vector: Vector) -> Matrix:
    """Matrix of the vector product from the left."""
    x, y, z = vector
    none = jnp.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return jnp.stack([jnp.stack(row) for row in rows])


def diagonal(values: Vector) -> Matrix:
    """Diagonal matrix."""
    none = jnp.zeros_like(values[0])
    rows = [[values[i] if i == k else none for k in range(3)] for i in range(3)]
    return jnp.stack([jnp.stack(row) for row in rows])


def normalised(values: Float[Array, "k ..."]) -> Float[Array, "k ..."]:
    """Unit vector."""
    return values * lax.rsqrt(dot(values, values))


def rotation(quaternion: Quaternion) -> Matrix:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = quaternion
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def turned(quaternion: Quaternion, angle: Vector) -> Quaternion:
    """Quaternion after a rotation by a vector [rad] in space, right to its fifth order and without trigonometry."""
    vector = (0.5 + dot(angle, angle) / 24.0) * angle
    scalar, own = quaternion[0], quaternion[1:]
    moved = own + scalar * vector + cross(vector, own)
    return normalised(jnp.concatenate([(scalar - dot(vector, own))[None], moved]))
