"""Posteriors with known answers, as problems for the inference methods."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import multivariate_normal


class LinearGaussian:
    """y = A x + noise with a Gaussian prior on x: posterior and evidence of every prefix in closed form.

    Nothing in it is symmetric or centred: rows differ in size, the prior mean is not zero, a row has its own noise.
    """

    def __init__(self, n_rows: int = 12, d: int = 3, seed: int = 0, noise: float = 0.3) -> None:
        rng = np.random.default_rng(seed)
        self.design = rng.normal(size=(n_rows, d)) * np.linspace(0.5, 2.0, n_rows)[:, None]
        self.mean = rng.normal(size=d)
        self.sd = rng.uniform(0.5, 2.0, d)
        self.noise = noise * np.linspace(1.0, 2.0, n_rows)
        truth = self.mean + 1.3 * self.sd * rng.normal(size=d)
        self.data = self.design @ truth + self.noise * rng.normal(size=n_rows)
        self.names = tuple(f"x{j}" for j in range(d))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = dict.fromkeys(self.names, (-np.inf, np.inf))
        self.n_rows = n_rows
        self.calls: list[tuple[int, int]] = []
        self._rows = jax.jit(self._row_density, static_argnums=1)

    def sample_prior(self, key, n):
        z = jax.random.normal(key, (n, len(self.names)))
        return self.from_unconstrained(self.mean + self.sd * z)

    def to_unconstrained(self, values):
        return jnp.stack([jnp.asarray(values[name]) for name in self.names], axis=-1)

    def from_unconstrained(self, u):
        return {name: u[:, j] for j, name in enumerate(self.names)}

    def log_prior(self, u):
        return jnp.sum(jax.scipy.stats.norm.logpdf(u, self.mean, self.sd), axis=1)

    def _row_density(self, u, horizon):
        fit = u @ self.design[:horizon].T
        return jax.scipy.stats.norm.logpdf(self.data[:horizon], fit, self.noise[:horizon])

    def row_log_likelihood(self, values, horizon):
        u = self.to_unconstrained(values)
        self.calls.append((len(u), horizon))
        return self._rows(u, horizon), np.zeros(len(u), dtype=int)

    def residuals(self, values, horizon):
        u = jnp.stack([values[name] for name in self.names])
        return (self.data[:horizon] - self.design[:horizon] @ u) / self.noise[:horizon]

    def prefix_log_evidence(self):
        """log p(y[:h]) for h = 1 ... n_rows."""
        covariance = np.diag(self.noise**2) + (self.design * self.sd**2) @ self.design.T
        mean = self.design @ self.mean
        return np.array(
            [multivariate_normal.logpdf(self.data[:h], mean[:h], covariance[:h, :h]) for h in range(1, self.n_rows + 1)]
        )

    def posterior(self):
        """Mean and covariance given all rows."""
        precision = np.diag(self.sd**-2.0) + (self.design.T * self.noise**-2.0) @ self.design
        covariance = np.linalg.inv(precision)
        mean = covariance @ (self.mean / self.sd**2 + self.design.T @ (self.data / self.noise**2))
        return mean, covariance
